//! Reading valid archives, and the errors for unexpected arrays.

use std::path::Path;

use npz::{Error, NpzFile};
use proptest::prelude::*;

use crate::common::{archive, array, file};

/// Reads an archive with the single array `a`.
fn read<T>(bytes: Vec<u8>, read: impl FnOnce(&NpzFile<std::io::Cursor<&[u8]>>) -> T) -> T {
    read(&NpzFile::from_bytes("a.npz", &archive(&[("a", bytes)])).unwrap())
}

fn message<T: std::fmt::Debug>(result: Result<T, Error>) -> String {
    result.unwrap_err().to_string()
}

#[test]
fn numbers_of_every_type_are_widened() {
    for bytes in [
        array(&[2, 1], &[1.0_f32, 0.0]),
        array(&[2, 1], &[1.0_f64, 0.0]),
        array(&[2, 1], &[1_i32, 0]),
        array(&[2, 1], &[1_i64, 0]),
        array(&[2, 1], &[true, false]),
        file(b"{'descr': '>f4', 'fortran_order': False, 'shape': (2, 1)}", &[0x3f, 0x80, 0, 0, 0, 0, 0, 0]),
    ] {
        let found = read(bytes, |archive| archive.numbers("a").unwrap());
        assert_eq!((found.shape, found.data), (vec![2, 1], vec![1.0, 0.0]));
    }
    read(array(&[2], &[1.5_f32, 0.5]), |archive| {
        assert_eq!(archive.floats_f32("a").unwrap().with_shape(&[2]).unwrap(), [1.5, 0.5]);
        assert_eq!(archive.floats("a", &[2]).unwrap(), [1.5, 0.5]);
        assert_eq!(archive.tensor("a").unwrap(), ([2], vec![1.5, 0.5]));
    });
    assert_eq!(read(array(&[2], &[3_i32, 0]), |archive| archive.indices("a", 4).unwrap()), [3, 0]);
    assert_eq!(read(array::<f64>(&[0, 3], &[]), |archive| archive.numbers("a").unwrap().shape), [0, 3]);
}

#[test]
fn scalars_come_in_either_shape() {
    for shape in [&[][..], &[1]] {
        assert_eq!(read(array(shape, &[2.5]), |archive| archive.scalar("a").unwrap()), 2.5);
        assert_eq!(read(array(shape, &[7_i64]), |archive| archive.count("a", 0, 7).unwrap()), 7);
        assert!(read(array(shape, &[1_i32]), |archive| archive.flag_or("a", false).unwrap()));
    }
    read(array(&[1], &[1_i32]), |archive| {
        assert_eq!(archive.scalar_or("b", 4.0).unwrap(), 4.0);
        assert!(archive.flag_or("b", true).unwrap());
    });
}

#[test]
fn texts_lose_their_padding() {
    let bytes = file(b"{'descr': '|S3', 'fortran_order': False, 'shape': (2,), }\n", b"Al\0Si\0");
    assert_eq!(read(bytes, |archive| archive.strings("a").unwrap()), ["Al", "Si"]);
    let letters: Vec<u8> = "Al\0é\0\0".chars().flat_map(|letter| (letter as u32).to_le_bytes()).collect();
    let bytes = file(b"{'descr': '<U3', 'fortran_order': False, 'shape': (2,), }\n", &letters);
    assert_eq!(read(bytes, |archive| archive.strings("a").unwrap()), ["Al", "é"]);
}

#[test]
fn an_archive_knows_its_names_and_what_was_asked() {
    let bytes = archive(&[("b", array(&[], &[1.0])), ("a", array(&[], &[2.0])), ("c", array(&[], &[2.0]))]);
    let archive = NpzFile::from_bytes("a.npz", &bytes).unwrap();
    assert_eq!(archive.names().collect::<Vec<_>>(), ["a", "b", "c"]);
    assert!(archive.contains("a") && !archive.contains("d"));
    archive.scalar("a").unwrap();
    archive.ignore("c");
    assert_eq!(archive.unread(), ["b"]);
}

#[test]
fn files_that_are_no_archives_are_named() {
    let open = |path: &Path| message(NpzFile::open(path).map(|_| ()));
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("x.npz");
    assert!(open(&path).contains("x.npz: No such file"));
    assert!(open(folder.path()).contains("directory"));
    std::fs::write(&path, "no archive").unwrap();
    assert!(open(&path).ends_with("expected a NumPy .npz archive"));
    std::fs::write(&path, archive(&[("a", array(&[], &[2.0]))])).unwrap();
    assert_eq!(NpzFile::open(&path).unwrap().scalar("a").unwrap(), 2.0);
}

#[test]
fn errors_name_file_key_found_and_expected() {
    read(array(&[2], &[1.0, f64::NAN]), |archive| {
        assert_eq!(message(archive.scalar("b")), "a.npz: no array 'b'");
        for (found, expected) in [
            (message(archive.integers("a")), "found type <f8, expected an array of integers (i4 or i8)"),
            (
                message(archive.floats_f32("a")),
                "found type <f8, expected an array of single-precision numbers (f4)",
            ),
            (message(archive.strings("a")), "found type <f8, expected text (S or U)"),
            (message(archive.numbers("a").unwrap().with_shape(&[3])), "found shape [2], expected shape [3]"),
            (
                message(archive.numbers("a").unwrap().tensor::<2>()),
                "found shape [2], expected 2 dimensions, none of them empty",
            ),
            (
                message(archive.numbers("a").unwrap().into_scalar()),
                "found shape [2], expected a single number",
            ),
            (message(archive.floats("a", &[2])), "found partly NaN, expected finite numbers"),
        ] {
            assert_eq!(found, format!("a.npz: array 'a': {expected}"));
        }
    });
    read(array(&[1], &[-1_i64]), |archive| {
        for (found, expected) in [
            (message(archive.count("a", 1, 9)), "found -1, expected a number from 1 to 9"),
            (message(archive.expect_count("a", 3)), "found -1, expected 3"),
            (
                message(archive.indices("a", 4)),
                "found a list with the index -1, expected indices from 0 to 3",
            ),
            (message(archive.indices("a", 0)), "found a list with the index -1, expected no index"),
        ] {
            assert_eq!(found, format!("a.npz: array 'a': {expected}"));
        }
    });
    let columns = file(b"{'descr': '|b1', 'fortran_order': True, 'shape': (1, 2)}", &[0, 1]);
    assert!(message(read(columns, |archive| archive.numbers("a"))).contains("[1, 2] in Fortran order"));
    let text = file(b"{'descr': '|S1', 'fortran_order': False, 'shape': (1,)}", b"a");
    assert!(message(read(text, |archive| archive.numbers("a"))).contains("found type |S1, expected numbers"));
}

proptest! {
    #[test]
    fn what_was_written_is_read(rows in 0..5_usize, columns in 0..5_usize, values in prop::collection::vec(any::<f64>(), 16)) {
        let values = &values[..(rows * columns).min(16)];
        prop_assume!(values.len() == rows * columns);
        let bytes = array(&[rows as u64, columns as u64], values);
        let found = read(bytes, |archive| archive.numbers("a").unwrap().with_shape(&[rows, columns]).unwrap());
        let bits = |values: &[f64]| values.iter().map(|value| value.to_bits()).collect::<Vec<_>>();
        prop_assert_eq!(bits(&found), bits(values));
    }
}
