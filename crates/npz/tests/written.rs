//! Archives that this crate writes.

use std::io::Cursor;

use npz::{NpzFile, Writer};

fn written() -> Vec<u8> {
    let mut out = Writer::new(Cursor::new(Vec::new()));
    out.array("matrix", &[2, 3], (0..6).map(|k| 0.5 * k as f32)).unwrap();
    out.array("empty", &[0, 3], [0_f64; 0]).unwrap();
    out.scalar("count", 7_i64).unwrap();
    out.scalar("flag", true).unwrap();
    out.strings("names", &[3], &["H", "Al", "α"]).unwrap();
    out.strings("mode", &[], &["robust_mad"]).unwrap();
    out.strings("none", &[0], &[]).unwrap();
    out.finish().unwrap().into_inner()
}

#[test]
fn arrays_are_read_back() {
    let bytes = written();
    let archive = NpzFile::from_bytes("a.npz", &bytes).unwrap();
    let matrix = archive.floats_f32("matrix").unwrap();
    assert_eq!((matrix.shape, matrix.data), (vec![2, 3], vec![0.0, 0.5, 1.0, 1.5, 2.0, 2.5]));
    assert_eq!(archive.numbers("empty").unwrap().shape, [0, 3]);
    assert_eq!(archive.count("count", 0, 9).unwrap(), 7);
    assert_eq!(archive.numbers("flag").unwrap().data, [1.0]);
    assert_eq!(archive.strings("names").unwrap(), ["H", "Al", "α"]);
    assert_eq!(archive.strings("mode").unwrap(), ["robust_mad"]);
    assert!(archive.strings("none").unwrap().is_empty());
    assert_eq!(bytes, written());
}

#[test]
fn items_that_do_not_fit_the_shape_are_errors() {
    let mut out = Writer::new(Cursor::new(Vec::new()));
    assert!(out.array("a", &[2], [1.0]).is_err());
    let mut out = Writer::new(Cursor::new(Vec::new()));
    assert!(out.array("a", &[2], [1.0, 2.0, 3.0]).is_err());
    let mut out = Writer::new(Cursor::new(Vec::new()));
    let message = out.strings("a", &[2, 2], &["x"]).unwrap_err().to_string();
    assert_eq!(message, "array 'a': 1 strings for shape [2, 2]");
}

/// NumPy aligns the data of a file to 64 bytes and ends the header with a newline.
#[test]
fn headers_of_strings_are_aligned() {
    let bytes = written();
    let start = bytes.windows(6).rposition(|window| window == b"\x93NUMPY").unwrap();
    let length = u16::from_le_bytes([bytes[start + 8], bytes[start + 9]]) as usize;
    assert_eq!((length + 10) % 64, 0);
    assert_eq!(bytes[start + 10 + length - 1], b'\n');
}

#[test]
fn arrays_are_copied_from_another_archive() {
    let mut out = Writer::new(Cursor::new(Vec::new()));
    out.copy(Cursor::new(written()), |key| key == "matrix" || key == "mode").unwrap();
    out.scalar("matrix", 3.0).unwrap();
    let bytes = out.finish().unwrap().into_inner();
    let archive = NpzFile::from_bytes("copy.npz", &bytes).unwrap();
    let names: Vec<&str> = archive.names().collect();
    assert_eq!(names, ["count", "empty", "flag", "matrix", "names", "none"]);
    assert_eq!(archive.numbers("matrix").unwrap().data, [3.0]);
    assert_eq!(archive.strings("names").unwrap(), ["H", "Al", "α"]);
    assert_eq!(archive.count("count", 0, 9).unwrap(), 7);
    assert!(Writer::new(Cursor::new(Vec::new())).copy(Cursor::new(b"text"), |_| false).is_err());
}
