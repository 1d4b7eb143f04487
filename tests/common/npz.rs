//! Changes the numbers in npz files.

use std::io::{Cursor, Read, Write};
use std::path::Path;

use npyz::npz::{NpzArchive, NpzWriter, array_name_from_file_name};

/// The bytes of an npz file after applying `change` to its floating-point arrays.
pub fn with_changed_arrays(file: &Path, change: impl Fn(&str, &mut Vec<f64>)) -> Vec<u8> {
    let mut source = NpzArchive::open(file).unwrap();
    let zip = source.zip_archive();
    let mut names: Vec<_> = zip.file_names().map(str::to_owned).collect();
    names.sort();
    let mut out = NpzWriter::new(Cursor::new(Vec::new()));
    for name in names {
        let mut array = Vec::new();
        zip.by_name(&name).unwrap().read_to_end(&mut array).unwrap();
        change_array(&mut array, |numbers| change(array_name_from_file_name(&name).unwrap(), numbers));
        out.zip_writer().start_file(name, Default::default()).unwrap();
        out.zip_writer().write_all(&array).unwrap();
    }
    out.zip_writer().finish().unwrap().into_inner()
}

/// Changes the data after the header of an npy file, version 1.
fn change_array(array: &mut [u8], change: impl FnOnce(&mut Vec<f64>)) {
    let begin = 10 + usize::from(u16::from_le_bytes([array[8], array[9]]));
    let (header, data) = array.split_at_mut(begin);
    let header = String::from_utf8_lossy(header);
    let single = header.contains("'<f4'");
    let mut numbers: Vec<f64> = match (single, header.contains("'<f8'")) {
        (true, _) => data.as_chunks().0.iter().map(|bytes| f32::from_le_bytes(*bytes).into()).collect(),
        (_, true) => data.as_chunks().0.iter().map(|bytes| f64::from_le_bytes(*bytes)).collect(),
        _ => return,
    };
    change(&mut numbers);
    let size = if single { 4 } else { 8 };
    for (bytes, number) in data.chunks_exact_mut(size).zip(numbers) {
        match single {
            true => bytes.copy_from_slice(&(number as f32).to_le_bytes()),
            false => bytes.copy_from_slice(&number.to_le_bytes()),
        }
    }
}
