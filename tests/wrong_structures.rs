//! Wrong seed structures: refused with file and line before any walk begins.

mod common;

use std::fmt::Write;

use common::config;
use common::desk::{Desk, line};
use common::succeed;

const CELL: &str = "Lattice=\"8.4 0 0 0 8.4 0 0 0 8.4\"";

/// 27 atoms of simple cubic aluminium; its first atom is on line 3, the one at (2.8, 2.8, 2.8) on line 16.
fn good() -> String {
    let mut text = format!("27\n{CELL} Properties=species:S:1:pos:R:3\n");
    let places = [0.0, 2.8, 5.6];
    for x in places {
        for y in places {
            for z in places {
                writeln!(text, "Al {x} {y} {z}").unwrap();
            }
        }
    }
    text
}

/// A desk whose demo takes its seed structures from `name`.
struct Seeds {
    desk: Desk,
    files: String,
    at: String,
}

impl Seeds {
    fn new() -> Self {
        let files = config("data/aluminium_seeds.extxyz").display().to_string();
        let at = format!("c.toml:{}: seeds.files: ", line(&files));
        Self { desk: Desk::new(), files, at }
    }

    fn refused(&self, name: &str, content: impl AsRef<[u8]>, words: &[&str]) {
        self.desk.write(name, content);
        let words: Vec<_> = [self.at.as_str(), name].into_iter().chain(words.iter().copied()).collect();
        self.desk.refused_with(&self.files, name, &words);
    }
}

#[test]
fn broken_extended_xyz_is_refused_with_its_line() {
    let seeds = Seeds::new();
    let good = good();
    let other = |from: &str, to: &str| {
        assert!(good.contains(from));
        good.replacen(from, to, 1)
    };
    for (content, words) in [
        (other("27", "x27"), ":1: found 'x27', expected the number of atoms of a frame"),
        (other("27", "28"), ":30: the file ends after 27 of the 28 atoms of the frame at line 1"),
        (other("27", "26"), ":29: found 'Al 5.6 5.6 5.6', expected the number of atoms of a frame"),
        (other("27", "99999999999999999"), "the file ends after 27 of the 99999999999999999 atoms"),
        (
            other("Al 2.8 2.8 2.8", "Al 2.8 nan 2.8"),
            ":16: field 3 (pos): found 'nan', expected a finite number",
        ),
        (
            other("Al 2.8 2.8 2.8", "Al 2.8 2.8x 2.8"),
            ":16: field 3 (pos): found '2.8x', expected a finite number",
        ),
        (other("Al 2.8 2.8 2.8", "Xx 2.8 2.8 2.8"), ":16: field 1: unknown element 'Xx'"),
        (other("8.4 0 0 0", "8.4 0 zero 0"), "Lattice is '8.4 0 zero 0 8.4 0 0 0 8.4'"),
        (other(CELL, "Lattice=\"8.4 0 0"), ":2: column"),
        (format!("{good}{}", &good[..good.len() - 20]), ":57: found 3 fields, expected 4"),
        (String::new(), "the file has no structures, expected at least one"),
        (format!("0\n{CELL} Properties=species:S:1:pos:R:3\n"), ":1: the structure has no atoms"),
    ] {
        seeds.refused("broken.extxyz", content, &[words]);
    }
    let binary: Vec<u8> = (0..=255).collect();
    seeds.refused("broken.extxyz", binary, &["broken.extxyz:"]);
}

#[test]
fn structures_that_no_walk_can_start_from_are_refused() {
    let seeds = Seeds::new();
    let good = good();
    let alone = good.replacen("27", "28", 1).replace("8.4", "40") + "Al 20 20 20\n";
    let crowded = format!("1\n{} Properties=species:S:1:pos:R:3\nAl 0 0 0\n", CELL.replace("8.4", "0.5"));
    for (content, words) in [
        (
            good.replace("Al 2.8 2.8 2.8", "Cu 2.8 2.8 2.8"),
            ":1: atom 13 is Cu, which the potential does not know (it knows Al)",
        ),
        (
            good.replace("Al 2.8 2.8 2.8", "Al 2.8 2.8 0.1"),
            ":1: atoms 12 and 13 are 0.100 Å apart, closer than guard.least_distance = 1.2 Å",
        ),
        (good.replace("Al 2.8 2.8 2.8", "Al 2.8 2.8 0"), ":1: atoms 12 and 13 are 0.000 Å apart"),
        (crowded, ":1: atoms 0 and 0 are 0.500 Å apart"),
        (good.replace("0 0 8.4\"", "0 8.4 0\""), ":1: the cell is periodic but its volume is 0"),
        (good.replace(CELL, "pbc=\"T T T\""), ":1: the cell is periodic but its volume is 0"),
        (alone, ":1: atom 27 has no neighbour within the cutoff, 6.5 Å"),
    ] {
        seeds.refused("unfit.extxyz", content, &[words]);
    }
}

#[test]
fn seed_structures_need_names_of_their_own() {
    let seeds = Seeds::new();
    let named = good().replace("Properties", "name=bulk Properties");
    let words = ":30: a second seed structure named 'bulk', the first is two.extxyz:1; give each a name";
    seeds.refused("two.extxyz", named.repeat(2), &[words]);
}

#[test]
fn other_files_are_refused() {
    let seeds = Seeds::new();
    seeds.refused(
        "seeds.txt",
        good(),
        &["unknown format: expected a name ending in .extxyz, .xyz, .poscar or .vasp"],
    );
    seeds.refused("POSCAR", "bulk\n1.0\n8.4 0 0\n", &["POSCAR:4: the file ends here, expected"]);
    seeds.refused("seeds.extxyz", "Si.sw\n", &["seeds.extxyz:1: found 'Si.sw'"]);
    seeds.desk.refused_with(
        &seeds.files,
        "absent.extxyz",
        &[&seeds.at, "absent.extxyz: cannot be opened: No such file"],
    );
    seeds.desk.refused_with(&seeds.files, ".", &[&seeds.at, "unknown format"]);
}

#[test]
fn the_good_structure_is_good() {
    let seeds = Seeds::new();
    seeds.desk.write("good.extxyz", good());
    seeds.desk.write("c.toml", common::desk::changed(&seeds.files, "good.extxyz"));
    let valid = succeed(seeds.desk.path(), ["validate", "c.toml"]);
    assert!(valid.contains("seed structures  1, of 27 to 27 atoms"), "{valid}");
}
