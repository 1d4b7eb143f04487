//! File formats against ASE, real files, and arbitrary input.

use std::fs::File;
use std::io::Write as _;
use std::path::{Path, PathBuf};
use std::process::Command;

use atoms::extxyz::{Column, ColumnData, ExtxyzReader, ExtxyzValue, Frame, write_frame};
use atoms::poscar::write_poscar;
use atoms::{Cell, Species, Structure, read_extxyz, read_structures};
use proptest::collection::{btree_map, vec};
use proptest::prelude::*;
use proptest::strategy::ValueTree as _;
use proptest::test_runner::TestRunner;
use serde_json::{Value, json};

fn data(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/data").join(name)
}

fn shared(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../../configs/data").join(name)
}

/// What ASE reads from files, if an interpreter is configured.
fn ase_reads(paths: &[PathBuf]) -> Option<Vec<Value>> {
    let Some(python) = std::env::var_os("CALMWALK_PYTHON") else {
        eprintln!("CALMWALK_PYTHON is not set: no comparison with ASE");
        return None;
    };
    let mut command = Command::new(python);
    let output = command
        .arg(data("ase_roundtrip.py"))
        .arg("dump")
        .args(paths)
        .env("PYTHONUTF8", "1")
        .output()
        .unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    Some(serde_json::from_slice(&output.stdout).unwrap())
}

fn real(value: f64) -> Value {
    match value {
        _ if value.is_finite() => json!(value),
        _ if value.is_nan() => json!("nan"),
        _ => json!(if value > 0.0 { "inf" } else { "-inf" }),
    }
}

fn to_json(value: &ExtxyzValue) -> Value {
    match value {
        ExtxyzValue::Bool(value) => json!(value),
        ExtxyzValue::Int(value) => json!(value),
        ExtxyzValue::Real(value) => real(*value),
        ExtxyzValue::Text(text) => json!(text),
        ExtxyzValue::List(values) => values.iter().map(to_json).collect(),
    }
}

/// Whether JSON has content without a value here, which stays text.
fn is_foreign(json: &Value) -> bool {
    match json {
        Value::Null | Value::Object(_) => true,
        Value::Array(items) => items.iter().any(is_foreign),
        _ => false,
    }
}

fn info_to_json(value: &ExtxyzValue) -> Value {
    let text = value.text().and_then(|text| text.strip_prefix("_JSON "));
    let foreign = text.and_then(|text| serde_json::from_str(text).ok()).filter(is_foreign);
    foreign.unwrap_or_else(|| to_json(value))
}

fn column_to_json(column: &Column) -> Value {
    let items: Vec<Value> = match &column.entries {
        ColumnData::Real(values) => values.iter().map(|value| real(*value)).collect(),
        ColumnData::Int(values) => values.iter().map(|value| json!(value)).collect(),
        ColumnData::Bool(values) => values.iter().map(|value| json!(value)).collect(),
        ColumnData::Text(values) => values.iter().map(|value| json!(value)).collect(),
    };
    if column.width == 1 { items.into() } else { items.chunks(column.width).map(Value::from).collect() }
}

/// Asserts the same bits and types, and nothing else.
fn assert_same(frame: &Frame, ase: &Value) {
    let structure = &frame.structure;
    let numbers: Vec<u8> = structure.species.iter().map(|species| species.atomic_number()).collect();
    assert_eq!(ase["numbers"], json!(numbers));
    assert_eq!(ase["positions"], json!(structure.positions));
    assert_eq!(ase["cell"], json!(structure.cell.0));
    assert_eq!(ase["pbc"], json!(structure.periodic));
    let mut free = vec![[true; 3]; structure.len()];
    let (mut given, mut results) = (serde_json::Map::new(), serde_json::Map::new());
    for (name, column) in &frame.arrays {
        match (name.as_str(), &column.entries) {
            ("move_mask", ColumnData::Bool(flags)) => {
                let row = |atom: usize| &flags[atom * column.width..(atom + 1) * column.width];
                free = (0..structure.len())
                    .map(|i| if let [a, b, c] = *row(i) { [a, b, c] } else { [row(i)[0]; 3] })
                    .collect();
            }
            ("forces" | "magmoms", _) => drop(results.insert(name.clone(), column_to_json(column))),
            _ => drop(given.insert(name.clone(), column_to_json(column))),
        }
    }
    assert_eq!(ase["free"], json!(free));
    assert_eq!(ase["arrays"], Value::Object(given));
    let mut info = serde_json::Map::new();
    for (key, value) in &frame.info {
        let numbers = value.numbers();
        match (key.as_str(), numbers.as_deref()) {
            ("stress", Some(&[xx, xy, xz, _, yy, yz, _, _, zz])) => {
                results.insert(key.clone(), json!([xx, yy, zz, yz, xz, xy]));
            }
            ("energy" | "free_energy", _) => drop(results.insert(key.clone(), to_json(value))),
            _ => drop(info.insert(key.clone(), info_to_json(value))),
        }
    }
    assert_eq!(ase["info"], Value::Object(info));
    assert_eq!(ase["results"], Value::Object(results));
}

fn assert_all_same(frames: &[Frame], ase: &[Value]) {
    assert_eq!(frames.len(), ase.len());
    for (frame, ase) in frames.iter().zip(ase) {
        assert_same(frame, ase);
    }
}

fn written(frames: &[Frame]) -> Vec<u8> {
    let mut text = Vec::new();
    for frame in frames {
        write_frame(&mut text, frame).unwrap();
    }
    text
}

/// Frames without their line numbers.
fn unnumbered(mut frames: Vec<Frame>) -> Vec<Frame> {
    frames.iter_mut().for_each(|frame| frame.line = 0);
    frames
}

fn read(text: &[u8]) -> Vec<Frame> {
    unnumbered(ExtxyzReader::new(text).collect::<Result<_, _>>().unwrap())
}

#[test]
fn files_of_ase_are_read_as_ase_reads_them() {
    let ase: Vec<Value> = serde_json::from_slice(&std::fs::read(data("ase_sample.json")).unwrap()).unwrap();
    let frames = read_extxyz(&data("ase_sample.extxyz")).unwrap();
    assert_all_same(&frames, &ase);
    assert_eq!(frames[0].labels().unwrap().energy, Some(-27.123456789012345));
    assert_eq!(frames[2].labels().unwrap().energy, Some(-14.2));
    let virial = frames[3].labels().unwrap().stress.unwrap();
    assert_eq!(virial[0][1], -0.5 / frames[3].structure.cell.volume());
}

#[test]
fn ase_reads_what_we_write() {
    let mut frames = read_extxyz(&data("ase_sample.extxyz")).unwrap();
    let mut runner = TestRunner::deterministic();
    frames.extend((0..300).map(|_| any_frame().new_tree(&mut runner).unwrap().current()));
    let mut file = tempfile::NamedTempFile::with_suffix(".extxyz").unwrap();
    file.write_all(&written(&frames)).unwrap();
    if let Some(ase) = ase_reads(&[file.path().to_owned()]) {
        assert_all_same(&frames, &ase);
    }
}

#[test]
fn ase_reads_the_poscar_that_we_write() {
    let directory = tempfile::tempdir().unwrap();
    let (mut frames, mut paths) = (Vec::new(), Vec::new());
    for frame in read_extxyz(&shared("aluminium_seeds.extxyz")).unwrap() {
        let name = frame.info["name"].text().unwrap();
        let path = directory.path().join(format!("POSCAR-{name}"));
        let order = write_poscar(&mut File::create(&path).unwrap(), &frame.structure, name).unwrap();
        assert!(order.into_iter().eq(0..frame.structure.len()));
        let again = read_structures(&path).unwrap().remove(0).structure;
        assert_eq!(again, Structure { periodic: [true; 3], ..frame.structure });
        frames.push(Frame::from(again));
        paths.push(path);
    }
    if let Some(ase) = ase_reads(&paths) {
        assert_all_same(&frames, &ase);
    }
}

#[test]
fn real_files_are_read_completely() {
    let mut files = vec![
        (shared("al_eam_1l/seed_frames.extxyz"), None),
        (shared("si_sw_1l/seed_frames.extxyz"), None),
        (shared("aluminium_seeds.extxyz"), None),
        (shared("silicon_seeds.extxyz"), None),
    ];
    if let Some(peer) = std::env::var_os("CALMWALK_PEER_DATA") {
        // Frames, atoms, and frames without a stress, as documented by the sources.
        for (name, counts) in [
            ("Cu_mlearn_test", (31, 3178, 0)),
            ("Mo_mlearn_test", (23, 1189, 0)),
            ("Mo_mlearn_train", (194, 10087, 0)),
            ("Si_mlearn_test", (25, 1525, 2)),
            ("Si_mlearn_train", (214, 13233, 5)),
            ("W_maml_test", (30, 1620, 0)),
            ("W_maml_train", (334, 11306, 0)),
        ] {
            files.push((Path::new(&peer).join(format!("datasets/{name}.xyz")), Some(counts)));
        }
    } else {
        eprintln!("CALMWALK_PEER_DATA is not set: the data sets are left out");
    }
    let mut all = Vec::new();
    for (path, counts) in &files {
        let frames = read_structures(path).unwrap();
        if let Some((number, atoms, without_stress)) = *counts {
            let labels: Vec<_> = frames.iter().map(|frame| frame.labels().unwrap()).collect();
            assert_eq!(frames.len(), number);
            assert_eq!(frames.iter().map(|frame| frame.structure.len()).sum::<usize>(), atoms);
            assert!(labels.iter().all(|labels| labels.energy.is_some() && labels.forces.is_some()));
            assert_eq!(labels.iter().filter(|labels| labels.stress.is_none()).count(), without_stress);
        }
        assert_eq!(read(&written(&frames)), unnumbered(frames.clone()));
        all.extend(frames);
    }
    let paths: Vec<_> = files.into_iter().map(|(path, _)| path).collect();
    if let Some(ase) = ase_reads(&paths) {
        assert_all_same(&all, &ase);
    }
}

#[test]
fn errors_tell_the_path() {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("a.xyz");
    std::fs::write(&path, "1\n\nXx 0 0 0\n").unwrap();
    let message = read_structures(&path).unwrap_err().to_string();
    assert!(
        message.starts_with(&format!("{}:3: field 1: unknown element 'Xx'", path.display())),
        "{message}"
    );
    std::fs::write(&path, "\n").unwrap();
    assert!(read_structures(&path).unwrap_err().to_string().contains("has no structures"));
    let unknown = read_structures(&directory.path().join("a.cif")).unwrap_err().to_string();
    assert!(unknown.contains("unknown format"), "{unknown}");
    assert!(
        read_structures(&directory.path().join("POSCAR"))
            .unwrap_err()
            .to_string()
            .contains("cannot be opened")
    );
}

#[test]
fn a_file_cut_after_any_line_is_an_error_unless_a_frame_ends_there() {
    let text = std::fs::read_to_string(data("ase_sample.extxyz")).unwrap();
    let starts: Vec<usize> = ExtxyzReader::new(text.as_bytes())
        .map(|frame| frame.unwrap().line)
        .chain([text.lines().count() + 1])
        .collect();
    let mut cut = String::new();
    for (number, line) in text.lines().enumerate() {
        let last = ExtxyzReader::new(cut.as_bytes()).last();
        let ends = starts.contains(&(number + 1));
        assert_eq!(last.is_none_or(|frame| frame.is_ok()), ends, "line {number}");
        cut += &format!("{line}\n");
    }
}

/// Texts that look like something else.
const ODD: &[&str] = &[
    "5",
    "1_000",
    "1e5",
    "T",
    "true",
    "1 2",
    "T F",
    "",
    " ",
    ",",
    "nan",
    "_JSON 5",
    "_JSON [1",
    "_JSON \"a\"",
    "_JSON null",
    "_JSON {\"a\": [1, null]}",
    "a\\",
    "\\\"",
    "[[1]]",
    "{",
    "a=b",
    "\n",
    "\u{1f600}é",
    "\t x",
    "infinity",
    "-",
    "0x1",
    "'",
    "\u{a0}",
    "_JSON",
    "1,2",
    "٣",
];

fn any_value() -> impl Strategy<Value = ExtxyzValue> {
    let real = || prop_oneof![any::<f64>().prop_filter("finite", |x| x.is_finite()), -10.0..10.0];
    let text =
        || prop_oneof![".{0,20}", "[ -~]{0,20}", proptest::sample::select(ODD).prop_map(str::to_owned)];
    let row = move |length| vec(real(), length);
    prop_oneof![
        any::<bool>().prop_map(ExtxyzValue::from),
        any::<i64>().prop_map(ExtxyzValue::from),
        real().prop_map(ExtxyzValue::from),
        text().prop_map(ExtxyzValue::from),
        vec(any::<bool>(), 0..5).prop_map(ExtxyzValue::from),
        vec(any::<i64>(), 0..5).prop_map(ExtxyzValue::from),
        vec(any::<f64>().prop_filter("a number", |x| !x.is_nan()), 2..5).prop_map(ExtxyzValue::from),
        vec(text(), 0..4).prop_map(ExtxyzValue::from),
        (1..4_usize, 0..4_usize).prop_flat_map(move |(n, m)| vec(row(m), n)).prop_map(ExtxyzValue::from),
        vec(vec(any::<bool>(), 2), 2).prop_map(ExtxyzValue::from),
        vec(vec(vec(any::<i64>(), 1), 2), 3).prop_map(ExtxyzValue::from),
        vec(vec(text(), 2), 2).prop_map(ExtxyzValue::from),
    ]
}

fn any_column(atoms: usize) -> impl Strategy<Value = Column> {
    let real = any::<f64>().prop_filter("a number", |x| !x.is_nan());
    (1..5_usize).prop_flat_map(move |width| {
        let length = width * atoms;
        let entries = prop_oneof![
            vec(real.clone(), length).prop_map(ColumnData::Real),
            vec(any::<i32>().prop_map(i64::from), length).prop_map(ColumnData::Int),
            vec(any::<bool>(), length).prop_map(ColumnData::Bool),
            vec("[!-~é]{1,8}", length).prop_map(ColumnData::Text),
        ];
        entries.prop_map(move |entries| Column { width, entries })
    })
}

fn any_structure() -> impl Strategy<Value = Structure> {
    let atom = (
        (1..=118_u8).prop_map(|z| Species::from_atomic_number(z).unwrap()),
        proptest::array::uniform3(-1e3..1e3),
    );
    let off_diagonal = proptest::array::uniform6(-1.0..1.0);
    (vec(atom, 1..6), proptest::array::uniform3(4.0..20.0), off_diagonal, any::<[bool; 3]>(), any::<bool>())
        .prop_map(|(atoms, [a, b, c], [d, e, f, g, h, i], periodic, cell)| {
            let (species, positions) = atoms.into_iter().unzip();
            let rows = if cell || periodic != [false; 3] {
                [[a, d, e], [f, b, g], [h, i, c]]
            } else {
                [[0.0; 3]; 3]
            };
            Structure { species, positions, cell: Cell(rows), periodic }
        })
}

fn any_frame() -> impl Strategy<Value = Frame> {
    any_structure().prop_flat_map(|structure| {
        let arrays = btree_map("[a-z]{4,8}", any_column(structure.len()), 0..4);
        let info = btree_map(r#"[A-Za-z_][A-Za-z0-9_. ='"\[{\\,:é-]{3,8}"#, any_value(), 0..6);
        (Just(structure), info, arrays).prop_map(|(structure, info, arrays)| Frame {
            structure,
            info,
            arrays,
            line: 0,
        })
    })
}

proptest! {
    #[test]
    fn reading_gives_back_what_was_written(frames in vec(any_frame(), 1..4)) {
        prop_assert_eq!(read(&written(&frames)), frames);
    }

    #[test]
    fn random_bytes_never_panic(bytes in vec(any::<u8>(), 0..300)) {
        prop_assert!(ExtxyzReader::new(bytes.as_slice()).count() <= bytes.len());
    }

    #[test]
    fn random_comments_never_panic(comment in r#"([A-Za-z:=+"'\[\]{}\\,. 0-9_-]|Lattice=|Properties=|pbc=|stress=|\[\[){0,40}"#) {
        let text = format!("1\n{comment}\nAl 0 0 0\n");
        if let Some(Ok(frame)) = ExtxyzReader::new(text.as_bytes()).next() {
            let mut again = Vec::new();
            if write_frame(&mut again, &frame).is_ok() {
                prop_assert_eq!(read(&again), unnumbered(vec![frame]));
            }
        }
    }

    #[test]
    fn damaged_files_never_panic(cut in 0..5000_usize, at in 0..5000_usize, byte in any::<u8>()) {
        let mut bytes = std::fs::read(data("ase_sample.extxyz")).unwrap();
        bytes.truncate(cut);
        if let Some(place) = bytes.get_mut(at) {
            *place = byte;
        }
        prop_assert!(ExtxyzReader::new(bytes.as_slice()).count() <= 6);
    }
}
