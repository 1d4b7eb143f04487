//! Strategies for arbitrary candidates.
use atoms::{Cell, Species, Structure, Vec3};
use proptest::array::{uniform3, uniform9, uniform16};
use proptest::collection::vec;
use proptest::prelude::*;
use wire::{CampaignId, Candidate, CandidateId, ContentHash, Origin, WalkId};

/// Any 64 bits as a number: NaNs with payload, infinities, subnormal numbers, −0.
pub fn any_bits() -> impl Strategy<Value = f64> {
    any::<u64>().prop_map(f64::from_bits)
}

pub fn bits<'a>(numbers: impl IntoIterator<Item = &'a f64>) -> Vec<u64> {
    numbers.into_iter().map(|number| number.to_bits()).collect()
}

pub fn origin() -> impl Strategy<Value = Origin> {
    prop_oneof![Just(Origin::Biased), Just(Origin::Control)]
}

fn species() -> impl Strategy<Value = Species> {
    (1..=118_u8).prop_map(|number| Species::from_atomic_number(number).unwrap())
}

fn vectors(n: usize) -> impl Strategy<Value = Vec<Vec3>> {
    vec(uniform3(any_bits()), n)
}

/// A structure of `n` atoms with arbitrary numbers.
fn any_structure(n: usize) -> impl Strategy<Value = Structure> {
    (vec(species(), n), vectors(n), uniform9(any_bits()), uniform3(any::<bool>())).prop_map(
        |(species, positions, cell, periodic)| Structure {
            species,
            positions,
            cell: Cell(rows(cell)),
            periodic,
        },
    )
}

/// A valid structure.
pub fn usable_structure() -> impl Strategy<Value = Structure> {
    (1..6_usize).prop_flat_map(|n| {
        let positions = vec(uniform3(-9.0..9.0), n);
        (vec(species(), n), positions, uniform3(3.0..9.0), -1.0..1.0, uniform3(any::<bool>())).prop_map(
            |(species, positions, [a, b, c], tilt, periodic)| {
                let cell = Cell([[a, 0.0, 0.0], [tilt, b, 0.0], [0.0, tilt, c]]);
                Structure { species, positions, cell, periodic }
            },
        )
    })
}

fn rows(m: [f64; 9]) -> [[f64; 3]; 3] {
    std::array::from_fn(|i| std::array::from_fn(|k| m[3 * i + k]))
}

/// A candidate of 1 to 5 atoms with 0 to 3 features per atom.
pub fn candidate() -> impl Strategy<Value = Candidate> {
    (1..6_usize, 0..4_usize).prop_flat_map(|(n, dimension)| {
        let place =
            (uniform16(any::<u8>()), any::<u32>(), any::<u32>(), any::<u64>(), origin(), any::<u64>());
        let numbers = (any_bits(), any_bits(), any_bits(), uniform9(any_bits()));
        let grades = (vec(any_bits(), n), vec(any_bits(), n), vec(any_bits(), n * dimension));
        (place, numbers, any_structure(n), vectors(n), grades).prop_map(
            |(place, numbers, structure, forces, (gamma, gamma_nbr, features))| {
                let (campaign, walk, segment, step, origin, mixture_version) = place;
                let (temperature, relative_volume, energy, virial) = numbers;
                let content = ContentHash::from_structure(&structure);
                let (campaign, walk) = (CampaignId(campaign), WalkId(walk));
                Candidate {
                    id: CandidateId { campaign, walk, segment, step, content },
                    origin,
                    mixture_version,
                    temperature,
                    relative_volume,
                    energy,
                    virial: rows(virial),
                    structure,
                    forces,
                    gamma,
                    gamma_nbr,
                    features,
                }
            },
        )
    })
}
