//! Dependency rules of the workspace, checked against its manifests and sources.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use toml::{Table, Value};

/// Every package, its folder, and the packages that it may depend on.
pub const HOUSE: [(&str, &str, &[&str]); 17] = [
    ("atoms", "crates/atoms", &[]),
    ("npz", "crates/npz", &[]),
    ("calm", "crates/calm", &["npz"]),
    ("potentials", "crates/potentials", &["atoms", "npz"]),
    ("md", "crates/md", &["atoms"]),
    ("dft", "crates/dft", &["atoms"]),
    ("analysis", "crates/analysis", &[]),
    ("figures", "crates/figures", &[]),
    ("upfit", "crates/upfit", &["analysis", "atoms", "calm", "potentials"]),
    ("batch", "crates/batch", &[]),
    ("wire", "crates/wire", &["atoms", "calm"]),
    ("bridge", "crates/bridge", &["atoms", "calm", "potentials", "wire"]),
    ("store", "store", &["atoms", "wire"]),
    ("monitor", "monitor", &["analysis", "atoms", "calm", "store", "wire"]),
    (
        "workers",
        "workers",
        &["atoms", "calm", "potentials", "md", "dft", "analysis", "batch", "wire", "store", "monitor"],
    ),
    ("orchestrator", "orchestrator", &["atoms", "calm", "batch", "wire", "store"]),
    (
        "calmwalk",
        "",
        &[
            "atoms",
            "npz",
            "calm",
            "potentials",
            "md",
            "dft",
            "analysis",
            "figures",
            "upfit",
            "bridge",
            "wire",
            "store",
            "monitor",
            "workers",
            "orchestrator",
        ],
    ),
];

/// Files of `workers` that may use the store: a walker never opens the database.
const USERS_OF_THE_STORE: [&str; 2] = ["labeller", "lib.rs"];

fn root() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR"))
}

fn manifest(folder: &Path) -> Table {
    let path = folder.join("Cargo.toml");
    let text = std::fs::read_to_string(&path).unwrap_or_else(|error| panic!("{}: {error}", path.display()));
    text.parse().unwrap_or_else(|error| panic!("{}: {error}", path.display()))
}

fn table<'a>(manifest: &'a Table, key: &str) -> Option<&'a Table> {
    manifest.get(key).and_then(Value::as_table)
}

/// Folders of the members of the workspace, the root package included.
fn members() -> BTreeSet<PathBuf> {
    let workspace = manifest(root());
    let patterns = workspace["workspace"]["members"].as_array().unwrap();
    let mut folders = BTreeSet::from([root().to_owned()]);
    for pattern in patterns.iter().map(|pattern| pattern.as_str().unwrap()) {
        match pattern.strip_suffix("/*") {
            None => drop(folders.insert(root().join(pattern))),
            Some(parent) => {
                let inside =
                    std::fs::read_dir(root().join(parent)).unwrap().map(|entry| entry.unwrap().path());
                folders.extend(inside.filter(|folder| folder.join("Cargo.toml").exists()));
            }
        }
    }
    folders
}

fn name(manifest: &Table) -> String {
    manifest["package"]["name"].as_str().unwrap().to_owned()
}

/// The workspace packages in a package's dependencies and build dependencies, in any notation; dev-dependencies do not count.
fn edges(manifest: &Table, packages: &BTreeSet<String>) -> BTreeSet<String> {
    let mut tables = vec![manifest];
    tables.extend(table(manifest, "target").into_iter().flat_map(Table::values).filter_map(Value::as_table));
    let sections = ["dependencies", "build-dependencies"];
    let dependencies = tables.iter().flat_map(|of| sections.iter().filter_map(|section| table(of, section)));
    dependencies
        .flatten()
        .map(|(key, value)| package_name(key, value))
        .filter(|n| packages.contains(n))
        .collect()
}

/// The package name of a dependency, which may be renamed.
fn package_name(key: &str, value: &Value) -> String {
    let renamed = |value: &Value| value.get("package").and_then(Value::as_str).map(str::to_owned);
    let shared = || renamed(manifest(root()).get("workspace")?.get("dependencies")?.get(key)?);
    renamed(value).or_else(shared).unwrap_or_else(|| key.to_owned())
}

#[test]
fn every_package_is_listed() {
    let found: BTreeMap<_, _> =
        members().into_iter().map(|folder| (name(&manifest(&folder)), folder)).collect();
    let planned: BTreeMap<_, _> =
        HOUSE.iter().map(|(name, folder, _)| ((*name).to_owned(), root().join(folder))).collect();
    let clean = |folders: BTreeMap<String, PathBuf>| -> BTreeMap<String, PathBuf> {
        folders.into_iter().map(|(name, folder)| (name, folder.components().collect())).collect()
    };
    assert_eq!(clean(found), clean(planned));
}

#[test]
fn packages_depend_only_on_allowed_ones() {
    let packages = HOUSE.iter().map(|(name, ..)| (*name).to_owned()).collect();
    for (name, folder, allowed) in HOUSE {
        let edges = edges(&manifest(&root().join(folder)), &packages);
        let forbidden: Vec<_> = edges.iter().filter(|edge| !allowed.contains(&edge.as_str())).collect();
        assert!(forbidden.is_empty(), "{name} may not depend on {forbidden:?}");
    }
}

/// Some packages must not depend on others even indirectly.
#[test]
fn packages_do_not_depend_indirectly_on_forbidden_ones() {
    let packages: BTreeSet<_> = HOUSE.iter().map(|(name, ..)| (*name).to_owned()).collect();
    let edges_of: BTreeMap<_, _> = HOUSE
        .iter()
        .map(|(name, folder, _)| ((*name).to_owned(), edges(&manifest(&root().join(folder)), &packages)))
        .collect();
    for (from, never) in [
        ("md", &["calm", "potentials", "wire", "store"][..]),
        ("calm", &["atoms"]),
        ("potentials", &["calm", "md"]),
        ("dft", &["calm", "potentials", "md", "wire", "store"]),
        ("upfit", &["md", "wire", "store", "workers"]),
        ("store", &["potentials", "md", "workers", "orchestrator"]),
        ("orchestrator", &["potentials", "md", "workers"]),
        ("workers", &["orchestrator"]),
    ] {
        let mut reached = BTreeSet::new();
        let mut open = vec![from.to_owned()];
        while let Some(package) = open.pop() {
            open.extend(edges_of[&package].iter().filter(|edge| reached.insert((*edge).clone())).cloned());
        }
        let wrong: Vec<_> = never.iter().filter(|package| reached.contains(**package)).collect();
        assert!(wrong.is_empty(), "{from} reaches {wrong:?}");
    }
}

/// In `workers`, only the labeller uses the store.
#[test]
fn walkers_do_not_open_the_store() {
    let mut open = vec![root().join("workers/src")];
    let mut read = 0;
    while let Some(path) = open.pop() {
        let name = path.file_name().unwrap().to_string_lossy();
        if USERS_OF_THE_STORE.iter().any(|user| name == *user || name == format!("{user}.rs")) {
            continue;
        }
        if path.is_dir() {
            open.extend(std::fs::read_dir(&path).unwrap().map(|entry| entry.unwrap().path()));
            continue;
        }
        let text = std::fs::read_to_string(&path).unwrap();
        assert!(!text.contains("store::"), "{} uses the store", path.display());
        read += 1;
    }
    assert!(read > 1);
}

/// The Rust sources at these paths, files or folders, without unit tests at the end of a file or in `tests.rs`.
fn sources(paths: &[&str]) -> BTreeMap<PathBuf, String> {
    let mut open: Vec<_> = paths.iter().map(|path| root().join(path)).collect();
    let mut found = BTreeMap::new();
    while let Some(path) = open.pop() {
        if path.is_dir() {
            open.extend(std::fs::read_dir(&path).unwrap().map(|entry| entry.unwrap().path()));
        } else if path.extension().is_some_and(|kind| kind == "rs") && !is_test(&path) {
            let text = std::fs::read_to_string(&path).unwrap();
            let text = text.split("#[cfg(test)]\nmod tests {").next().unwrap_or_default().to_owned();
            found.insert(path, text);
        }
    }
    assert!(
        paths.iter().all(|path| found.keys().any(|file| file.starts_with(root().join(path)))),
        "{paths:?}"
    );
    found
}

/// Whether a source file is one of tests: `tests.rs`, or in a folder of that name.
fn is_test(path: &Path) -> bool {
    let inside = path.strip_prefix(root()).unwrap_or(path);
    path.ends_with("tests.rs") || inside.components().any(|part| part.as_os_str() == "tests")
}

/// Functions of the store that begin a write transaction, directly or indirectly.
fn writing_functions() -> BTreeSet<String> {
    let mut bodies = BTreeMap::new();
    for text in sources(&["store/src/tables"]).values() {
        for function in text.split("async fn ").skip(1) {
            let (name, body) = function.split_once('(').unwrap();
            let body = body.split("\n    }\n").next().unwrap().to_owned();
            bodies.insert(name.split('<').next().unwrap().to_owned(), body);
        }
    }
    let begins = |body: &String| {
        [".begin()", "begin_as_leader()", "begin_commit("].iter().any(|begin| body.contains(begin))
    };
    let mut names: BTreeSet<_> =
        bodies.iter().filter(|(_, body)| begins(body)).map(|(name, _)| name.clone()).collect();
    loop {
        let calls = |body: &String| names.iter().any(|name| body.contains(&format!("self.{name}(")));
        let more: BTreeSet<_> =
            bodies.iter().filter(|(_, body)| calls(body)).map(|(name, _)| name.clone()).collect();
        if more.is_subset(&names) {
            return names;
        }
        names.extend(more);
    }
}

/// The read side and the views read from the store and never write to it. The dashboard's `actions` are not a view.
#[test]
fn views_never_write() {
    let views = [
        "monitor/src",
        "src/cli/status.rs",
        "src/cli/status",
        "src/cli/explain",
        "src/cli/force_errors.rs",
        "src/cli/force_errors",
        "src/cli/calibration.rs",
        "src/cli/versions/compare.rs",
        "src/cli/versions/list.rs",
        "src/cli/versions/show.rs",
        "src/cli/walks/trace.rs",
        "src/cli/watch/reader.rs",
        "src/notify",
        "src/report",
        "src/web",
        "src/wording",
        "src/summary.rs",
    ];
    let writing = writing_functions();
    for known in ["lease", "complete", "commit", "pause_walks", "retry_job", "exclude"] {
        assert!(writing.contains(known), "{known} is not among the functions that write: {writing:?}");
    }
    for (path, text) in
        sources(&views).into_iter().filter(|(path, _)| !path.ends_with("dashboard/actions.rs"))
    {
        let found: Vec<_> = writing.iter().filter(|name| text.contains(&format!("store.{name}("))).collect();
        assert!(found.is_empty(), "{} writes into the store: {found:?}", path.display());
    }
}

/// The read side only computes; views produce text, tables and pages.
#[test]
fn the_read_side_renders_nothing() {
    for (path, text) in sources(&["monitor/src"]) {
        for means in ["println!", "writeln!", "write!(", "io::Write", "fmt::Display", "fmt::Write", "Table"] {
            assert!(!text.contains(means), "{} uses {means}", path.display());
        }
    }
}

/// No other module of the program depends on the commands.
#[test]
fn commands_are_used_by_the_program_alone() {
    for (path, text) in sources(&["src"]) {
        let is_above = path.starts_with(root().join("src/cli")) || path == root().join("src/main.rs");
        assert!(is_above || !text.contains("cli::"), "{} uses a command", path.display());
    }
}

#[test]
fn every_package_obeys_the_lints() {
    let workspace = manifest(root());
    let lints = &workspace["workspace"]["lints"]["rust"];
    assert!(["deny", "forbid"].contains(&lints["unsafe_code"].as_str().unwrap()));
    assert!(["warn", "deny"].contains(&lints["missing_docs"].as_str().unwrap()));
    for folder in members() {
        let inherited =
            table(&manifest(&folder), "lints").and_then(|lints| lints.get("workspace")?.as_bool());
        assert_eq!(inherited, Some(true), "{} needs [lints] workspace = true", folder.display());
    }
}

/// A browser detects a missing import only when it executes the call.
#[test]
fn pages_import_the_functions_that_they_call() {
    let folder = root().join("src/web/pages");
    let files = std::fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().path());
    let scripts: Vec<_> = files.filter(|path| path.extension().is_some_and(|end| end == "js")).collect();
    let texts: Vec<_> = scripts.iter().map(|path| std::fs::read_to_string(path).unwrap()).collect();
    let is_part = |letter: char| letter.is_alphanumeric() || ['_', '.', '$'].contains(&letter);
    let exported = |text: &str| -> Vec<String> {
        let functions = text.lines().filter_map(|line| {
            let line = line.strip_prefix("export ")?;
            line.strip_prefix("async ").unwrap_or(line).strip_prefix("function ")
        });
        functions.map(|rest| rest.split('(').next().unwrap().to_owned()).collect()
    };
    let names: BTreeSet<_> = texts.iter().flat_map(|text| exported(text)).collect();
    assert!(names.contains("words"), "{names:?}");
    for (path, text) in scripts.iter().zip(&texts) {
        let known = |name: &str| {
            let declares = |line: &str| {
                let mut words = line.split(|letter: char| !is_part(letter));
                ["import", "export", "function", "async", "const", "let"]
                    .iter()
                    .any(|start| line.starts_with(start))
                    && words.any(|word| word == name)
            };
            text.lines().map(str::trim_start).any(declares)
        };
        for name in &names {
            let call = format!("{name}(");
            let mut calls = text.match_indices(&call);
            let is_called = calls.any(|(at, _)| !text[..at].ends_with(is_part));
            assert!(!is_called || known(name), "{} calls {name} without importing it", path.display());
        }
    }
}

/// One word, one meaning: no two types have the same name, private ones neither. Types of tests may.
#[test]
fn types_have_unique_names() {
    let packages =
        HOUSE.map(|(_, folder, _)| if folder.is_empty() { "src".into() } else { format!("{folder}/src") });
    let mut found: BTreeMap<String, Vec<String>> = BTreeMap::new();
    for (path, text) in sources(&packages.each_ref().map(String::as_str)) {
        if path.ends_with("tests.rs") || path.components().any(|part| part.as_os_str() == "tests") {
            continue;
        }
        // Types stand at the left margin; what is indented belongs to a trait, a function or a module of tests.
        for line in text.lines() {
            let item = match line.strip_prefix("pub") {
                Some(rest) if rest.starts_with('(') => rest.split_once(") ").map_or("", |(_, item)| item),
                Some(rest) => rest.trim_start(),
                None => line,
            };
            let kinds = ["struct ", "enum ", "trait ", "union ", "type ", "unsafe trait "];
            if let Some(rest) = kinds.iter().find_map(|kind| item.strip_prefix(kind)) {
                let name = rest.split(|letter: char| !letter.is_alphanumeric() && letter != '_').next();
                // A macro makes types of names that it is given.
                if let Some(name) = name.filter(|name| !name.is_empty()) {
                    found.entry(name.to_owned()).or_default().push(path.display().to_string());
                }
            }
        }
    }
    assert!(found.len() > 1000, "{}", found.len());
    let shared: Vec<_> = found.iter().filter(|(_, files)| files.len() > 1).collect();
    assert!(shared.is_empty(), "{shared:#?}");
}
