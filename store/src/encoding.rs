//! Structures and vectors as bytes: little-endian, in a fixed order.

use atoms::{Cell, Matrix3, Species, Structure, Vec3};
use wire::ContentHash;

use crate::checksum::{Names, STRUCTURE};
use crate::database::SqlRow;
use crate::error::{Result, StoreError};

/// Size of periodicity and lattice vectors.
const FIXED: usize = 3 + 72;
/// Size of atomic number and position.
const PER_ATOM: usize = 1 + 24;

/// Periodicity (3 bytes), lattice vectors, atomic numbers (1 byte each), positions.
pub fn encode_structure(structure: &Structure) -> Vec<u8> {
    let mut bytes: Vec<u8> = structure.periodic.map(u8::from).to_vec();
    bytes.extend(encode_vectors(&structure.cell.0));
    bytes.extend(structure.species.iter().map(|species| species.atomic_number()));
    bytes.extend(encode_vectors(&structure.positions));
    bytes
}

/// Decodes a structure and checks its hash.
pub fn decode_structure(bytes: &[u8], hash: &[u8]) -> Result<Structure> {
    parse_structure(bytes)
        .filter(|structure| ContentHash::from_structure(structure).0 == hash)
        .ok_or_else(|| StoreError::damaged("a structure", "its content does not match its hash"))
}

/// Reads the structure of a row that selects `joined!(structure)`, and checks its checksum and hash.
pub fn read_structure(row: &SqlRow) -> Result<Structure> {
    STRUCTURE.verify(row, Names::Joined)?;
    let (data, hash): (Vec<u8>, Vec<u8>) = (row.get("structure__data")?, row.get("structure__hash")?);
    decode_structure(&data, &hash)
}

fn parse_structure(bytes: &[u8]) -> Option<Structure> {
    let (periodic, rest) = bytes.split_first_chunk::<3>().filter(|(p, _)| p.iter().all(|byte| *byte <= 1))?;
    let (cell, rest) = rest.split_first_chunk::<72>()?;
    let n = (bytes.len() - FIXED) / PER_ATOM;
    let (numbers, positions) = rest.split_at_checked(n)?;
    let species = numbers.iter().map(|z| Species::from_atomic_number(*z).ok());
    Some(Structure {
        species: species.collect::<Option<_>>()?,
        positions: decode_vectors(positions)?,
        cell: Cell(decode_matrix(cell)?),
        periodic: periodic.map(|byte| byte == 1),
    })
}

/// x, y, z of each vector.
pub fn encode_vectors(vectors: &[Vec3]) -> Vec<u8> {
    vectors.iter().flatten().flat_map(|x| x.to_le_bytes()).collect()
}

/// Decodes vectors; `None` for a wrong length.
pub fn decode_vectors(bytes: &[u8]) -> Option<Vec<Vec3>> {
    let (vectors, rest) = bytes.as_chunks::<24>();
    let vector = |bytes: &[u8; 24]| {
        let (numbers, _) = bytes.as_chunks::<8>();
        std::array::from_fn(|k| f64::from_le_bytes(numbers[k]))
    };
    rest.is_empty().then(|| vectors.iter().map(vector).collect())
}

/// Three vectors, by rows.
pub fn decode_matrix(bytes: &[u8]) -> Option<Matrix3> {
    decode_vectors(bytes)?.try_into().ok()
}

/// Converts a number for a signed database column.
pub fn integer(what: &str, number: u64) -> Result<i64> {
    i64::try_from(number).map_err(|_| StoreError::Inconsistent(format!("{what} {number} is out of range")))
}

/// A hash from a column.
pub fn decode_hash(bytes: &[u8]) -> Result<ContentHash> {
    let bytes = bytes.try_into().map_err(|_| StoreError::damaged("a hash", "not 32 bytes"))?;
    Ok(ContentHash(bytes))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_structure_is_read_back_and_damage_is_detected() {
        let structure = Structure {
            species: vec!["Al".parse().unwrap(), "O".parse().unwrap()],
            positions: vec![[0.1, -0.0, 3.0], [1e300, 5e-324, -7.25]],
            cell: Cell([[4.0, 0.1, 0.0], [0.0, 5.0, 0.0], [0.3, 0.0, 6.0]]),
            periodic: [true, false, true],
        };
        let hash = ContentHash::from_structure(&structure).0;
        let bytes = encode_structure(&structure);
        assert_eq!(decode_structure(&bytes, &hash).unwrap(), structure);
        for at in 0..bytes.len() {
            let mut damaged = bytes.clone();
            damaged[at] ^= 2;
            assert!(decode_structure(&damaged, &hash).is_err(), "byte {at}");
            assert!(decode_structure(&bytes[..at], &hash).is_err(), "cut at {at}");
        }
    }
}
