//! Identifiers as text.

use proptest::prelude::*;
use wire::{CampaignId, CandidateId, ContentHash, Origin, WalkId};

use crate::common::usable_structure;

proptest! {
    #[test]
    fn ids_survive_a_round_trip_through_text(a in any::<[u8; 16]>(), b in any::<[u8; 32]>()) {
        let (campaign, hash) = (CampaignId(a), ContentHash(b));
        prop_assert_eq!(campaign.to_string().parse(), Ok(campaign));
        prop_assert_eq!(campaign.to_string().to_uppercase().parse(), Ok(campaign));
        prop_assert_eq!(hash.to_string().parse(), Ok(hash));
        prop_assert_eq!(hash.to_string().len(), 64);
    }

    #[test]
    fn other_text_is_rejected(text in ".{0,70}") {
        let is_hexadecimal = text.bytes().all(|byte| byte.is_ascii_hexdigit());
        prop_assert_eq!(text.parse::<CampaignId>().is_ok(), is_hexadecimal && text.len() == 32);
        prop_assert_eq!(text.parse::<ContentHash>().is_ok(), is_hexadecimal && text.len() == 64);
    }

    /// Changing any number of a structure changes its hash; nothing else does.
    #[test]
    fn different_structures_have_different_hashes(structure in usable_structure(), at in any::<prop::sample::Index>()) {
        let hash = ContentHash::from_structure(&structure);
        prop_assert_eq!(ContentHash::from_structure(&structure.clone()), hash);
        let mut others = vec![structure.clone(); 4];
        let x = &mut others[0].positions.as_flattened_mut()[at.index(3 * structure.len())];
        *x = f64::from_bits(x.to_bits() ^ 1);
        others[1].cell.0.as_flattened_mut()[at.index(9)] += 1.0;
        others[2].periodic[at.index(3)] ^= true;
        let species = &mut others[3].species[at.index(structure.len())];
        *species = atoms::Species::from_atomic_number(species.atomic_number() % 118 + 1).unwrap();
        for other in others {
            prop_assert_ne!(ContentHash::from_structure(&other), hash);
        }
    }
}

#[test]
fn signs_are_not_digits() {
    let text = "+f".repeat(16);
    let error = text.parse::<CampaignId>().unwrap_err();
    assert_eq!(error.to_string(), format!("'{text}' is not a campaign id (32 hexadecimal digits)"));
    assert!("é".repeat(16).parse::<CampaignId>().is_err());
}

#[test]
fn candidate_ids_contain_every_part() {
    let id = CandidateId {
        campaign: CampaignId(std::array::from_fn(|k| 0x9f - 0x11 * k.min(3) as u8)),
        walk: WalkId(3),
        segment: 0,
        step: 1240,
        content: ContentHash(std::array::from_fn(|k| {
            [0x01, 0x23, 0x45, 0x67, 0x89, 0xab, 0xcd, 0xef][k % 8]
        })),
    };
    assert_eq!(id.to_string(), "9f8e7d6c-3.0.1240-0123456789abcdef");
    let others = [
        CandidateId { campaign: CampaignId([0; 16]), ..id },
        CandidateId { walk: WalkId(4), ..id },
        CandidateId { segment: 1, ..id },
        CandidateId { step: 1241, ..id },
        CandidateId { content: ContentHash([0; 32]), ..id },
    ];
    assert!(others.iter().all(|other| other.to_string() != id.to_string()));
    assert_eq!(format!("{}|{:>8}", Origin::Biased, Origin::Control), "biased| control");
}
