//! Rows of numbers in memory up to a limit, then in a temporary file.

use std::fs::File;
use std::io;
use std::ops::Range;
use std::os::unix::fs::FileExt;
use std::path::PathBuf;

/// Rows are written to the file in pieces of this size, bytes.
const BUFFER: usize = 1 << 20;

/// A matrix `[rows × D]` that grows by rows. Its first rows are in memory, the others in a temporary file without a name.
#[derive(Debug)]
pub struct FeatureRows {
    dimension: usize,
    rows: usize,
    in_memory: Vec<f64>,
    /// Rows that memory may hold.
    limit: usize,
    directory: PathBuf,
    file: Option<File>,
    /// Bytes in the file.
    written: u64,
    /// Bytes that are not in the file yet.
    buffer: Vec<u8>,
}

impl FeatureRows {
    /// No rows of dimension D. At most `memory` bytes stay in memory; the file is created in `directory`.
    pub fn new(dimension: usize, memory: usize, directory: PathBuf) -> Self {
        let limit = memory / (8 * dimension.max(1));
        let (in_memory, buffer) = (Vec::new(), Vec::new());
        Self { dimension, rows: 0, in_memory, limit, directory, file: None, written: 0, buffer }
    }

    /// No rows, with the dimension, limit and directory of `self`.
    pub fn empty_like(&self) -> Self {
        Self::new(self.dimension, 8 * self.dimension * self.limit, self.directory.clone())
    }

    /// D.
    pub fn dimension(&self) -> usize {
        self.dimension
    }

    /// Number of rows.
    pub fn len(&self) -> usize {
        self.rows
    }

    /// Whether there is no row.
    pub fn is_empty(&self) -> bool {
        self.rows == 0
    }

    /// Adds a row, `[D]`.
    ///
    /// # Errors
    /// A temporary file that cannot be created or written.
    pub fn push(&mut self, row: &[f64]) -> io::Result<()> {
        debug_assert_eq!(row.len(), self.dimension);
        self.rows += 1;
        if self.rows <= self.limit {
            self.in_memory.extend_from_slice(row);
            return Ok(());
        }
        self.buffer.extend(row.iter().flat_map(|value| value.to_le_bytes()));
        if self.buffer.len() >= BUFFER { self.flush() } else { Ok(()) }
    }

    fn flush(&mut self) -> io::Result<()> {
        let file = match &mut self.file {
            Some(file) => file,
            None => self.file.insert(tempfile::tempfile_in(&self.directory)?),
        };
        file.write_all_at(&self.buffer, self.written)?;
        self.written += self.buffer.len() as u64;
        self.buffer.clear();
        Ok(())
    }

    /// Appends these rows to `out`.
    ///
    /// # Errors
    /// A temporary file that cannot be read.
    pub fn read(&self, rows: Range<usize>, out: &mut Vec<f64>) -> io::Result<()> {
        let Self { dimension, limit, .. } = *self;
        let split = rows.end.min(limit).max(rows.start);
        out.extend_from_slice(
            &self.in_memory[rows.start.min(limit) * dimension..split.min(limit) * dimension],
        );
        if split == rows.end {
            return Ok(());
        }
        let row_bytes = 8 * dimension as u64;
        let place = |row: usize| (row - limit) as u64 * row_bytes;
        let (begin, end) = (place(split), place(rows.end));
        let in_file = end.min(self.written).max(begin);
        let mut bytes = vec![0; (in_file - begin) as usize];
        if let Some(file) = &self.file {
            file.read_exact_at(&mut bytes, begin)?;
        }
        let buffered = (in_file - self.written.min(in_file)) as usize..(end - self.written.min(end)) as usize;
        bytes.extend_from_slice(&self.buffer[buffered]);
        out.extend(bytes.as_chunks().0.iter().map(|value| f64::from_le_bytes(*value)));
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rows_come_back_from_memory_file_and_buffer() {
        let dimension = 3000;
        let row = |k: usize| (0..dimension).map(|c| (k * dimension + c) as f64).collect::<Vec<_>>();
        // 24 kB a row: four in memory, then a file in pieces of 44 rows.
        let mut rows = FeatureRows::new(dimension, 4 * 8 * dimension + 5, std::env::temp_dir());
        for k in 0..100 {
            rows.push(&row(k)).unwrap();
        }
        assert_eq!((rows.len(), rows.written + rows.buffer.len() as u64), (100, 96 * 24_000));
        assert!(rows.written > 0 && !rows.buffer.is_empty());
        for range in [0..1, 3..5, 4..6, 0..100, 40..60, 90..100, 99..100, 7..7, 100..100] {
            let mut found = Vec::new();
            rows.read(range.clone(), &mut found).unwrap();
            assert_eq!(found, range.flat_map(row).collect::<Vec<_>>());
        }
    }
}
