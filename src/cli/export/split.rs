//! Splits a data set by seed structure: all structures found from one, including control frames, go to the same part, so that
//! training and test sets are independent.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::str::FromStr;

/// Allowed deviation of the sum of the shares from 1.
const TOLERANCE: f64 = 1e-9;

/// `train=0.9,test=0.1`: names with their shares of the seed structures.
#[derive(Clone, Debug, PartialEq)]
pub struct Shares(Vec<(String, f64)>);

impl FromStr for Shares {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let mut shares: Vec<(String, f64)> = Vec::new();
        for part in text.split(',') {
            let wrong = || format!("found '{part}', expected NAME=SHARE, such as train=0.9,test=0.1");
            let (name, share) = part.split_once('=').ok_or_else(wrong)?;
            let (name, share) = (name.trim(), share.trim().parse::<f64>().map_err(|_| wrong())?);
            let plain = |c: char| c.is_ascii_alphanumeric() || matches!(c, '_' | '-');
            if name.is_empty() || !name.chars().all(plain) {
                return Err(format!("found the name '{name}', expected letters, digits, '_' and '-'"));
            }
            if !(share > 0.0 && share < 1.0) {
                return Err(format!(
                    "found the share {share} for '{name}', expected a number between 0 and 1"
                ));
            }
            if shares.iter().any(|(other, _)| other == name) {
                return Err(format!("found '{name}' twice"));
            }
            shares.push((name.to_owned(), share));
        }
        let sum: f64 = shares.iter().map(|(_, share)| share).sum();
        if (sum - 1.0).abs() > TOLERANCE {
            return Err(format!("the shares add up to {sum}, expected 1"));
        }
        Ok(Self(shares))
    }
}

impl Shares {
    /// Names of the parts.
    pub fn names(&self) -> impl Iterator<Item = &str> {
        self.0.iter().map(|(name, _)| name.as_str())
    }

    /// Assigns each seed structure to a part, by index. Shuffles the seed structures with a hash of `random_seed` and their
    /// names, and divides the sequence by the shares. Each part gets at least one.
    ///
    /// # Errors
    /// There are fewer seed structures than parts.
    pub fn assign(
        &self,
        structures: &[(u32, String)],
        random_seed: u64,
    ) -> Result<BTreeMap<u32, usize>, String> {
        let (count, parts) = (structures.len(), self.0.len());
        if count < parts {
            return Err(format!(
                "cannot split {count} seed structures into {parts} parts: a part would be empty"
            ));
        }
        let mut order: Vec<_> =
            structures.iter().map(|(index, name)| (key(random_seed, *index, name), *index)).collect();
        order.sort_unstable();
        let mut assigned = BTreeMap::new();
        let (mut begin, mut share) = (0, 0.0);
        for (part, (_, own)) in self.0.iter().enumerate() {
            share += own;
            let end = (share * count as f64).round() as usize;
            // At least one for this part and for each of the following ones.
            let end = end.clamp(begin + 1, count - (parts - part - 1));
            let end = if part + 1 == parts { count } else { end };
            assigned.extend(order[begin..end].iter().map(|(_, index)| (*index, part)));
            begin = end;
        }
        Ok(assigned)
    }
}

fn key(random_seed: u64, index: u32, name: &str) -> [u8; 32] {
    let mut hasher = blake3::Hasher::new();
    hasher.update(b"calmwalk split 1");
    hasher.update(&random_seed.to_le_bytes());
    hasher.update(&index.to_le_bytes());
    hasher.update(name.as_bytes());
    *hasher.finalize().as_bytes()
}

/// `dataset-train.extxyz` of `dataset.extxyz`.
pub fn path(output: &Path, part: &str) -> PathBuf {
    let stem = output.file_stem().unwrap_or_default().to_string_lossy();
    let extension =
        output.extension().map_or(String::new(), |extension| format!(".{}", extension.to_string_lossy()));
    output.with_file_name(format!("{stem}-{part}{extension}"))
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    #[test]
    fn shares_are_checked() {
        for (text, problem) in [
            ("train", "expected NAME=SHARE"),
            ("train=0.9,test=x", "found 'test=x'"),
            ("train=0.9,test=0.2", "add up to 1.1"),
            ("train=1.0", "between 0 and 1"),
            ("a=0.5,a=0.5", "found 'a' twice"),
            ("a/b=0.5,c=0.5", "expected letters"),
        ] {
            let error = text.parse::<Shares>().unwrap_err();
            assert!(error.contains(problem), "{text}: {error}");
        }
        assert_eq!(path(Path::new("a/b.extxyz"), "test"), Path::new("a/b-test.extxyz"));
        assert_eq!(path(Path::new("b"), "test"), Path::new("b-test"));
    }

    proptest! {
        #[test]
        fn every_seed_structure_goes_to_one_part_and_no_part_is_empty(count in 3_u32..200, seed: u64) {
            let shares: Shares = "train=0.8,valid=0.15,test=0.05".parse().unwrap();
            let structures: Vec<_> = (0..count).map(|index| (index, format!("seed {index}"))).collect();
            let assigned = shares.assign(&structures, seed).unwrap();
            prop_assert_eq!(assigned.len(), count as usize);
            for (part, share) in [0.8, 0.15, 0.05].into_iter().enumerate() {
                let number = assigned.values().filter(|own| **own == part).count();
                prop_assert!(number >= 1 && (number as f64 - share * f64::from(count)).abs() <= 2.0, "{} of {}", number, count);
            }
            let mut other = structures.clone();
            other.reverse();
            prop_assert_eq!(&shares.assign(&other, seed).unwrap(), &assigned, "independent of their order");
        }
    }
}
