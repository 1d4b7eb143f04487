//! Arrays of f64 in a column, bit for bit.
//!
//! Measured or computed numbers are nearly random in all but their first bytes: compression saved a tenth of the
//! size of features and took longer than writing that tenth. Numbers are therefore stored uncompressed: one word
//! with [`PLAIN`] and their count, then the numbers, little-endian. Whole numbers, those of trajectories, are compressed,
//! and earlier versions compressed all: a word with the count alone, then one zstd frame of the bytes by significance
//! (all first bytes, then all second bytes …).

use std::io::{self, Read};

/// Set in the first word of uncompressed arrays.
const PLAIN: u64 = 1 << 63;
const WORD: usize = size_of::<u64>();
const ZSTD_LEVEL: i32 = 1;

/// Why bytes are not an array of numbers.
#[derive(Debug, thiserror::Error)]
pub enum NumbersError {
    /// Shorter than the leading count.
    #[error("{0} bytes, too few for an array")]
    Short(usize),
    /// zstd rejects them.
    #[error("zstd: {0}")]
    Zstd(#[from] io::Error),
    /// The length does not match the count.
    #[error("{found} bytes or more, expected {count} numbers")]
    Length {
        /// Bytes that were found.
        found: usize,
        /// Expected number of values.
        count: u64,
    },
}

/// Encodes `numbers` for a column.
pub fn encode_numbers(numbers: &[f64]) -> Vec<u8> {
    let mut bytes = vec![0; WORD * (1 + numbers.len())];
    let (words, _) = bytes.as_chunks_mut::<WORD>();
    if let Some((first, places)) = words.split_first_mut() {
        *first = (PLAIN | numbers.len() as u64).to_le_bytes();
        for (place, number) in places.iter_mut().zip(numbers) {
            *place = number.to_le_bytes();
        }
    }
    bytes
}

/// Encodes numbers for a column, compressed.
pub fn compress_numbers(numbers: &[f64]) -> Vec<u8> {
    let planes: Vec<u8> =
        (0..WORD).flat_map(|plane| numbers.iter().map(move |x| x.to_le_bytes()[plane])).collect();
    let mut bytes = (numbers.len() as u64).to_le_bytes().to_vec();
    zstd::stream::copy_encode(planes.as_slice(), &mut bytes, ZSTD_LEVEL)
        .expect("memory is written to memory");
    bytes
}

/// Decodes the bytes of a column, written by this version or an earlier one.
pub fn decode_numbers(bytes: &[u8]) -> Result<Vec<f64>, NumbersError> {
    let (first, rest) = bytes.split_first_chunk::<WORD>().ok_or(NumbersError::Short(bytes.len()))?;
    let first = u64::from_le_bytes(*first);
    if first & PLAIN == 0 {
        return decompress(first, rest);
    }
    let count = first & !PLAIN;
    check_length(rest.len(), count)?;
    let (words, _) = rest.as_chunks::<WORD>();
    Ok(words.iter().map(|word| f64::from_le_bytes(*word)).collect())
}

fn decompress(count: u64, frame: &[u8]) -> Result<Vec<f64>, NumbersError> {
    let mut planes = Vec::new();
    // One byte more than expected is enough to detect excess data.
    let limit = count.saturating_mul(8).saturating_add(1);
    zstd::stream::read::Decoder::new(frame)?.take(limit).read_to_end(&mut planes)?;
    check_length(planes.len(), count)?;
    let n = planes.len() / WORD;
    let number = |k| f64::from_le_bytes(std::array::from_fn(|plane| planes[plane * n + k]));
    Ok((0..n).map(number).collect())
}

fn check_length(found: usize, count: u64) -> Result<(), NumbersError> {
    let whole = count.checked_mul(WORD as u64) == Some(found as u64);
    if whole { Ok(()) } else { Err(NumbersError::Length { found, count }) }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;
    use proptest::test_runner::RngSeed;

    use super::*;

    proptest! {
        #![proptest_config(ProptestConfig { rng_seed: RngSeed::Fixed(8), ..ProptestConfig::default() })]

        #[test]
        fn every_bit_is_preserved(bits in proptest::collection::vec(any::<u64>(), 0..300)) {
            let numbers: Vec<f64> = bits.iter().map(|b| f64::from_bits(*b)).collect();
            for bytes in [encode_numbers(&numbers), compress_numbers(&numbers)] {
                let back = decode_numbers(&bytes).unwrap();
                prop_assert_eq!(&bits, &back.iter().map(|x| x.to_bits()).collect::<Vec<_>>());
            }
        }

        #[test]
        fn arbitrary_bytes_are_rejected(bytes in proptest::collection::vec(any::<u8>(), 0..200)) {
            prop_assert!(decode_numbers(&bytes).is_err());
        }
    }

    #[test]
    fn a_row_of_an_earlier_version_is_read() {
        let row = [
            3, 0, 0, 0, 0, 0, 0, 0, 0x28, 0xb5, 0x2f, 0xfd, 0, 0x48, 0x75, 0, 0, 0x40, 0, 0, 0xf8, 0xd0, 8,
            0x3f, 0xbf, 0x40, 1, 0, 8, 0xc0, 2,
        ];
        assert_eq!(decode_numbers(&row).unwrap(), [1.5, -0.25, 3.0]);
    }

    #[test]
    fn a_wrong_count_and_missing_bytes_are_detected() {
        for (bytes, found) in
            [(encode_numbers(&[1.0, 2.0, 3.0]), 24), (compress_numbers(&[1.0, 2.0, 3.0]), 17)]
        {
            let mut wrong = bytes.clone();
            wrong[0] = 2;
            let error = decode_numbers(&wrong).unwrap_err();
            assert!(matches!(error, NumbersError::Length { found: f, count: 2 } if f == found), "{error}");
            wrong[..7].fill(0xff);
            wrong[7] |= 0x7f;
            let error = decode_numbers(&wrong).unwrap_err();
            assert!(matches!(error, NumbersError::Length { found: 24, .. }), "{error}");
            for end in 0..bytes.len() {
                assert!(decode_numbers(&bytes[..end]).is_err(), "cut at {end}");
            }
        }
    }
}
