//! Within a package, files do not import each other in a circle.

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::Path;

use crate::house::HOUSE;

/// Operations of the tape call each other through it: its imports close no circle.
const DISPATCH: &str = "grace::tape";

/// A module by the names on the way to it; the root of a package has none.
type Module = Vec<String>;

/// The text of every module that has a file, without unit tests and comments.
fn modules(folder: &Path) -> BTreeMap<Module, String> {
    let mut found = BTreeMap::new();
    let mut open = vec![folder.to_owned()];
    while let Some(path) = open.pop() {
        if path.is_dir() {
            open.extend(fs::read_dir(&path).unwrap().map(|entry| entry.unwrap().path()));
        } else if path.extension().is_some_and(|end| end == "rs") && !path.ends_with("tests.rs") {
            let text = fs::read_to_string(&path).unwrap();
            let text = text.split("#[cfg(test)]\nmod tests {").next().unwrap();
            let code =
                text.lines().map(|line| line.split("//").next().unwrap()).collect::<Vec<_>>().join("\n");
            let inside = path.with_extension("");
            let names =
                inside.strip_prefix(folder).unwrap().iter().map(|name| name.to_str().unwrap().to_owned());
            let mut module: Module = names.collect();
            if module.last().is_some_and(|last| ["mod", "lib", "main"].contains(&last.as_str())) {
                module.pop();
            }
            found.insert(module, code);
        }
    }
    found
}

/// Every path in `text`, which starts with a path and perhaps a group of paths in braces; and how much of the text it is.
fn read_paths(text: &str, prefix: &[String]) -> (Vec<Module>, usize) {
    let mut path = prefix.to_vec();
    let mut at = 0;
    loop {
        let rest = &text[at..];
        if rest.starts_with('{') {
            let (inside, length) = read_group(rest, &path);
            return (inside, at + length);
        }
        let length =
            rest.find(|letter: char| !letter.is_alphanumeric() && letter != '_').unwrap_or(rest.len());
        if length > 0 {
            path.push(rest[..length].to_owned());
        }
        at += length;
        if length == 0 || !text[at..].starts_with("::") {
            return (vec![path], at);
        }
        at += 2;
    }
}

/// The paths of a group in braces, which `text` starts with.
fn read_group(text: &str, prefix: &[String]) -> (Vec<Module>, usize) {
    let mut found = Vec::new();
    let mut at = 1;
    while at < text.len() && !text[at..].starts_with('}') {
        let starts = text[at..].starts_with(|letter: char| letter.is_alphabetic() || letter == '_');
        if starts {
            let (paths, length) = read_paths(&text[at..], prefix);
            found.extend(paths);
            at += length;
        } else {
            at += text[at..].chars().next().map_or(1, char::len_utf8);
        }
    }
    (found, at + 1)
}

/// The paths that a module names, from the root of its package.
fn named_paths(module: &[String], text: &str) -> Vec<Module> {
    let mut found = Vec::new();
    for (start, _) in
        text.match_indices("crate::").chain(text.match_indices("super::")).chain(text.match_indices("use "))
    {
        let is_part =
            text[..start].ends_with(|letter: char| letter.is_alphanumeric() || "_:".contains(letter));
        let skipped = if text[start..].starts_with("use ") { 4 } else { 0 };
        if !is_part {
            let (paths, _) = read_paths(&text[start + skipped..], &[]);
            found.extend(paths.into_iter().filter_map(|path| absolute(module, path)));
        }
    }
    found
}

/// A path from the root of the package; none if it is of another package.
fn absolute(module: &[String], path: Module) -> Option<Module> {
    let mut base = module.to_vec();
    let mut names = path.into_iter().peekable();
    match names.peek()?.as_str() {
        "crate" => {
            names.next();
            base.clear();
        }
        "super" => {
            while names.peek().is_some_and(|name| name == "super") {
                names.next();
                base.pop();
            }
        }
        "self" => drop(names.next()),
        _ => (),
    }
    base.extend(names);
    Some(base)
}

/// The module whose file has what a path names: re-exports are followed.
fn home(
    path: &[String],
    modules: &BTreeMap<Module, String>,
    named: &BTreeMap<Module, Vec<Module>>,
) -> Option<Module> {
    let mut path = path.to_vec();
    for _ in 0..8 {
        let length = (0..=path.len()).rev().find(|length| modules.contains_key(&path[..*length]))?;
        let module = path[..length].to_vec();
        let Some(item) = path.get(length) else { return Some(module) };
        let inside = |other: &&Module| {
            other.len() > length + 1 && other.starts_with(&module) && other.last() == Some(item)
        };
        match named[&module].iter().find(inside) {
            Some(exported) => path = exported.clone(),
            None => return Some(module),
        }
    }
    None
}

/// Whom each module imports, but for the modules that it is in or that are in it.
fn imports(modules: &BTreeMap<Module, String>) -> BTreeMap<Module, BTreeSet<Module>> {
    let named: BTreeMap<_, _> =
        modules.iter().map(|(module, text)| (module.clone(), named_paths(module, text))).collect();
    let is_related = |one: &Module, other: &Module| one.starts_with(other) || other.starts_with(one);
    let of = |module: &Module, paths: &Vec<Module>| {
        let homes = paths.iter().filter_map(|path| home(path, modules, &named));
        homes.filter(|other| !is_related(module, other)).collect()
    };
    named.iter().map(|(module, paths)| (module.clone(), of(module, paths))).collect()
}

/// Modules that can be reached from `module`.
fn reached(module: &Module, imports: &BTreeMap<Module, BTreeSet<Module>>) -> BTreeSet<Module> {
    let mut found = BTreeSet::new();
    let mut open = vec![module.clone()];
    while let Some(module) = open.pop() {
        let next = imports.get(&module).into_iter().flatten();
        open.extend(next.filter(|other| found.insert((*other).clone())).cloned());
    }
    found
}

#[test]
fn files_do_not_import_each_other_in_a_circle() {
    let mut circles = BTreeSet::new();
    let mut edges = 0;
    for (_, folder, _) in HOUSE {
        let modules = modules(&Path::new(env!("CARGO_MANIFEST_DIR")).join(folder).join("src"));
        let mut imports = imports(&modules);
        imports.retain(|module, _| module.join("::") != DISPATCH);
        edges += imports.values().map(BTreeSet::len).sum::<usize>();
        for module in imports.keys() {
            let reached = reached(module, &imports);
            if reached.contains(module) {
                let back = reached.iter().filter(|other| self::reached(other, &imports).contains(module));
                circles.insert(format!(
                    "{folder}: {:?}",
                    back.map(|other| other.join("::")).collect::<Vec<_>>()
                ));
            }
        }
    }
    assert!(edges > 1000, "{edges}");
    assert!(circles.is_empty(), "{circles:#?}");
}

#[test]
fn a_circle_is_found() {
    let module = |names: &str| names.split("::").map(str::to_owned).collect::<Module>();
    let texts = [
        ("a", "mod inner;\npub use inner::Item;"),
        ("a::inner", "use crate::b::{self, c::{Other, more}};"),
        ("b", "mod c;"),
        ("b::c", "fn f() { super::super::a::Item }"),
        ("d", "use crate::a::Item;"),
    ];
    let modules = texts.map(|(name, text)| (module(name), text.to_owned())).into_iter().collect();
    let imports = imports(&modules);
    assert_eq!(imports[&module("d")], BTreeSet::from([module("a::inner")]));
    assert!(reached(&module("a::inner"), &imports).contains(&module("a::inner")));
    assert!(!reached(&module("d"), &imports).contains(&module("d")));
}
