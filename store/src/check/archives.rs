//! Checks that packed directories of calculations can be unpacked. Reads them one at a time and writes nothing.

use std::io::{self, Read};

use crate::checksum::{ARCHIVE, Names};
use crate::database::{FromRow, SqlRow, Transaction, query};
use crate::error::Result;
use crate::tables::checksums::NEXT_ARCHIVE;

/// A packed directory.
pub(super) struct ArchiveRow {
    pub job: i64,
    pub attempt: u32,
    bytes: Vec<u8>,
    verified: Result<()>,
}

impl FromRow for ArchiveRow {
    fn from_row(row: &SqlRow) -> Result<Self> {
        Ok(Self {
            job: row.get("job")?,
            attempt: row.get("attempt")?,
            bytes: row.get("bytes")?,
            verified: ARCHIVE.verify(row, Names::Plain),
        })
    }
}

impl ArchiveRow {
    /// The first archive after this attempt.
    pub async fn after(transaction: &mut Transaction, job: i64, attempt: u32) -> Result<Option<Self>> {
        query(NEXT_ARCHIVE).bind(job).bind(attempt).fetch_optional(transaction).await
    }

    pub fn fault(&self) -> Option<String> {
        match (unpack(&self.bytes), &self.verified) {
            (Err(error), _) => Some(format!("it cannot be unpacked ({error})")),
            (Ok(()), Err(error)) => Some(error.to_string()),
            (Ok(()), Ok(())) => None,
        }
    }
}

/// Reads a compressed tar file to its end, whatever its unpacked size.
fn unpack(bytes: &[u8]) -> io::Result<()> {
    if bytes.is_empty() {
        return Err(io::ErrorKind::UnexpectedEof.into());
    }
    let mut archive = tar::Archive::new(zstd::Decoder::with_buffer(bytes)?);
    for entry in archive.entries()? {
        let mut entry = entry?;
        let (expected, found) = (entry.size(), io::copy(&mut entry, &mut io::sink())?);
        if found != expected {
            return Err(io::Error::other(format!("{found} bytes of a file of {expected}")));
        }
    }
    // The rest after the last file is read only for the checksum.
    io::copy(&mut archive.into_inner().by_ref(), &mut io::sink()).map(drop)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn packed(content: &[u8]) -> Vec<u8> {
        let mut encoder = zstd::Encoder::new(Vec::new(), 3).unwrap();
        encoder.include_checksum(true).unwrap();
        let mut archive = tar::Builder::new(encoder);
        let mut header = tar::Header::new_gnu();
        header.set_size(content.len() as u64);
        archive.append_data(&mut header, "run.abo", content).unwrap();
        archive.into_inner().unwrap().finish().unwrap()
    }

    #[test]
    fn truncated_or_changed_archives_are_detected() {
        let content: Vec<u8> =
            (0..20_000_u32).flat_map(|n| n.wrapping_mul(2_654_435_761).to_le_bytes()).collect();
        let whole = packed(&content);
        unpack(&whole).unwrap();
        unpack(&packed(&[])).unwrap();
        for place in (0..whole.len()).step_by(whole.len() / 200).chain([whole.len() - 1]) {
            assert!(unpack(&whole[..place]).is_err(), "cut at {place}");
            let mut changed = whole.clone();
            changed[place] ^= 16;
            assert!(unpack(&changed).is_err(), "changed at {place}");
        }
    }
}
