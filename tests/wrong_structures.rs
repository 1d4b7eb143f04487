//! Wrong seed structures: refused with file and line before any walk starts.

use std::fmt::Write;
use std::fs;

use store::Location;

use crate::common::campaign::Small;
use crate::common::config_tester::{ConfigTester, changed, line};
use crate::common::label_campaign::on_store;
use crate::common::{calmwalk, config, refuse, stderr, succeed};

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

/// A tester whose demo reads its seed structures from another file.
struct SeedStructureFiles {
    tester: ConfigTester,
    files: String,
    at: String,
}

impl SeedStructureFiles {
    fn new() -> Self {
        let files = config("data/aluminium_seeds.extxyz").display().to_string();
        let at = format!("c.toml:{}: seed_structures.files: ", line(&files));
        Self { tester: ConfigTester::new(), files, at }
    }

    fn refused(&self, name: &str, content: impl AsRef<[u8]>, words: &[&str]) {
        self.tester.write(name, content);
        let words: Vec<_> = [self.at.as_str(), name].into_iter().chain(words.iter().copied()).collect();
        self.tester.refused_with(&self.files, name, &words);
    }
}

#[test]
fn broken_extended_xyz_is_refused_with_its_line() {
    let seeds = SeedStructureFiles::new();
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
    let seeds = SeedStructureFiles::new();
    let good = good();
    let alone = good.replacen("27", "28", 1).replace("8.4", "40") + "Al 20 20 20\n";
    let crowded = format!("1\n{} Properties=species:S:1:pos:R:3\nAl 0 0 0\n", CELL.replace("8.4", "0.5"));
    for (content, words) in [
        (
            good.replace("Al 2.8 2.8 2.8", "Cu 2.8 2.8 2.8"),
            ":1: atom 13 is Cu, which the potential does not support (it supports Al)",
        ),
        (
            good.replace("Al 2.8 2.8 2.8", "Al 2.8 2.8 0.1"),
            ":1: the shortest Al-Al distance is 0.100 Å, below the 1.210 Å that guard.min_distances allows",
        ),
        (good.replace("Al 2.8 2.8 2.8", "Al 2.8 2.8 0"), "(atoms 12 and 13 are 0.000 Å apart)"),
        (crowded, "(atoms 0 and 0 are 0.500 Å apart)"),
        (good.replace("0 0 8.4\"", "0 8.4 0\""), ":1: the cell is periodic but its volume is 0"),
        (good.replace(CELL, "pbc=\"T T T\""), ":1: the cell is periodic but its volume is 0"),
        (alone, ":1: atom 27 has no neighbour within the cutoff, 6.5 Å"),
    ] {
        seeds.refused("unfit.extxyz", content, &[words]);
    }
}

/// The campaign runs with the other structures, unless the configuration requires all.
#[test]
fn a_structure_that_no_walk_can_start_from_is_skipped_and_listed() {
    let seeds = SeedStructureFiles::new();
    let crowded = good().replace("Al 2.8 2.8 2.8", "Al 2.8 2.8 0.1");
    seeds.tester.write("mixed.extxyz", good() + &crowded);
    let text = changed(&seeds.files, "mixed.extxyz");
    seeds.tester.write("c.toml", &text);
    let output = calmwalk(seeds.tester.path(), ["validate", "c.toml"]);
    let (shown, listed) = (String::from_utf8_lossy(&output.stdout), stderr(&output));
    assert_eq!(output.status.code(), Some(0), "{listed}");
    assert!(shown.contains("seed structures  1, with 27 to 27 atoms; 1 skipped, see above"), "{shown}");
    let expected =
        "seed structure 'mixed-1' (mixed.extxyz:30) is skipped: the shortest Al-Al distance is 0.100 Å";
    assert!(listed.contains(expected), "{listed}");
    let text = text.replace("# on_invalid = \"skip\"", "on_invalid = \"error\"");
    let message = seeds.tester.refused(&text);
    assert!(message.contains("mixed.extxyz:30: the shortest Al-Al distance is 0.100 Å"), "{message}");
}

#[test]
fn seed_structures_need_names_of_their_own() {
    let seeds = SeedStructureFiles::new();
    let named = good().replace("Properties", "name=bulk Properties");
    let words =
        ":30: a second seed structure named 'bulk', the first is two.extxyz:1; give each a unique name";
    seeds.refused("two.extxyz", named.repeat(2), &[words]);
}

#[test]
fn other_files_are_refused() {
    let seeds = SeedStructureFiles::new();
    seeds.refused(
        "seeds.txt",
        good(),
        &["unknown format: expected a name ending in .extxyz, .xyz, .poscar or .vasp"],
    );
    seeds.refused("POSCAR", "bulk\n1.0\n8.4 0 0\n", &["POSCAR:4: the file ends here, expected"]);
    seeds.refused("seeds.extxyz", "Si.sw\n", &["seeds.extxyz:1: found 'Si.sw'"]);
    seeds.tester.refused_with(
        &seeds.files,
        "absent.extxyz",
        &[&seeds.at, "absent.extxyz: cannot be opened: No such file"],
    );
    seeds.tester.refused_with(
        &seeds.files,
        ".",
        &[&seeds.at, ".: cannot be opened: it is a directory; expected a file"],
    );
}

#[test]
fn structures_from_which_nothing_can_be_collected_are_refused() {
    let seeds = SeedStructureFiles::new();
    let two =
        format!("2\n{} Properties=species:S:1:pos:R:3\nAl 0 0 0\nAl 2.8 0 0\n", CELL.replace("8.4", "5.6"));
    let words = ":1: the structure has 2 atoms, fewer than the 3 that must be new at once (collect.criterion.min_atoms)";
    seeds.refused("two.extxyz", two, &[words]);
    let cluster = good().replace(CELL, "pbc=\"F F F\"");
    let words =
        ":1: the structure has no periodic direction, and so no volume for walk.volume_ramp to change";
    seeds.refused("cluster.extxyz", &cluster, &[words]);
    // Without a volume ramp it needs no cell.
    seeds.tester.write("c.toml", changed(&seeds.files, "cluster.extxyz").replace("volume_ramp = ", "# "));
    succeed(seeds.tester.path(), ["validate", "c.toml"]);
}

/// The commented keys of the demo with these values.
fn enlarged(text: &str, min_atoms: &str, min_height: &str) -> String {
    let (atoms, height) = ("# min_atoms = 32 ", "# min_height = 10.0 ");
    assert!(text.contains(atoms) && text.contains(height));
    text.replace(atoms, &format!("min_atoms = {min_atoms} "))
        .replace(height, &format!("min_height = {min_height} "))
}

#[test]
fn small_cells_become_supercells() {
    let seeds = SeedStructureFiles::new();
    let primitive = "1\nLattice=\"0 2.025 2.025 2.025 0 2.025 2.025 2.025 0\" Properties=species:S:1:pos:R:3 name=fcc\nAl 0 0 0\n";
    seeds.tester.write("small.extxyz", format!("{primitive}{}", good()));
    let small = changed(&seeds.files, "small.extxyz");
    let validate = |text: &str| {
        seeds.tester.write("c.toml", text);
        succeed(seeds.tester.path(), ["validate", "c.toml"])
    };
    // Its faces are 2.34 Å apart.
    let valid = validate(&enlarged(&small, "1", "8.0"));
    assert!(valid.contains("supercells       1 of 2 seed structures: 'fcc' 4 × 4 × 4 (64 atoms)"), "{valid}");
    let valid = validate(&enlarged(&small, "40", "6.0"));
    let expected =
        "supercells       2 of 2 seed structures: 'fcc' 4 × 4 × 3 (48 atoms), 'small-1' 2 × 1 × 1 (54 atoms)";
    assert!(valid.contains(expected), "{valid}");
    assert!(
        !validate(&enlarged(
            &small
                .replace(" min_atoms = 3 ", " min_atoms = 1 ")
                .replace(" min_atoms = 3,", " min_atoms = 1,"),
            "1",
            "1.0"
        ))
        .contains("supercells")
    );
    // Clusters are not repeated, and supercells that are too large are refused.
    let cluster = good().replace(CELL, "pbc=\"F F F\"");
    seeds.tester.write("cluster.extxyz", &cluster);
    let cluster = changed(&seeds.files, "cluster.extxyz").replace("volume_ramp = ", "# ");
    assert!(!validate(&enlarged(&cluster, "100", "50.0")).contains("supercells"));
    seeds.tester.write("small.extxyz", primitive);
    let message = seeds.tester.refused(enlarged(&small, "1", "200.0"));
    let expected = "ask for a supercell of 86 × 86 × 86 cells with 636056 atoms, more than 100000";
    assert!(message.contains(expected), "{message}");
}

/// A campaign cannot change its seed structures, and thus not their repetition.
#[test]
fn a_campaign_keeps_its_supercells() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    Small::default().write(here);
    let text = fs::read_to_string(here.join("campaign.toml")).unwrap();
    let with = |min_atoms: u32| {
        let enlarged =
            text.replace("[seed_structures]", &format!("[seed_structures]\nmin_atoms = {min_atoms}"));
        fs::write(here.join("campaign.toml"), enlarged).unwrap();
    };
    with(40);
    let output = calmwalk(here, ["run", "campaign.toml"]);
    let said = stderr(&output);
    assert_eq!(output.status.code(), Some(0), "{said}");
    assert!(said.contains("supercells: 1 of 2 seed structures: "), "{said}");
    let seeds = on_store(Location::from(&*here.join("campaign")), async |store| {
        store.seed_structures().await.unwrap()
    });
    assert_eq!((seeds[0].structure.len(), seeds[1].structure.len()), (64, 47));
    assert!(seeds[0].source.ends_with(":1, 2 × 1 × 1 supercell"), "{}", seeds[0].source);
    assert!(!seeds[1].source.contains("supercell"));
    with(70);
    let message = refuse(here, ["run", "campaign.toml"]);
    assert!(
        message.contains("seed structure 0 is")
            && message.contains("min_atoms and min_height, or start another"),
        "{message}"
    );
}

/// The demo without labels held out: of one seed structure, none would be, which is warned of.
fn none_held_out(text: &str) -> String {
    assert!(text.contains("\nheld_out = 0.2"));
    text.replacen("\nheld_out = 0.2", "\nheld_out = 0.0", 1)
}

/// Warnings of `validate` for a valid campaign with these seed structures.
fn warnings(seeds: &SeedStructureFiles, name: &str, content: impl AsRef<[u8]>) -> Vec<String> {
    seeds.tester.write(name, content);
    seeds.tester.write("c.toml", none_held_out(&changed(&seeds.files, name)));
    let output = calmwalk(seeds.tester.path(), ["validate", "c.toml"]);
    assert_eq!(output.status.code(), Some(0), "{}", stderr(&output));
    stderr(&output).lines().map(str::to_owned).collect()
}

#[test]
fn the_same_structure_twice_is_warned_of() {
    let seeds = SeedStructureFiles::new();
    let other = good().replace("Al 2.8 2.8 2.8", "Al 2.8 2.8 2.81");
    // The same structure within the tolerance.
    let again = good().replace("Al 2.8 2.8 2.8", "Al 2.80000001 2.8 2.8");
    let found = warnings(&seeds, "three.extxyz", format!("{}{other}{again}", good()));
    let [warning] = found.as_slice() else { panic!("{found:?}") };
    let words = "seed structure 'three-2' (three.extxyz:59) is the same as 'three-0' (three.extxyz:1)";
    assert!(warning.starts_with(&format!("WARNING: {}", seeds.at)) && warning.contains(words), "{warning}");
}

#[test]
fn lengths_in_bohr_are_warned_of() {
    let seeds = SeedStructureFiles::new();
    let scaled = |factor: f64| {
        let mut text = format!(
            "27\n{} Properties=species:S:1:pos:R:3\n",
            CELL.replace("8.4", &(8.4 * factor).to_string())
        );
        for atom in 0..27_u8 {
            let [x, y, z] = [atom / 9, atom / 3 % 3, atom % 3].map(|place| 2.8 * factor * f64::from(place));
            writeln!(text, "Al {x} {y} {z}").unwrap();
        }
        text
    };
    assert_eq!(warnings(&seeds, "angstrom.extxyz", scaled(1.0)), [""; 0]);
    for (factor, words) in [
        (
            1.8897,
            "nearest neighbours are 5.29 Å apart, 2.12 times the sum of their radii, at 0.30 g/cm³: are positions and cell in Bohr?",
        ),
        (0.5292, "nearest neighbours are 1.48 Å apart, 0.59 times the sum of their radii"),
    ] {
        let found = warnings(&seeds, "bohr.extxyz", scaled(factor));
        // Ignore the warning about a repulsion that reaches into these bonds.
        let near: Vec<_> = found.iter().filter(|warning| warning.contains("nearest neighbours")).collect();
        let [warning] = near.as_slice() else { panic!("{found:?}") };
        assert!(
            warning.contains("seed structure 'bohr-0' (bohr.extxyz:1): ") && warning.contains(words),
            "{warning}"
        );
    }
}

#[test]
fn the_good_structure_is_good() {
    let seeds = SeedStructureFiles::new();
    seeds.tester.write("good.extxyz", good());
    seeds.tester.write("c.toml", changed(&seeds.files, "good.extxyz"));
    let valid = succeed(seeds.tester.path(), ["validate", "c.toml"]);
    assert!(valid.contains("seed structures  1, with 27 to 27 atoms"), "{valid}");
}

/// The ZBL window of aluminium, 2.42 Å times the fractions, reaches into the bonds of 2.8 Å.
#[test]
fn a_repulsion_that_reaches_into_bonds_is_shown_and_warned_of() {
    let seeds = SeedStructureFiles::new();
    seeds.tester.write("good.extxyz", good());
    let validate = |inner: f64, outer: f64| {
        let windows = format!("zbl = {{ rule = \"per_pair\", inner = {inner}, outer = {outer} }} #");
        let text = changed(&seeds.files, "good.extxyz").replace("zbl = ", &windows);
        seeds.tester.write("c.toml", none_held_out(&text));
        let output = calmwalk(seeds.tester.path(), ["validate", "c.toml"]);
        assert_eq!(output.status.code(), Some(0), "{}", stderr(&output));
        let shown = String::from_utf8(output.stdout.clone()).unwrap();
        let mut rows = shown.lines().skip_while(|line| !line.starts_with("pair "));
        let titles = rows.next().unwrap().split("  ").map(str::trim).filter(|title| !title.is_empty());
        let expected = [
            "pair",
            "sum of radii (Å)",
            "shortest (Å)",
            "guard (Å)",
            "ZBL full below (Å)",
            "ZBL zero above (Å)",
        ];
        assert_eq!(titles.collect::<Vec<_>>(), expected, "{shown}");
        let cells = rows.next().unwrap().split_whitespace().map(str::to_owned);
        (cells.collect::<Vec<_>>(), stderr(&output))
    };
    let (cells, said) = validate(0.9, 1.25);
    assert_eq!(cells, ["Al-Al", "2.42", "2.800", "2.100", "2.178", "3.025"]);
    let expected = [
        "guard.zbl: the repulsion reaches into bonds of seed structures: ",
        "Al-Al reaches to 3.025 Å and changes distances of 2.800 Å in 'good-0'",
        "give these pairs shorter windows in guard.zbl.pairs",
    ];
    assert!(expected.iter().all(|words| said.contains(words)), "{said}");
    let (cells, said) = validate(0.55, 0.75);
    assert_eq!((cells[4].as_str(), cells[5].as_str(), said.as_str()), ("1.331", "1.815", ""));
}
