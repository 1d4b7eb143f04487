//! Variants of a model file in this repository.

use std::io::{Cursor, Read, Write};
use std::path::Path;
use std::sync::LazyLock;

use npyz::npz::{NpzArchive, NpzWriter, file_name_from_array_name};
use npyz::{NpyFile, WriterBuilder};
use potentials::grace::{GraceError, GraceModel, Precision, RadialPath};

/// The aluminium model.
pub static BYTES: LazyLock<Vec<u8>> = LazyLock::new(|| {
    std::fs::read(Path::new(env!("CARGO_MANIFEST_DIR")).join("../../configs/data/al_eam_1l/kokkos.npz"))
        .unwrap()
});

/// Reads a model from these bytes, on the exact radial path.
pub fn load(bytes: &[u8]) -> Result<GraceModel, GraceError> {
    let mut file = tempfile::NamedTempFile::new().unwrap();
    file.write_all(bytes).unwrap();
    GraceModel::load_in(file.path(), Precision::Double, RadialPath::Exact)
}

/// A multi-layer test model.
pub fn deep(name: &str) -> Vec<u8> {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/data").join(name);
    std::fs::read(&path).unwrap_or_else(|error| panic!("{}: {error}", path.display()))
}

/// The names of all arrays.
pub fn names(model: &[u8]) -> Vec<String> {
    NpzArchive::new(Cursor::new(model)).unwrap().array_names().map(str::to_owned).collect()
}

fn entry(source: &mut NpzArchive<Cursor<&[u8]>>, name: &str) -> Vec<u8> {
    let mut bytes = Vec::new();
    source.zip_archive().by_name(&file_name_from_array_name(name)).unwrap().read_to_end(&mut bytes).unwrap();
    bytes
}

/// Shape and data of one array.
pub fn floats(name: &str) -> (Vec<u64>, Vec<f64>) {
    floats_of(&BYTES, name)
}

/// The same of another model.
pub fn floats_of(model: &[u8], name: &str) -> (Vec<u64>, Vec<f64>) {
    let bytes = entry(&mut NpzArchive::new(Cursor::new(model)).unwrap(), name);
    let file = NpyFile::new(&bytes[..]).unwrap();
    (file.shape().to_vec(), file.into_vec().unwrap())
}

/// Shape and data of one array of indices.
pub fn integers_of(model: &[u8], name: &str) -> (Vec<u64>, Vec<i32>) {
    let bytes = entry(&mut NpzArchive::new(Cursor::new(model)).unwrap(), name);
    let file = NpyFile::new(&bytes[..]).unwrap();
    (file.shape().to_vec(), file.into_vec().unwrap())
}

/// Number of items of one array.
pub fn length(model: &[u8], name: &str) -> usize {
    let bytes = entry(&mut NpzArchive::new(Cursor::new(model)).unwrap(), name);
    NpyFile::new(&bytes[..]).unwrap().shape().iter().product::<u64>() as usize
}

/// Arrays to replace or add; `None` removes one.
pub type Change<'a> = (&'a str, Option<Vec<u8>>);

/// Reads the modified aluminium model.
pub fn changed(changes: &[Change]) -> Result<GraceModel, GraceError> {
    changed_of(&BYTES, changes)
}

/// Reads another model with modifications.
pub fn changed_of(model: &[u8], changes: &[Change]) -> Result<GraceModel, GraceError> {
    let mut names = names(model);
    names.extend(changes.iter().map(|(name, _)| (*name).to_owned()));
    names.sort();
    names.dedup();
    let mut source = NpzArchive::new(Cursor::new(model)).unwrap();
    let mut out = NpzWriter::new(Cursor::new(Vec::new()));
    for name in names {
        let bytes = match changes.iter().find(|(changed, _)| *changed == name) {
            Some((_, None)) => continue,
            Some((_, Some(bytes))) => bytes.clone(),
            None => entry(&mut source, &name),
        };
        out.zip_writer().start_file(file_name_from_array_name(&name), Default::default()).unwrap();
        out.zip_writer().write_all(&bytes).unwrap();
    }
    load(&out.zip_writer().finish().unwrap().into_inner())
}

/// The bytes of an array file.
pub fn array<T: npyz::AutoSerialize + Copy>(shape: &[u64], data: &[T]) -> Option<Vec<u8>> {
    let mut bytes = Vec::new();
    let options = npyz::WriteOptions::new().default_dtype().shape(shape);
    let mut writer = options.writer(&mut bytes).begin_nd().unwrap();
    writer.extend(data.iter().copied()).unwrap();
    writer.finish().unwrap();
    Some(bytes)
}

/// The bytes of an array of byte strings of width 8.
pub fn strings(data: &[&str]) -> Option<Vec<u8>> {
    let mut bytes = Vec::new();
    let dtype = npyz::DType::new_scalar("|S8".parse().unwrap());
    let options = npyz::WriteOptions::<[u8]>::new().dtype(dtype).shape(&[data.len() as u64]);
    let mut writer = options.writer(&mut bytes).begin_nd().unwrap();
    data.iter().for_each(|text| writer.push(text.as_bytes()).unwrap());
    writer.finish().unwrap();
    Some(bytes)
}
