//! Archives for tests.

use std::io::{Cursor, Write};

use npyz::WriterBuilder;
use npyz::npz::{NpzWriter, file_name_from_array_name};

/// The bytes of an archive with these arrays.
pub fn archive(entries: &[(&str, Vec<u8>)]) -> Vec<u8> {
    let mut out = NpzWriter::new(Cursor::new(Vec::new()));
    for (name, bytes) in entries {
        out.zip_writer().start_file(file_name_from_array_name(name), Default::default()).unwrap();
        out.zip_writer().write_all(bytes).unwrap();
    }
    out.zip_writer().finish().unwrap().into_inner()
}

/// The bytes of an array file, with the type of the values.
#[allow(dead_code)] // each test binary uses a part of this module
pub fn array<T: npyz::AutoSerialize + Copy>(shape: &[u64], data: &[T]) -> Vec<u8> {
    let mut bytes = Vec::new();
    let options = npyz::WriteOptions::new().default_dtype().shape(shape);
    let mut writer = options.writer(&mut bytes).begin_nd().unwrap();
    writer.extend(data.iter().copied()).unwrap();
    writer.finish().unwrap();
    bytes
}

/// The bytes of an array file with a custom header of format version 1.
pub fn file(header: &[u8], data: &[u8]) -> Vec<u8> {
    [b"\x93NUMPY\x01\x00", &(header.len() as u16).to_le_bytes()[..], header, data].concat()
}
