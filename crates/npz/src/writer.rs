//! Writes archives that NumPy reads.

use std::io::{self, Read, Seek, Write};

use npyz::npz::{NpzWriter, file_name_from_array_name};
use npyz::zip::write::FileOptions;
use npyz::zip::{CompressionMethod, DateTime, ZipArchive};
use npyz::{AutoSerialize, WriterBuilder};

/// Writes an archive, uncompressed as `numpy.savez` does. The same arrays give the same bytes at any time.
pub struct Writer<W: Write + Seek> {
    zip: NpzWriter<W>,
}

impl<W: Write + Seek> Writer<W> {
    /// Begins an archive at the current position of `out`.
    pub fn new(out: W) -> Self {
        Self { zip: NpzWriter::new(out) }
    }

    /// Adds an array in C order; shape `[]` is a scalar.
    ///
    /// # Errors
    /// If writing fails, or the number of items does not match the shape.
    pub fn array<T: AutoSerialize>(
        &mut self,
        key: &str,
        shape: &[usize],
        items: impl IntoIterator<Item = T>,
    ) -> io::Result<()> {
        let shape: Vec<u64> = shape.iter().map(|&length| length as u64).collect();
        let array = self.zip.array(key, options())?.default_dtype().shape(&shape);
        let mut array = array.begin_nd()?;
        array.extend(items)?;
        array.finish()
    }

    /// Adds a scalar.
    ///
    /// # Errors
    /// If writing fails.
    pub fn scalar<T: AutoSerialize>(&mut self, key: &str, value: T) -> io::Result<()> {
        self.array(key, &[], [value])
    }

    /// Adds an array of strings as characters (`U`), NUL padded; shape `[]` is a scalar.
    ///
    /// # Errors
    /// If writing fails, or the number of strings does not match the shape.
    pub fn strings(&mut self, key: &str, shape: &[usize], strings: &[&str]) -> io::Result<()> {
        if shape.iter().product::<usize>() != strings.len() {
            let message = format!("array '{key}': {} strings for shape {shape:?}", strings.len());
            return Err(io::Error::new(io::ErrorKind::InvalidInput, message));
        }
        let width = strings.iter().map(|text| text.chars().count()).max().unwrap_or_default().max(1);
        let zip = self.zip.zip_writer();
        zip.start_file(file_name_from_array_name(key), options())?;
        zip.write_all(&unicode_header(shape, width))?;
        for text in strings {
            let padded = text.chars().map(u32::from).chain(std::iter::repeat(0)).take(width);
            zip.write_all(&padded.flat_map(u32::to_le_bytes).collect::<Vec<u8>>())?;
        }
        Ok(())
    }

    /// Adds all arrays of another archive but those that are `left_out`, byte by byte, in their order.
    ///
    /// # Errors
    /// If reading or writing fails, or `source` is no archive.
    pub fn copy<R: Read + Seek>(&mut self, source: R, left_out: impl Fn(&str) -> bool) -> io::Result<()> {
        let mut source = ZipArchive::new(source)?;
        for index in 0..source.len() {
            let file = source.by_index_raw(index)?;
            if !left_out(key(file.name())) {
                self.zip.zip_writer().raw_copy_file(file)?;
            }
        }
        Ok(())
    }

    /// Ends the archive and returns what it was written to.
    ///
    /// # Errors
    /// If writing fails.
    pub fn finish(mut self) -> io::Result<W> {
        Ok(self.zip.zip_writer().finish()?)
    }
}

/// Names of the arrays of an archive, in their order.
///
/// # Errors
/// If reading fails, or `source` is no archive.
pub fn names<R: Read + Seek>(source: R) -> io::Result<Vec<String>> {
    let archive = ZipArchive::new(source)?;
    Ok(archive.file_names().map(|name| key(name).to_owned()).collect())
}

/// The key of an array in a file of this name.
fn key(name: &str) -> &str {
    name.strip_suffix(".npy").unwrap_or(name)
}

fn options() -> FileOptions {
    let fixed = FileOptions::default().last_modified_time(DateTime::default());
    fixed.compression_method(CompressionMethod::Stored).large_file(true)
}

/// Format version 1; the data begin at a multiple of 64 bytes.
fn unicode_header(shape: &[usize], width: usize) -> Vec<u8> {
    let shape: String = shape.iter().map(|length| format!("{length},")).collect();
    let text = format!("{{'descr': '<U{width}', 'fortran_order': False, 'shape': ({shape}), }}");
    let length = (10 + text.len() + 1).next_multiple_of(64) - 10;
    let mut out = b"\x93NUMPY\x01\x00".to_vec();
    out.extend((length as u16).to_le_bytes());
    out.extend(format!("{text:<width$}\n", width = length - 1).into_bytes());
    out
}
