//! The pages in docs/: each is in the lists of pages, and no link leads nowhere.

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::{Path, PathBuf};

use regex::Regex;

fn root() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR"))
}

/// The pages in docs/ and their texts, without the summary.
fn pages() -> BTreeMap<PathBuf, String> {
    let files = fs::read_dir(root().join("docs")).unwrap().map(|entry| entry.unwrap().path());
    let pages = files.filter(|path| path.extension().is_some_and(|end| end == "md"));
    pages.filter(|path| !path.ends_with("SUMMARY.md")).map(|path| (path.clone(), read(&path))).collect()
}

fn read(path: &Path) -> String {
    fs::read_to_string(path).unwrap_or_else(|error| panic!("{}: {error}", path.display()))
}

/// The text outside of blocks of code.
fn prose(text: &str) -> String {
    let mut inside = false;
    let kept = text.lines().filter(|line| {
        let is_fence = line.trim_start().starts_with("```");
        inside ^= is_fence;
        !inside && !is_fence
    });
    kept.fold(String::new(), |all, line| all + line + "\n")
}

/// Targets of the links to files of the project.
fn links(text: &str) -> Vec<String> {
    let code = Regex::new("`[^`\n]*`").unwrap();
    let link = Regex::new(r"\]\(([^)\s]+)\)").unwrap();
    let text = prose(text);
    let text = code.replace_all(&text, "");
    let targets = link.captures_iter(&text).map(|found| found[1].to_owned());
    targets.filter(|target| !target.contains("://")).collect()
}

/// The anchors of a page: those of its headings, as GitHub and mdBook name them, and those in its text.
fn anchors(text: &str) -> BTreeSet<String> {
    let in_text = Regex::new(r#"<a id="([^"]+)">"#).unwrap();
    let link = Regex::new(r"\[([^\]]*)\]\([^)]*\)").unwrap();
    let of_heading = |line: &str| {
        let title = line.trim_start_matches('#').trim().to_lowercase();
        let title = link.replace_all(&title, "$1").into_owned();
        let kept = title.chars().filter(|letter| letter.is_alphanumeric() || " -_".contains(*letter));
        kept.map(|letter| if letter == ' ' { '-' } else { letter }).collect()
    };
    let prose = prose(text);
    let mut all: BTreeSet<String> =
        prose.lines().filter(|line| line.starts_with('#')).map(of_heading).collect();
    all.extend(in_text.captures_iter(&prose).map(|found| found[1].to_owned()));
    all
}

/// The pages in docs/ that a text links to, whose links are relative to `folder`.
fn linked_pages(text: &str, folder: &Path) -> BTreeSet<PathBuf> {
    let files = links(text).into_iter().map(|target| folder.join(target.split('#').next().unwrap()));
    files.filter(|path| path.parent() == Some(&root().join("docs"))).collect()
}

#[test]
fn every_page_is_in_the_book_and_in_the_readme() {
    let pages: BTreeSet<_> = pages().into_keys().collect();
    assert!(pages.len() > 40, "{}", pages.len());
    let book = linked_pages(&read(&root().join("docs/SUMMARY.md")), &root().join("docs"));
    assert_eq!(book, pages, "docs/SUMMARY.md");
    let readme = linked_pages(&read(&root().join("README.md")), root());
    let missing: Vec<_> = pages.difference(&readme).collect();
    assert!(missing.is_empty(), "README.md does not link to {missing:?}");
}

#[test]
fn links_lead_to_files_and_headings() {
    let mut texts = pages();
    for more in ["README.md", "docs/SUMMARY.md"] {
        texts.insert(root().join(more), read(&root().join(more)));
    }
    let anchors: BTreeMap<_, _> = texts.iter().map(|(path, text)| (path.clone(), anchors(text))).collect();
    let (mut wrong, mut followed) = (Vec::new(), 0);
    for (path, text) in &texts {
        for target in links(text) {
            let (file, anchor) = target.split_once('#').unwrap_or((&target, ""));
            let to = if file.is_empty() { path.clone() } else { path.parent().unwrap().join(file) };
            let leads =
                to.exists() && (anchor.is_empty() || anchors.get(&to).is_none_or(|all| all.contains(anchor)));
            followed += 1;
            if !leads {
                wrong.push(format!("{}: {target}", path.display()));
            }
        }
    }
    assert!(followed > 300, "{followed}");
    assert!(wrong.is_empty(), "{wrong:#?}");
}

#[test]
fn anchors_are_those_of_headings_and_of_the_text() {
    let text =
        "# `[[walks]]`, τ and 2 more\n```\n# no heading\n```\n<a id=\"here\"></a>\n## See [a page](b.md)\n";
    let expected = ["here", "see-a-page", "walks-τ-and-2-more"].map(str::to_owned);
    assert_eq!(anchors(text), BTreeSet::from(expected));
    assert_eq!(links("[a](b.md#c) `[x](y)` [d](https://e.org)\n```\n[f](g)\n```\n"), ["b.md#c"]);
}
