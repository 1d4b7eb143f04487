use super::*;
use crate::cell::Cell;

fn frames(text: &str) -> Result<Vec<Frame>, ExtxyzError> {
    ExtxyzReader::new(text.as_bytes()).collect()
}

fn only(text: &str) -> Frame {
    let mut frames = frames(text).unwrap();
    assert_eq!(frames.len(), 1);
    frames.remove(0)
}

fn info(comment: &str) -> BTreeMap<String, ExtxyzValue> {
    only(&format!("1\n{comment}\nAl 0 0 0\n")).info
}

/// Writes frames, reads them and writes them again.
fn rewritten(frame: &Frame) -> String {
    let mut text = Vec::new();
    write_frame(&mut text, frame).unwrap();
    String::from_utf8(text).unwrap()
}

#[test]
fn plain_xyz_has_no_cell_and_more_columns_do_not_matter() {
    let frame = only("2\nCubic bulk, it's free text\nal 0 0 0 0.5\nAL 1 2 3e0\n\n\n");
    assert_eq!(frame.structure.formula(), "Al2");
    assert_eq!(frame.structure.positions[1], [1.0, 2.0, 3.0]);
    assert_eq!(frame.structure.cell, Cell([[0.0; 3]; 3]));
    assert_eq!(frame.structure.periodic, [false; 3]);
    assert_eq!(frame.info["Cubic"], ExtxyzValue::Bool(true));
}

#[test]
fn columns_of_every_type_in_any_order() {
    let comment = r#"Properties=pos:R:3:tags:I:1:Z:I:1:mask:L:2:site:S:1:v:R:2 Lattice="1 2 3 0 5 6 0 0 9""#;
    let frame = only(&format!("1\n{comment}\n0 1 2 -7 14 T False a1 1e-3 nan\n"));
    assert_eq!(frame.structure.formula(), "Si");
    assert_eq!(frame.structure.cell.0, [[1.0, 2.0, 3.0], [0.0, 5.0, 6.0], [0.0, 0.0, 9.0]]);
    assert_eq!(frame.structure.periodic, [true; 3]);
    assert_eq!(frame.arrays["tags"], Column { width: 1, entries: ColumnData::Int(vec![-7]) });
    assert_eq!(frame.arrays["mask"], Column { width: 2, entries: ColumnData::Bool(vec![true, false]) });
    assert_eq!(frame.arrays["site"].entries, ColumnData::Text(vec!["a1".to_owned()]));
    let reals = frame.arrays["v"].reals().unwrap();
    assert!(reals[0] == 1e-3 && reals[1].is_nan());
    assert_eq!(frame.arrays.len(), 4);
}

#[test]
fn atomic_numbers_go_before_symbols() {
    let frame = only("1\nProperties=species:S:1:pos:R:3:numbers:I:1\nAl1 0 0 0 13\n");
    assert_eq!(frame.structure.formula(), "Al");
    assert!(frame.arrays.is_empty());
}

#[test]
fn values_of_every_type() {
    let info = info(
        r#"i=-3 r=1e2 t=abc flag b=F q="two words" s='a "b"' old={1 2 3} list=[1,2.5] e="\"x\" \\" spaced = 4
        bools="T T F" json="_JSON [[1, 2], [3, 4]]" bare=[[1.5, 2], [3, 4]] object="_JSON {\"a\": 1}"
        words="_JSON [\"a\", \"b\"]" empty="" uid=12 a=b=c ju"ne x"=5 commas=1,2 "#
            .replace('\n', " ")
            .as_str(),
    );
    let expected: [(&str, ExtxyzValue); 20] = [
        ("i", (-3).into()),
        ("r", 100.0.into()),
        ("t", "abc".into()),
        ("flag", true.into()),
        ("b", false.into()),
        ("q", "two words".into()),
        ("s", "a \"b\"".into()),
        ("old", vec![1, 2, 3].into()),
        ("list", vec![1.0, 2.5].into()),
        ("e", "\"x\" \\".into()),
        ("spaced", 4.into()),
        ("bools", vec![true, true, false].into()),
        ("json", vec![vec![1, 2], vec![3, 4]].into()),
        ("bare", ExtxyzValue::List(vec![ExtxyzValue::List(vec![1.5.into(), 2.into()]), vec![3, 4].into()])),
        ("object", "_JSON {\"a\": 1}".into()),
        ("words", vec!["a", "b"].into()),
        ("empty", "".into()),
        ("uid", "12".into()),
        ("a", "b=c".into()),
        ("june x", 5.into()),
    ];
    for (key, value) in &expected {
        assert_eq!(info.get(*key), Some(value), "{key}");
    }
    assert_eq!(info.len(), expected.len() + 1);
    assert_eq!(info["commas"], vec![1, 2].into());
}

/// With quadratic run time each of these would take minutes.
#[test]
fn long_comment_lines_take_time_in_proportion() {
    let letters = "k".repeat(10_000_000);
    assert_eq!(info(&letters).into_keys().next(), Some(letters.clone()));
    assert_eq!(info(&format!("{letters}=5"))[&letters], 5.into());
    assert_eq!(info(&format!("note=\"{letters}\""))["note"], letters.as_str().into());
    let pairs: Vec<String> = (0..300_000).map(|number| format!("k{number}={{{number}}}")).collect();
    assert_eq!(info(&pairs.join(" ")).len(), pairs.len());
    let columns: Vec<String> = (0..300_000).map(|number| format!(":c{number}:R:1")).collect();
    let comment = format!("Properties=species:S:1:pos:R:3{}", columns.concat());
    let zeros = " 0".repeat(columns.len());
    assert_eq!(only(&format!("1\n{comment}\nAl 0 0 0{zeros}\n")).arrays.len(), columns.len());
}

#[test]
fn errors_in_long_lines_are_short() {
    let letters = "k".repeat(1_000_000);
    for (comment, shown) in [
        (format!("a=b {letters}=\"never closed"), "column 1000006: \" is opened and never closed"),
        (format!("{letters}=1 ={letters}"), "column 1000004: found '=', expected a key before it"),
        (format!("{letters}=1 {letters}=2"), "is given twice"),
        (format!("{letters}=[[1, 2], [x]]"), "expected rows of numbers"),
        (format!("Properties={letters}"), "expected name:type:columns triples"),
        (format!("Lattice={letters}"), "expected 9 numbers"),
    ] {
        let message = frames(&format!("1\n{comment}\nAl 0 0 0\n")).unwrap_err().to_string();
        assert!(message.contains(shown) && message.len() < 300, "{}", &message[..message.len().min(500)]);
    }
}

#[test]
fn stress_has_nine_components_in_fortran_order_or_six_in_voigt_order() {
    let nine = info("stress=\"1 2 3 4 5 6 7 8 9\"");
    assert_eq!(nine["stress"], [[1.0, 4.0, 7.0], [2.0, 5.0, 8.0], [3.0, 6.0, 9.0]].into());
    let six = info("stress=\"1 2 3 4 5 6\"");
    assert_eq!(six["stress"], [[1.0, 6.0, 5.0], [6.0, 2.0, 4.0], [5.0, 4.0, 3.0]].into());
}

#[test]
fn periodicity() {
    for (pbc, expected) in [
        ("pbc=\"T F T\"", [true, false, true]),
        ("pbc=[1,0,0]", [true, false, false]),
        ("pbc=F", [false; 3]),
        ("", [true; 3]),
    ] {
        let frame = only(&format!("1\nLattice=\"4 0 0 0 4 0 0 0 4\" {pbc}\nAl 0 0 0\n"));
        assert_eq!(frame.structure.periodic, expected, "{pbc}");
    }
}

#[test]
fn errors_tell_line_found_and_expected() {
    let good = "1\n\nAl 0 0 0\n";
    for (text, message) in [
        ("Al 0 0 0\n", "line 1: found 'Al 0 0 0', expected the number of atoms of a frame"),
        ("-1\n", "line 1: found '-1', expected the number of atoms of a frame"),
        ("0\n\n", "line 1: the structure has no atoms"),
        ("2\n", "line 2: the file ends after 0 of the 2 atoms of the frame at line 1"),
        (
            "1000000000000000000\n\nAl 0 0 0\n",
            "line 4: the file ends after 1 of the 1000000000000000000 atoms of the frame at line 1",
        ),
        ("1\n\nAl 0 0\n", "line 3: found 3 fields, expected 4 (see Properties)"),
        (
            "1\nProperties=species:S:1:pos:R:3\nAl 0 0 0 0\n",
            "line 3: found 5 fields, expected 4 (see Properties)",
        ),
        ("1\n\nAl 0 x 0\n", "line 3: field 3 (pos): found 'x', expected a finite number"),
        ("1\n\nAl 0 0 nan\n", "line 3: field 4 (pos): found 'nan', expected a finite number"),
        (
            "1\n\nÅl 0 0 0\n",
            "line 3: field 1: unknown element 'Ål' (expected a symbol such as Al, or an atomic number from 1 to 118)",
        ),
        (
            "1\nProperties=Z:I:1:pos:R:3\n119 0 0 0\n",
            "line 3: field 1: unknown element '119' (expected a symbol such as Al, or an atomic number from 1 to 118)",
        ),
        ("1\nLattice=\"1 0 0\"\nAl 0 0 0\n", "line 2: Lattice is '[1, 0, 0]', expected 9 numbers"),
        ("1\nLattice=\"1 0 0\nAl 0 0 0\n", "line 2: column 9: \" is opened and never closed"),
        ("1\na=1 b=[[1,2]\nAl 0 0 0\n", "line 2: column 7: [ is opened and never closed"),
        ("1\na=[[1,x]]\nAl 0 0 0\n", "line 2: a is '[[1,x]]', expected rows of numbers"),
        ("1\n =5\nAl 0 0 0\n", "line 2: column 2: found '=', expected a key before it"),
        ("1\na=5 a=6\nAl 0 0 0\n", "line 2: a is given twice, expected one value"),
        ("1\nstress=5\nAl 0 0 0\n", "line 2: stress is '5', expected 9 numbers (or 6)"),
        ("1\npbc=2\nAl 0 0 0\n", "line 2: pbc is '2', expected three of T and F"),
        (
            "1\npbc=T\nAl 0 0 0\n",
            "line 1: the cell is periodic but its volume is 0.000e0 Å³: its lattice vectors must span space",
        ),
        (
            "1\nProperties=species:S:1:pos:R:99999999999999999999\nAl 0 0 0\n",
            "line 2: Properties is 'species:S:1:pos:R:99999999999999999999', expected a positive number of columns",
        ),
        (
            "1\nProperties=species:S:1:pos:R:3:a:Q:1\nAl 0 0 0 0\n",
            "line 2: Properties is 'species:S:1:pos:R:3:a:Q:1', expected one of the types R, I, S and L",
        ),
        (
            "1\nProperties=species:S:1\nAl\n",
            "line 2: Properties is 'species:S:1', expected one column pos:R:3 and one of species:S:1 and Z:I:1",
        ),
        (
            "1\nProperties=species:S:1:pos:R:3:a:L:1\nAl 0 0 0 1\n",
            "line 3: field 5 (a): found '1', expected T or F",
        ),
    ] {
        let error = frames(&format!("{good}\n{text}")).unwrap_err();
        assert_eq!(
            ExtxyzError { line: error.line - 4, ..error }.to_string(),
            message.replace("at line 1", "at line 5")
        );
        let mut reader = ExtxyzReader::new(text.as_bytes());
        assert!(reader.next().unwrap().is_err() && reader.next().is_none());
    }
    let error = ExtxyzReader::new(b"1\n\xff\nAl 0 0 0\n".as_slice()).next().unwrap().unwrap_err();
    assert_eq!(error.to_string(), "line 2: found bytes that are not text, expected UTF-8");
}

#[test]
fn labels_under_their_names() {
    let properties = "Properties=species:S:1:pos:R:3:forces:R:3:REF_forces:R:3 Lattice=\"2 0 0 0 2 0 0 0 2\"";
    let labels = |keys: &str| only(&format!("1\n{properties} {keys}\nAl 0 0 0 1 2 3 4 5 6\n")).labels();
    let reference =
        labels("energy=1 stress=\"1 2 3 4 5 6\" REF_energy=2 REF_virial=\"8 0 0 0 16 0 0 0 24\"").unwrap();
    assert_eq!(reference.energy, Some(2.0));
    assert_eq!(reference.forces, Some(vec![[4.0, 5.0, 6.0]]));
    assert_eq!(reference.stress, Some([[-1.0, 0.0, 0.0], [0.0, -2.0, 0.0], [0.0, 0.0, -3.0]]));
    let error = labels("REF_energy=x").unwrap_err();
    assert_eq!(error.to_string(), "the frame at line 1: REF_energy is 'x', expected a finite number");
    let error = labels("REF_stress=\"1 2 3 4 5 nan\"").unwrap_err();
    assert!(error.to_string().ends_with("expected 9 finite numbers (or 6)"), "{error}");

    let plain = only("1\nfree_energy=1.5 energy=1 virial=\"1 2 3 4 5 6\"\nAl 0 0 0\n");
    let error = plain.labels().unwrap_err();
    assert!(error.to_string().ends_with("expected none without a cell that has a volume"), "{error}");
    let plain = only("1\nfree_energy=1.5\nAl 0 0 0\n").labels().unwrap();
    assert_eq!(plain, FrameLabels { energy: Some(1.5), ..FrameLabels::default() });
}

#[test]
fn labels_replace_those_of_any_name() {
    let labels = FrameLabels {
        energy: Some(-3.25),
        forces: Some(vec![[0.5, 0.0, -1e-9]]),
        stress: Some([[1.0, 2.0, 3.0], [2.0, 4.0, 5.0], [3.0, 5.0, 6.0]]),
    };
    let mut frame = only("1\nenergy=1 REF_virial=\"1 2 3 4 5 6\" Lattice=\"3 0 0 0 3 0 0 0 3\"\nAl 0 0 0\n");
    for (keys, names) in [
        (LabelKeys::Grace, &["energy", "free_energy", "stress"][..]),
        (LabelKeys::Mace, &["REF_energy", "REF_stress"]),
        (LabelKeys::Gap, &["energy", "virial"]),
        (LabelKeys::Ase, &["energy", "stress"]),
    ] {
        frame.set_labels(&labels, keys);
        assert!(frame.info.keys().eq(names));
        let read = only(&rewritten(&frame));
        assert_eq!(read.labels().unwrap(), labels, "{keys:?}");
    }
}

#[test]
fn what_cannot_be_read_again_is_not_written() {
    let good = only("1\n\nAl 0 0 0\n");
    let refused = |change: &dyn Fn(&mut Frame)| {
        let mut frame = good.clone();
        change(&mut frame);
        let mut out = Vec::new();
        let error = write_frame(&mut out, &frame).unwrap_err();
        assert!(out.is_empty());
        error.to_string()
    };
    let column = |entries| Column { width: 1, entries };
    for (entries, fault) in [
        (ColumnData::Int(vec![1 << 31]), "has integers of more than 32 bits, which ASE cannot read"),
        (ColumnData::Text(vec!["a b".to_owned()]), "has text that is empty or contains white space"),
        (ColumnData::Real(vec![]), "does not have one row of the same width for each atom"),
    ] {
        let message = refused(&|frame| drop(frame.arrays.insert("x".to_owned(), column(entries.clone()))));
        assert_eq!(message, format!("the column 'x' {fault}"));
    }
    for (key, value) in [
        ("pbc", ExtxyzValue::from(true)),
        ("", true.into()),
        ("a\nb", true.into()),
        ("uid", 5.into()),
        ("stress", 5.into()),
        ("ragged", vec![vec![1.0], vec![1.0, 2.0]].into()),
        ("nan", vec![vec![1.0], vec![f64::NAN]].into()),
    ] {
        let message = refused(&|frame| drop(frame.info.insert(key.to_owned(), value.clone())));
        assert!(message.starts_with(&format!("the info key '{key}' ")), "{message}");
    }
    assert_eq!(
        refused(&|frame| frame.structure.positions[0][1] = f64::NAN),
        "atom 0 has a position that is not finite"
    );
}

#[test]
fn one_frame_has_one_form() {
    let text = "1\nLattice=\"4.0 0.0 0.0 0.0 4.0 0.0 0.0 0.0 4.0\" Properties=species:S:1:pos:R:3:tags:I:1 \
                \"a key\"=\"_JSON \\\"5\\\"\" nan=\"NaN inf\" t=\"x y\" pbc=\"T T F\"\nSi 0.1 1e-7 -0.0 3\n";
    let frame = only(text);
    assert_eq!(frame.info["a key"], "5".into());
    assert_eq!(rewritten(&frame), text);
}
