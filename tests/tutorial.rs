//! The commands of docs/tutorial.md, in order, as a reader types them.

use std::fs;
use std::io::{BufRead, BufReader, Read};
use std::path::Path;
use std::process::{Command, Stdio};

use regex::Regex;

use crate::common::processes::{assert_no_leftovers, signal};
use crate::common::{Running, stderr};

const PAGE: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/docs/tutorial.md");

/// What a reader does while a command runs. A comment before the block says so.
#[derive(Debug, PartialEq)]
enum Reader {
    /// Waits for its end.
    Waits,
    /// Presses Ctrl-C once it prints `after` on standard error; it ends with exit code `code`.
    Interrupts { after: String, code: i32 },
    /// Looks at the screen, which a test does not have (`external watch::` does): the command says so.
    NeedsTerminal,
}

#[derive(Debug)]
struct Block {
    commands: String,
    reader: Reader,
}

/// The blocks of commands of a page.
fn blocks(page: &str) -> Vec<Block> {
    let block = Regex::new(r"(?s)(?:<!-- ([^\n]*) -->\n)?```sh\n(.*?)```").unwrap();
    let interrupt = Regex::new(r#"^Ctrl-C after "([^"]+)", exit code (\d+)$"#).unwrap();
    let one = |found: regex::Captures| {
        let reader = match found.get(1).map(|comment| comment.as_str()) {
            None => Reader::Waits,
            Some("needs a terminal") => Reader::NeedsTerminal,
            Some(comment) => {
                let given = interrupt.captures(comment).unwrap_or_else(|| panic!("what is '{comment}'?"));
                Reader::Interrupts { after: given[1].to_owned(), code: given[2].parse().unwrap() }
            }
        };
        Block { commands: found[2].to_owned(), reader }
    };
    block.captures_iter(page).map(one).collect()
}

/// A shell with the program on its path.
fn shell(here: &Path, commands: &str) -> Command {
    let program = Path::new(env!("CARGO_BIN_EXE_calmwalk")).parent().unwrap();
    let path = format!("{}:{}", program.display(), std::env::var("PATH").unwrap_or_default());
    let mut command = Command::new("sh");
    command.args(["-euc", commands]).current_dir(here).env("PATH", path).stdin(Stdio::null());
    command
}

/// Runs a command, presses Ctrl-C once it says `after`, and returns its exit code.
fn interrupted(here: &Path, commands: &str, after: &str) -> Option<i32> {
    let mut command = shell(here, &format!("exec {commands}"));
    let mut child = Running(command.stdout(Stdio::null()).stderr(Stdio::piped()).spawn().unwrap());
    let mut lines = BufReader::new(child.0.stderr.take().unwrap());
    let mut said = String::new();
    while !said.contains(after) {
        let read = lines.read_line(&mut said).unwrap();
        assert!(read > 0, "{commands} ends without '{after}': {said}");
    }
    signal(child.0.id(), "INT");
    lines.read_to_string(&mut said).unwrap();
    child.0.wait().unwrap().code()
}

fn run(here: &Path, Block { commands, reader }: &Block) {
    match reader {
        Reader::Interrupts { after, code } => {
            assert_eq!(interrupted(here, commands, after), Some(*code), "{commands}");
        }
        Reader::Waits | Reader::NeedsTerminal => {
            let output = shell(here, commands).output().unwrap();
            let (expected, what) = match reader {
                Reader::NeedsTerminal => (2, "standard output is not a terminal"),
                _ => (0, ""),
            };
            let said = stderr(&output);
            assert_eq!(output.status.code(), Some(expected), "{commands}\n{said}");
            assert!(said.contains(what), "{commands}\n{said}");
        }
    }
}

/// The mean of the column `force_error_mean` of a table of `calm score`, eV/Å.
fn mean_force_error(table: &Path) -> f64 {
    let text = fs::read_to_string(table).unwrap();
    let mut rows = text.lines().map(|line| line.split(',').collect::<Vec<_>>());
    let titles = rows.next().unwrap();
    let column = titles.iter().position(|title| *title == "force_error_mean").unwrap();
    let errors: Vec<f64> = rows.map(|row| row[column].parse().unwrap()).collect();
    errors.iter().sum::<f64>() / errors.len() as f64
}

#[test]
fn every_command_of_the_tutorial_works() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    let page = fs::read_to_string(PAGE).unwrap();
    let blocks = blocks(&page);
    assert_eq!(blocks.len(), page.matches("```sh\n").count());
    let mut promised = vec!["report/report.html".to_owned(), "report/figures/grades.svg".to_owned()];
    let written = Regex::new(r"--(?:output|figure|table) (\S+)").unwrap();
    for block in &blocks {
        run(here, block);
        promised.extend(written.captures_iter(&block.commands).map(|found| found[1].to_owned()));
    }
    let missing: Vec<_> = promised.iter().filter(|file| !here.join(file).exists()).collect();
    assert!(promised.len() > 8 && missing.is_empty(), "{missing:?} of {promised:?}");
    assert_no_leftovers(&here.join("al/campaign"));
    // What the page is for.
    let [before, after] = ["before.csv", "after.csv"].map(|table| mean_force_error(&here.join(table)));
    assert!(after < 0.7 * before, "{before} {after}");
}

#[test]
fn comments_say_what_the_reader_does() {
    let page = "text\n```\nshown\n```\n```sh\na\nb\n```\n<!-- Ctrl-C after \"x y\", exit code 130 -->\n```sh\nc\n```\n<!-- needs a terminal -->\n```sh\nd\n```\n";
    let found: Vec<_> = blocks(page).into_iter().map(|block| (block.commands, block.reader)).collect();
    let interrupts = Reader::Interrupts { after: "x y".to_owned(), code: 130 };
    let expected = [("a\nb\n", Reader::Waits), ("c\n", interrupts), ("d\n", Reader::NeedsTerminal)];
    assert_eq!(found, expected.map(|(commands, reader)| (commands.to_owned(), reader)));
}
