//! Lossless compression of f64 arrays: the bytes of all numbers are put in order of significance (all first
//! bytes, then all second ones …), where signs and exponents are alike, and then compressed by zstd.

use std::io::{self, Read};

/// Compression is of one core on the way of every candidate: fast rather than small.
const LEVEL: i32 = 1;

/// Why bytes are no compressed array.
#[derive(Debug, thiserror::Error)]
pub enum DecompressError {
    /// Shorter than the count at its begin.
    #[error("{0} bytes, too few to hold anything")]
    Short(usize),
    /// zstd does not accept them.
    #[error("zstd: {0}")]
    Zstd(#[from] io::Error),
    /// Too much or too little came out.
    #[error("{found} bytes or more came out, {count} numbers were announced")]
    Length {
        /// Bytes that came out.
        found: usize,
        /// Numbers that should have.
        count: u64,
    },
}

/// The compressed form of `numbers`: their count (u64, little-endian), then one zstd frame.
pub fn compress(numbers: &[f64]) -> io::Result<Vec<u8>> {
    let mut planes = vec![0; 8 * numbers.len()];
    for (k, number) in numbers.iter().enumerate() {
        for (plane, byte) in number.to_le_bytes().into_iter().enumerate() {
            planes[plane * numbers.len() + k] = byte;
        }
    }
    let mut bytes = (numbers.len() as u64).to_le_bytes().to_vec();
    zstd::stream::copy_encode(planes.as_slice(), &mut bytes, LEVEL)?;
    Ok(bytes)
}

/// The numbers, bit by bit as they were.
pub fn decompress(bytes: &[u8]) -> Result<Vec<f64>, DecompressError> {
    let (count, frame) = bytes.split_first_chunk::<8>().ok_or(DecompressError::Short(bytes.len()))?;
    let count = u64::from_le_bytes(*count);
    let mut planes = Vec::new();
    // One byte more than announced is enough to see that there are too many.
    let limit = count.saturating_mul(8).saturating_add(1);
    zstd::stream::read::Decoder::new(frame)?.take(limit).read_to_end(&mut planes)?;
    if Some(planes.len() as u64) != count.checked_mul(8) {
        return Err(DecompressError::Length { found: planes.len(), count });
    }
    let n = planes.len() / 8;
    let number = |k| f64::from_le_bytes(std::array::from_fn(|plane| planes[plane * n + k]));
    Ok((0..n).map(number).collect())
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;
    use proptest::test_runner::RngSeed;

    use super::*;

    proptest! {
        #![proptest_config(ProptestConfig { rng_seed: RngSeed::Fixed(8), ..ProptestConfig::default() })]

        #[test]
        fn every_bit_comes_back(bits in proptest::collection::vec(any::<u64>(), 0..300)) {
            let numbers: Vec<f64> = bits.iter().map(|b| f64::from_bits(*b)).collect();
            let back = decompress(&compress(&numbers).unwrap()).unwrap();
            prop_assert_eq!(bits, back.iter().map(|x| x.to_bits()).collect::<Vec<_>>());
        }

        #[test]
        fn foreign_bytes_are_refused_not_believed(bytes in proptest::collection::vec(any::<u8>(), 0..200)) {
            prop_assert!(decompress(&bytes).is_err());
        }
    }

    #[test]
    fn a_wrong_count_and_a_cut_frame_are_seen() {
        let bytes = compress(&[1.0, 2.0, 3.0]).unwrap();
        let mut wrong = bytes.clone();
        wrong[0] = 2;
        assert!(matches!(decompress(&wrong), Err(DecompressError::Length { found: 17, count: 2 })));
        wrong[..8].copy_from_slice(&u64::MAX.to_le_bytes());
        assert!(matches!(decompress(&wrong), Err(DecompressError::Length { found: 24, .. })));
        assert!(decompress(&bytes[..bytes.len() - 3]).is_err());
    }

    #[test]
    fn numbers_of_one_magnitude_become_shorter() {
        let numbers: Vec<f64> = (1..2000).map(|k| 1.0 + f64::from(k).sin() * 0.1).collect();
        assert!(compress(&numbers).unwrap().len() < 8 * numbers.len() * 95 / 100);
    }
}
