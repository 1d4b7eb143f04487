//! Broken EAM and Stillinger–Weber files: each error states what is wrong and where.

use std::fs;

use potentials::{Eam, EamStyle, PotentialFileError, StillingerWeber};

const HERE: &str = env!("CARGO_MANIFEST_DIR");

fn two_metals() -> String {
    fs::read_to_string(format!("{HERE}/tests/data/two_elements.eam.fs")).unwrap()
}

fn silicon_carbide() -> String {
    fs::read_to_string(format!("{HERE}/tests/data/two_elements.sw")).unwrap()
}

fn load_eam(text: &str) -> Result<Eam, PotentialFileError> {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("broken.eam.fs");
    fs::write(&path, text).unwrap();
    Eam::load(path)
}

fn load_sw(text: &str) -> Result<StillingerWeber, PotentialFileError> {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("broken.sw");
    fs::write(&path, text).unwrap();
    StillingerWeber::load(path)
}

/// `text` with the line of that number (from 1) replaced.
fn with_line(text: &str, number: usize, line: &str) -> String {
    let mut lines: Vec<&str> = text.lines().collect();
    lines[number - 1] = line;
    lines.join("\n")
}

/// Asserts an error that names this line and contains these words.
fn assert_error<T>(result: Result<T, PotentialFileError>, line: usize, words: &[&str]) {
    let Err(error) = result else { panic!("no error, expected {words:?} in line {line}") };
    let message = error.to_string();
    assert!(message.contains(&format!("line {line}:")), "{message}");
    for word in words {
        assert!(message.contains(word), "'{word}' is not in: {message}");
    }
}

#[test]
fn a_missing_file_is_named() {
    for error in [
        Eam::load("nowhere/to.be.fs").map(|_| ()).unwrap_err(),
        StillingerWeber::load("nowhere/to.be.fs").map(|_| ()).unwrap_err(),
    ] {
        assert!(matches!(error, PotentialFileError::Read { .. }));
        assert!(error.to_string().contains("nowhere/to.be.fs"), "{error}");
    }
}

#[test]
fn a_setfl_file_cut_after_any_line_is_refused() {
    let text = two_metals();
    let lines: Vec<&str> = text.lines().collect();
    assert!(load_eam(&text).is_ok());
    for kept in 0..lines.len() {
        assert_error(load_eam(&lines[..kept].join("\n")), kept, &["the end of the file"]);
    }
}

#[test]
fn wrong_headers_of_a_setfl_file_are_refused() {
    let text = two_metals();
    for (line, wrong, words) in [
        (4, "3 Al Cu", ["3 Al Cu", "number of elements"]),
        (4, "2", ["'2'", "number of elements"]),
        (4, "0", ["'0'", "number of elements"]),
        (4, "Al Cu", ["'Al Cu'", "number of elements"]),
        (4, "2 Al Xx", ["'Xx'", "symbol of an element"]),
        (4, "2 Al Al", ["Al twice", "once"]),
        (5, "40 0.25 81 0.065", ["the end of the line", "cutoff"]),
        (5, "40 -0.25 81 0.065 5.2", ["-0.25", "drho"]),
        (5, "40 0.25 81 NaN 5.2", ["NaN", "dr"]),
        (5, "4 0.25 81 0.065 5.2", ["'4'", "nrho"]),
        (5, "40 0.25 8.5 0.065 5.2", ["'8.5'", "nr"]),
        (5, "-40 0.25 81 0.065 5.2", ["'-40'", "nrho"]),
        (5, "40 0.25 81 0.065 6.2", ["6.2", "5.265"]),
        (6, "Al 26.98 4.05 fcc", ["Al 26.98", "atomic-number"]),
        (6, "13", ["the end of the line", "atomic-number"]),
    ] {
        assert_error(load_eam(&with_line(&text, line, wrong)), line, &words);
    }
}

#[test]
fn wrong_counts_of_a_setfl_file_are_refused() {
    let text = two_metals();
    assert_error(load_eam(&with_line(&text, 5, "35 0.25 81 0.065 5.2")), 30, &["85", "81"]);
    assert_error(load_eam(&with_line(&text, 5, "40 0.25 86 0.065 5.2")), 49, &["'fcc'", "density"]);
    assert_error(load_eam(&with_line(&text, 5, "38 0.25 81 0.065 5.2")), 14, &["40", "38"]);
    assert_error(load_eam(&with_line(&text, 5, "40 0.25 999999999999 0.065 5.2")), 49, &["'fcc'"]);
    assert_error(
        load_eam(&format!("{text}1.0 2.0\n")),
        text.lines().count() + 1,
        &["1.0 2.0", "end of the file"],
    );
    assert!(load_eam(&format!("{text}\n \n")).is_ok());
}

#[test]
fn wrong_values_of_a_setfl_file_are_refused() {
    let text = two_metals();
    for wrong in ["NaN", "inf", "1.0e999", "1.0.0", "x"] {
        assert_error(
            load_eam(&with_line(&text, 7, &format!("0 1 2 {wrong} 4"))),
            7,
            &[wrong, "embedding energy"],
        );
    }
    assert!(load_eam(&text.replace("Made-up", "\u{fffd}")).is_ok());
}

/// An alloy file has the next element where a Finnis–Sinclair file has densities of other pairs, and vice
/// versa.
#[test]
fn the_wrong_style_is_found_out() {
    let path = format!("{HERE}/tests/data/two_elements.eam.fs");
    assert_error(Eam::load_as(&path, EamStyle::Alloy), 32, &["atomic-number", "Alloy"]);
}

#[test]
fn an_sw_file_cut_after_any_line_is_refused() {
    let text = silicon_carbide();
    let lines: Vec<&str> = text.lines().collect();
    assert!(load_sw(&text).is_ok());
    for kept in 0..lines.len() {
        // The first entry alone is a complete file of one element.
        if (4..=5).contains(&kept) {
            assert!(load_sw(&lines[..kept].join("\n")).is_ok());
        } else {
            assert_error(load_sw(&lines[..kept].join("\n")), kept, &[]);
        }
    }
}

#[test]
fn wrong_entries_of_an_sw_file_are_refused() {
    let text = silicon_carbide();
    for (line, wrong, at, words) in [
        (3, "Si Si Xx 2.1683 2.0951 1.80 21.0 1.20 -0.333", 3, ["'Xx'", "symbol of an element"]),
        (3, "Si Si Si 2.1683 NaN 1.80 21.0 1.20 -0.333", 4, ["'NaN'", "sigma"]),
        (3, "Si Si Si 2.1683 -2.0 1.80 21.0 1.20 -0.333", 4, ["-2", "sigma"]),
        (3, "Si Si Si 2.1683 2.0 1.80 21.0 1.20 -0.333 7.0", 4, ["15 words", "14"]),
        (3, "Si Si 2.1683 2.0951 1.80 21.0 1.20 -0.333", 6, ["21 words", "14"]),
        (9, "Si Si C  2.3 1.75 1.85 23.0 1.1 -0.3  7.5 0.62 4.2 0.0 0.001", 11, ["second entry", "line 9"]),
        (10, "C Si Si 2.3 1.75 1.86 20.0 1.3 -0.2  7.5 0.62 4.2 0.0 0.001", 10, ["two-body", "line 9"]),
        (10, "C Si Si 2.3 1.75 1.85 20.0 0.9 -0.2  7.5 0.62 4.2 0.0 0.001", 10, ["range", "line 9"]),
        (12, "Si C Si 2.2 0.0 0.0 22.0 0.0 -0.36 0.0 0.0 0.0 0.0 0.0", 12, ["costheta0", "line 11"]),
        (14, "# left out", 14, ["'C Si C'", "triplet"]),
    ] {
        assert_error(load_sw(&with_line(&text, line, wrong)), at, &words);
    }
    assert_error(load_sw("# nothing\n\n"), 2, &["no entry"]);
}
