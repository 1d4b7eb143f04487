//! A block preserves every bit, and rejects every damaged byte.

use proptest::collection::vec;
use proptest::prelude::*;
use wire::{BlockError, Candidate, CandidateBlock, CandidateView};

use crate::common::{bits, candidate};

/// Offsets in the header.
const LENGTH: usize = 16;
const ATOMS: usize = 24;
const FEATURES: usize = 32;
const HEADER: usize = 288;

fn assert_same_bits(a: &Candidate, b: &Candidate) {
    assert_eq!((a.id, a.origin, a.mixture_version), (b.id, b.origin, b.mixture_version));
    assert_eq!((&a.structure.species, a.structure.periodic), (&b.structure.species, b.structure.periodic));
    let fixed = |c: &Candidate| [c.temperature, c.relative_volume, c.energy];
    assert_eq!(bits(&fixed(a)), bits(&fixed(b)));
    assert_eq!(bits(a.virial.as_flattened()), bits(b.virial.as_flattened()));
    assert_eq!(bits(a.structure.cell.0.as_flattened()), bits(b.structure.cell.0.as_flattened()));
    assert_eq!(bits(a.structure.positions.as_flattened()), bits(b.structure.positions.as_flattened()));
    assert_eq!(bits(a.forces.as_flattened()), bits(b.forces.as_flattened()));
    assert_eq!(bits(&a.gamma), bits(&b.gamma));
    assert_eq!(bits(&a.gamma_nbr), bits(&b.gamma_nbr));
    assert_eq!(bits(&a.features), bits(&b.features));
}

/// The block with other numbers at these header offsets, and a valid checksum.
fn with_number(block: &CandidateBlock, numbers: &[(usize, u64)]) -> Vec<u8> {
    let mut bytes = block.as_bytes().to_vec();
    for (place, number) in numbers {
        bytes[*place..place + 8].copy_from_slice(&number.to_le_bytes());
    }
    with_checksum(bytes)
}

fn with_checksum(mut bytes: Vec<u8>) -> Vec<u8> {
    let checksum = crc32fast::hash(&bytes[16..]);
    bytes[12..16].copy_from_slice(&checksum.to_le_bytes());
    bytes
}

proptest! {
    #[test]
    fn every_bit_survives_a_round_trip(candidate in candidate()) {
        let block = CandidateBlock::encode(&candidate);
        prop_assert_eq!(block.as_bytes().len() % 8, 0);
        let copy = CandidateBlock::from_bytes(block.as_bytes()).unwrap();
        prop_assert_eq!(copy.as_bytes(), block.as_bytes());
        let view = CandidateView::new(block.as_bytes()).unwrap();
        assert_same_bits(&candidate, &view.to_candidate());
        assert_same_bits(&candidate, &copy.view().to_candidate());
        prop_assert_eq!(view.feature_dimension() * candidate.gamma.len(), candidate.features.len());
    }

    #[test]
    fn changed_bytes_are_rejected(candidate in candidate(), at in any::<prop::sample::Index>(), change in 1..=255_u8) {
        let mut bytes = CandidateBlock::encode(&candidate).as_bytes().to_vec();
        let at = at.index(bytes.len());
        bytes[at] ^= change;
        prop_assert!(CandidateBlock::from_bytes(&bytes).is_err(), "byte {}", at);
    }

    #[test]
    fn missing_and_extra_bytes_are_rejected(
        candidate in candidate(), at in any::<prop::sample::Index>(), added in vec(any::<u8>(), 1..20),
    ) {
        let bytes = CandidateBlock::encode(&candidate).as_bytes().to_vec();
        let cut = at.index(bytes.len());
        prop_assert!(CandidateBlock::from_bytes(&bytes[..cut]).is_err(), "cut at {}", cut);
        let longer = [bytes.as_slice(), &added].concat();
        let (found, expected) = (longer.len() as u64, bytes.len() as u64);
        prop_assert_eq!(CandidateBlock::from_bytes(&longer), Err(BlockError::Length { found, expected }));
    }

    #[test]
    fn random_bytes_are_rejected(bytes in vec(any::<u8>(), 0..600)) {
        prop_assert!(CandidateBlock::from_bytes(&bytes).is_err());
        prop_assert!(CandidateView::new(&bytes).is_err());
    }

    /// Counts are validated before memory is accessed, even if the checksum is valid.
    #[test]
    fn excessive_counts_are_rejected(
        candidate in candidate(), atoms in any::<u64>(), features in any::<u64>(), length in any::<u64>(),
    ) {
        let block = CandidateBlock::encode(&candidate);
        prop_assume!(![atoms, atoms >> 32].contains(&(block.view().numbers.len() as u64)));
        for numbers in [
            vec![(ATOMS, atoms)],
            vec![(ATOMS, atoms), (LENGTH, length)],
            vec![(ATOMS, atoms), (FEATURES, features), (LENGTH, length)],
            vec![(ATOMS, atoms >> 32), (FEATURES, features >> 40)],
        ] {
            let bytes = with_number(&block, &numbers);
            let found = CandidateBlock::from_bytes(&bytes);
            prop_assert!(matches!(found, Err(BlockError::Length { .. })), "{numbers:?}: {found:?}");
        }
    }

    #[test]
    fn removing_features_keeps_everything_else(candidate in candidate()) {
        let block = CandidateBlock::encode(&candidate).without_features();
        prop_assert_eq!(block.as_bytes().len(), HEADER + 72 * candidate.gamma.len());
        prop_assert_eq!(block.view().feature_dimension(), 0);
        let copy = CandidateBlock::from_bytes(block.as_bytes()).unwrap();
        let bare = Candidate { features: Vec::new(), ..candidate };
        assert_same_bits(&copy.view().to_candidate(), &bare);
    }
}

fn some_block() -> CandidateBlock {
    use proptest::strategy::ValueTree;
    let mut runner = proptest::test_runner::TestRunner::deterministic();
    CandidateBlock::encode(&candidate().new_tree(&mut runner).unwrap().current())
}

#[test]
fn every_single_byte_counts() {
    let bytes = some_block().as_bytes().to_vec();
    for at in 0..bytes.len() {
        let mut damaged = bytes.clone();
        damaged[at] ^= 1;
        assert!(CandidateBlock::from_bytes(&damaged).is_err(), "byte {at}");
        assert!(CandidateBlock::from_bytes(&bytes[..at]).is_err(), "cut at {at}");
    }
}

#[test]
fn overflowing_counts_are_rejected() {
    let block = some_block();
    let edges = [0, 1 << 31, (1 << 32) - 1, 1 << 32, 1 << 60, 1 << 63, u64::MAX / 8, u64::MAX];
    for atoms in edges {
        for features in edges {
            let bytes = with_number(&block, &[(ATOMS, atoms), (FEATURES, features)]);
            let error = CandidateBlock::from_bytes(&bytes).unwrap_err();
            assert!(matches!(error, BlockError::Length { .. }), "{atoms} × {features}: {error}");
        }
    }
}

#[test]
fn errors_are_specific() {
    let block = some_block();
    let bytes = block.as_bytes();
    let error = |bytes: &[u8]| CandidateBlock::from_bytes(bytes).unwrap_err();
    let changed = |at: usize, byte: u8| {
        let mut bytes = bytes.to_vec();
        bytes[at] = byte;
        error(&with_checksum(bytes))
    };
    let field = |error: BlockError| match error {
        BlockError::Field { field, .. } => field,
        error => panic!("{error}"),
    };
    assert_eq!(error(&[]), BlockError::Short(0));
    assert_eq!(error(&bytes[..HEADER - 1]), BlockError::Short(HEADER - 1));
    assert_eq!(changed(0, b'X'), BlockError::Magic(*b"XALMCAND"));
    assert_eq!(changed(8, 7), BlockError::Version(7));
    assert_eq!(field(changed(112, 2)), "origin");
    assert_eq!(field(changed(116, 2)), "periodic");
    assert_eq!(field(changed(119, 1)), "periodic", "the byte that only fills up");
    assert_eq!(field(changed(HEADER, 119)), "atomic number");
    assert_eq!(field(changed(HEADER, 0)), "atomic number");
    assert_eq!(field(changed(HEADER + 7, 1)), "atomic number");
    assert_eq!(field(changed(56, bytes[56] ^ 1)), "content hash");
    let position = HEADER + 8 * block.view().numbers.len();
    assert_eq!(field(changed(position, bytes[position] ^ 1)), "content hash");
}

#[test]
fn unaligned_bytes_are_rejected_in_place_but_can_be_copied() {
    let block = some_block();
    let mut words = vec![0_u64; block.as_bytes().len() / 8 + 1];
    for shift in 1..8 {
        let bytes = zerocopy::IntoBytes::as_mut_bytes(words.as_mut_slice());
        let shifted = &mut bytes[shift..shift + block.as_bytes().len()];
        shifted.copy_from_slice(block.as_bytes());
        assert_eq!(CandidateView::new(shifted).unwrap_err(), BlockError::Unaligned);
        assert_eq!(CandidateBlock::from_bytes(shifted).unwrap(), block);
    }
}

#[test]
#[should_panic = "the id contains the hash of the structure"]
fn candidates_with_a_wrong_id_are_not_encoded() {
    let mut candidate = some_block().view().to_candidate();
    candidate.structure.positions[0][0] = 1.0;
    CandidateBlock::encode(&candidate);
}

/// Memory with another owner.
struct BorrowedMemory(Vec<u64>, usize);

impl AsRef<[u8]> for BorrowedMemory {
    fn as_ref(&self) -> &[u8] {
        &zerocopy::IntoBytes::as_bytes(self.0.as_slice())[self.1..]
    }
}

#[test]
fn blocks_in_place_are_validated_without_copying() {
    let block = some_block();
    let mut words = vec![0_u64; block.as_bytes().len() / 8 + 1];
    zerocopy::IntoBytes::as_mut_bytes(words.as_mut_slice())[8..].copy_from_slice(block.as_bytes());
    let (whole, damaged) = (words.clone(), {
        words[7] ^= 1;
        words
    });
    let borrowed = std::sync::Arc::new(BorrowedMemory(whole, 8));
    let place = borrowed.as_ref().as_ref().as_ptr();
    let found = CandidateBlock::in_place(borrowed).unwrap();
    assert_eq!(found, block);
    assert_eq!(found.as_bytes().as_ptr(), place);
    assert!(matches!(
        CandidateBlock::in_place(std::sync::Arc::new(BorrowedMemory(damaged, 8))),
        Err(BlockError::Checksum { .. })
    ));
}

/// Memory that is modified while it is in use.
struct Unsteady {
    now: std::sync::atomic::AtomicBool,
    checked: Vec<u64>,
    later: Vec<u64>,
}

impl AsRef<[u8]> for Unsteady {
    fn as_ref(&self) -> &[u8] {
        let later = self.now.load(std::sync::atomic::Ordering::Relaxed);
        zerocopy::IntoBytes::as_bytes(if later { &*self.later } else { &*self.checked })
    }
}

#[test]
fn writes_after_validation_do_no_harm() {
    let block = some_block();
    let words = |bytes: &[u8]| {
        let mut words = vec![0_u64; bytes.len() / 8];
        zerocopy::IntoBytes::as_mut_bytes(words.as_mut_slice()).copy_from_slice(bytes);
        words
    };
    let checked = words(block.as_bytes());
    let later = vec![u64::MAX; checked.len()];
    let unsteady = std::sync::Arc::new(Unsteady { now: false.into(), checked, later });
    let found = CandidateBlock::in_place(std::sync::Arc::clone(&unsteady) as _).unwrap();
    let (atoms, features) = (block.view().numbers.len(), block.view().feature_dimension());
    unsteady.now.store(true, std::sync::atomic::Ordering::Relaxed);
    let view = found.view();
    assert_eq!((view.numbers.len(), view.positions.len(), view.forces.len()), (atoms, atoms, atoms));
    assert_eq!((view.gamma.len(), view.gamma_nbr.len()), (atoms, atoms));
    assert_eq!((view.feature_dimension(), view.features.len()), (features, atoms * features));
    assert_ne!(found, block);
}
