//! Archives with valid checksums and hostile headers give errors, without panics or excessive allocation.

use npz::{Error, NpzFile};
use proptest::prelude::*;

use crate::common::{archive, array, file};

/// The error for a file that can be read neither as numbers nor as strings.
fn refused(bytes: Vec<u8>) -> Option<String> {
    let bytes = archive(&[("a", bytes)]);
    let archive = NpzFile::from_bytes("hostile.npz", &bytes).unwrap();
    let errors = [
        archive.numbers("a").err(),
        archive.strings("a").err(),
        archive.integers("a").err(),
        archive.floats_f32("a").err(),
    ]
    .map(|error| error.as_ref().map(Error::to_string));
    for error in errors.iter().flatten() {
        assert!(error.starts_with("hostile.npz: array 'a': found "), "{error}");
    }
    let [numbers, texts, ..] = errors;
    numbers.filter(|_| texts.is_some())
}

fn header(kind: &str, shape: &str) -> String {
    format!("{{'descr': '{kind}', 'fortran_order': False, 'shape': {shape}, }}\n")
}

#[test]
fn absurd_shapes_are_errors() {
    for kind in ["<f8", "<f4", "<i4", "|b1", "|S1", "<U1", "|S0", "<U0"] {
        for shape in [
            "(4611686018427387904, 16)",
            "(16, 4611686018427387904)",
            "(0, 4611686018427387904, 16)",
            "(4611686018427387904, 16, 0)",
            "(18446744073709551615,)",
            "(18446744073709551616,)",
            "(2305843009213693952,)",
            "(4294967296, 4294967296)",
            "(1000000000000,)",
            "(11,)",
        ] {
            let found = refused(file(header(kind, shape).as_bytes(), &[0; 80]));
            assert!(found.is_some(), "{kind} {shape}");
        }
    }
    for shape in ["(4611686018427387904, 16)", "(0, 4611686018427387904, 16)"] {
        let found = refused(file(header("<f8", shape).as_bytes(), b"")).unwrap();
        assert!(found.contains("found 0 bytes of data for shape ["), "{found}");
        assert!(found.ends_with("of <f8, expected as many as shape and type need"), "{found}");
    }
}

#[test]
fn absurd_types_are_errors() {
    for kind in
        ["|S18446744073709551615", "<U18446744073709551615", "<U4611686018427387904", "|V9", "|O", "é", ""]
    {
        for shape in ["()", "(1,)", "(2, 3)"] {
            assert!(refused(file(header(kind, shape).as_bytes(), &[0; 80])).is_some(), "{kind} {shape}");
        }
    }
}

/// Input that a parser of all Python literals would accept or crash on.
#[test]
fn other_headers_are_errors() {
    let nested = |open: &str| format!("{{'descr': {}", open.repeat(60_000));
    for text in [
        nested("["),
        nested("("),
        nested("{"),
        nested("'"),
        header("<f8", &"(".repeat(60_000)),
        header("<f8", "[2, 3]"),
        header("<f8", "(-1,)"),
        header("<f8", "(1e400 + 5, 2)"),
        header("<f8", "(1,, 2)"),
        header("<f8", "(10 0,)"),
        header("<f8", "10"),
        format!("{}{}", header("<f8", "(10,)"), header("<f8", "(10,)")),
        "{'descr': '<f8', 'fortran_order': False}".to_owned(),
        "{'descr': '<f8', 'fortran_order': 0, 'shape': (10,)}".to_owned(),
        "{'descr': '<f8', 'fortran_order': False, 'shape': (10,), 'shape': (10,)}".to_owned(),
        "{'descr': '<f8', 'fortran_order': False, 'shape': (10,), 'more': (10,)}".to_owned(),
        "{'descr': [('x', '<f8')], 'fortran_order': False, 'shape': (10,)}".to_owned(),
        String::new(),
        "{".to_owned(),
    ] {
        assert!(refused(file(text.as_bytes(), &[0; 80])).is_some(), "{text:.60}");
    }
    assert_eq!(refused(file(header("<f8", "(10,)").as_bytes(), &[0; 80])), None);
}

#[test]
fn headers_longer_than_their_files_are_errors() {
    for version in 0..5 {
        let found = refused([b"\x93NUMPY", &[version, 0][..], &[0xff; 4]].concat()).unwrap();
        assert!(found.contains("header") || found.contains("version") || found.contains("fill"), "{found}");
    }
    let sound = array(&[2, 3], &[1.0; 6]);
    for length in 0..sound.len() {
        assert!(refused(sound[..length].to_vec()).is_some(), "{length} bytes");
    }
    assert!(refused([sound, vec![0]].concat()).is_some());
}

/// The size in the archive's directory agrees with the header, but the data do not.
#[test]
fn archives_that_announce_more_than_they_hold_are_errors() {
    for items in [2_000_000_000_u32, u32::MAX - 100] {
        let text = header("|b1", &format!("({items},)"));
        let mut bytes = archive(&[("a", file(text.as_bytes(), &[0; 80]))]);
        let list = bytes.windows(4).rposition(|window| window == b"PK\x01\x02").unwrap();
        let announced = 10 + text.len() as u32 + items;
        bytes[list + 24..list + 28].copy_from_slice(&announced.to_le_bytes());
        let archive = NpzFile::from_bytes("hostile.npz", &bytes).unwrap();
        let error = archive.numbers("a").unwrap_err().to_string();
        assert!(error.contains(&format!("found 80 bytes of data for shape [{items}] of |b1")), "{error}");
    }
}

/// Dictionaries that are almost valid.
fn nearly_a_header() -> impl Strategy<Value = String> {
    let extent = prop_oneof![
        (0..12_u64).prop_map(|n| n.to_string()),
        any::<u64>().prop_map(|n| n.to_string()),
        (0..70_u32).prop_map(|power| (1_u128 << power).to_string()),
        "[-+0-9a-z_.]{0,30}",
    ];
    let shape = prop::collection::vec(extent, 0..5).prop_map(|extents| format!("({},)", extents.join(", ")));
    let kind = prop_oneof!["[<>|=]?[biufcmMSUOVa][0-9]{0,20}", "[<>|][fiS][1248]", "\\PC{0,8}"];
    (kind, shape).prop_map(|(kind, shape)| header(&kind, &shape))
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(512))]

    #[test]
    fn random_files_are_errors(bytes in prop::collection::vec(any::<u8>(), 0..300)) {
        prop_assert!(refused(bytes).is_some());
    }

    #[test]
    fn random_headers_are_errors(text in prop::collection::vec(any::<u8>(), 0..300)) {
        prop_assert!(refused(file(&text, &[0; 80])).is_some());
    }

    #[test]
    fn random_python_is_an_error(text in "[]{}()'\":, \\\\0-9a-zA-Z<|]{0,200}") {
        prop_assert!(refused(file(text.as_bytes(), &[0; 80])).is_some());
    }

    /// If a header is accepted, the data match its shape.
    #[test]
    fn near_misses_are_errors_or_harmless(text in nearly_a_header(), length in 0..200_usize) {
        let bytes = archive(&[("a", file(text.as_bytes(), &vec![0; length]))]);
        let archive = NpzFile::from_bytes("hostile.npz", &bytes).unwrap();
        if let Ok(array) = archive.numbers("a") {
            prop_assert!(array.data.len() <= length);
            prop_assert_eq!(array.shape.iter().product::<usize>(), array.data.len());
        }
        if let Ok(texts) = archive.strings("a") {
            prop_assert!(texts.len() <= length);
        }
    }

    #[test]
    fn a_changed_byte_is_an_error_or_harmless(place in 0..176_usize, change in 1_u8..) {
        let mut bytes = array(&[2, 3], &[1.0; 6]);
        let place = place % bytes.len();
        bytes[place] ^= change;
        let bytes = archive(&[("a", bytes)]);
        if let Ok(array) = NpzFile::from_bytes("hostile.npz", &bytes).unwrap().numbers("a") {
            prop_assert_eq!(array.shape.iter().product::<usize>(), array.data.len());
        }
    }
}
