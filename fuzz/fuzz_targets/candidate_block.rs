//! Any bytes parse as a candidate block or give an error, and a block re-encodes to the same bytes.
#![no_main]

use libfuzzer_sys::fuzz_target;
use wire::CandidateBlock;

/// Magic, version, checksum and length precede.
const CHECKED_FROM: usize = 16;
const COUNTED_FROM: usize = 24;

fuzz_target!(|bytes: &[u8]| {
    read(bytes);
    read(&sealed(bytes));
});

fn read(bytes: &[u8]) {
    if let Ok(block) = CandidateBlock::from_bytes(bytes) {
        assert_eq!(block.as_bytes(), bytes);
        let candidate = block.view().to_candidate();
        assert_eq!(CandidateBlock::encode(&candidate).as_bytes(), bytes);
        let bare = block.without_features();
        assert!(CandidateBlock::from_bytes(bare.as_bytes()).is_ok());
    }
}

/// Prepends a valid header, so that the fuzzer reaches the code behind the checksum.
fn sealed(bytes: &[u8]) -> Vec<u8> {
    let length = (COUNTED_FROM + bytes.len()) as u64;
    let rest = [&length.to_le_bytes(), bytes].concat();
    let mut sealed = b"CALMCAND\x01\0\0\0".to_vec();
    sealed.extend(crc32fast::hash(&rest).to_le_bytes());
    assert_eq!(sealed.len(), CHECKED_FROM);
    sealed.extend(rest);
    with_content_hash(sealed)
}

/// Sets the content hash to that of the structure in the block, if it holds one.
fn with_content_hash(mut bytes: Vec<u8>) -> Vec<u8> {
    const CONTENT: std::ops::Range<usize> = 56..88;
    if let Err(wire::BlockError::Field { field: "content hash", .. }) = CandidateBlock::from_bytes(&bytes) {
        let atoms = u64::from_le_bytes(bytes[24..32].try_into().unwrap()) as usize;
        let hash = content_hash(&bytes, atoms);
        bytes[CONTENT].copy_from_slice(&hash);
        let checksum = crc32fast::hash(&bytes[CHECKED_FROM..]);
        bytes[12..16].copy_from_slice(&checksum.to_le_bytes());
        assert!(CandidateBlock::from_bytes(&bytes).is_ok());
    }
    bytes
}

fn content_hash(bytes: &[u8], atoms: usize) -> [u8; 32] {
    const HEADER: usize = 288;
    let number = |place: usize| f64::from_le_bytes(bytes[place..place + 8].try_into().unwrap());
    let vector = |place: usize| std::array::from_fn(|k| number(place + 8 * k));
    let structure = atoms::Structure {
        species: (0..atoms)
            .map(|k| atoms::Species::from_atomic_number(bytes[HEADER + 8 * k]).unwrap())
            .collect(),
        positions: (0..atoms).map(|k| vector(HEADER + 8 * atoms + 24 * k)).collect(),
        cell: atoms::Cell(std::array::from_fn(|k| vector(144 + 24 * k))),
        periodic: std::array::from_fn(|k| bytes[116 + k] == 1),
    };
    wire::ContentHash::from_structure(&structure).0
}
