//! Corrupt or unsupported model files give errors, never a panic.

use std::path::Path;

use potentials::grace::GraceModel;
use proptest::prelude::*;

use crate::common::model_file::{BYTES, array, changed, load};

#[test]
fn the_file_itself_is_fine() {
    assert_eq!(load(&BYTES).unwrap().elements()[0].symbol(), "Al");
}

#[test]
fn a_missing_file_is_named() {
    let error = GraceModel::load(Path::new("nowhere/kokkos.npz")).unwrap_err();
    assert!(error.to_string().starts_with("nowhere/kokkos.npz: cannot be read"), "{error}");
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(64))]

    #[test]
    fn a_cut_file_is_an_error(part in 0.0..1.0_f64) {
        let length = (part * BYTES.len() as f64) as usize;
        prop_assert!(load(&BYTES[..length]).is_err());
    }

    /// Checksums detect a changed byte in an array; one in the archive's metadata may be irrelevant.
    #[test]
    fn a_changed_byte_is_an_error_or_harmless(part in 0.0..1.0_f64, change in 1_u8..) {
        let mut bytes = BYTES.clone();
        let position = (part * bytes.len() as f64) as usize;
        bytes[position] ^= change;
        if let Ok(model) = load(&bytes) {
            let original = load(&BYTES).unwrap();
            prop_assert_eq!(model.description(), original.description());
        }
    }
}

#[test]
fn wrong_arrays_are_named_with_what_was_expected() {
    for (changes, message) in [
        (vec![("mlp_rad_W1", None)], "array 'mlp_rad_W1' is missing"),
        (
            vec![("rcut", array::<f64>(&[1], &[-1.0]))],
            "array 'rcut' is -1 Å, expected a cutoff from 0.1 to 100 Å",
        ),
        (vec![("lmax", array::<i64>(&[1], &[2]))], "array 'mlp_rad_lmax' is 3, expected 2"),
        (
            vec![("lmax", array::<f64>(&[1], &[3.0]))],
            "array 'lmax' is of type <f8, expected an array of integers",
        ),
        (vec![("n_elements", array::<i64>(&[1], &[2]))], "array 'n_elements' is 2, expected 1"),
        (vec![("shift_values", array::<f64>(&[1], &[f64::NAN]))], "array 'shift_values' is partly NaN"),
        (vec![("fc_A1_w_tile_left", array::<i32>(&[16], &[9; 16]))], "indices from 0 to 3"),
        (vec![("fc_A1_collect_to", array::<i32>(&[1], &[16]))], "indices from 0 to 15"),
        (vec![("prod_AAA_left_ind", array::<i32>(&[20], &[59; 20]))], "indices from 0 to 58"),
        (
            vec![("prod_AA_cg_coeff", array::<f64>(&[2], &[1.0; 2]))],
            "array 'prod_AA_cg_coeff' is of shape [2]",
        ),
        (vec![("rho_n_out", array::<i64>(&[1], &[8]))], "array 'rho_reduce_A_W' is of shape [1, 9, 8, 1]"),
        (
            vec![("mlp_rad_has_chem_emb", array::<i64>(&[1], &[1]))],
            "a chemical embedding in the radial network",
        ),
        (vec![("mlp_rad_b0", array::<f64>(&[64], &[0.0; 64]))], "may change its energy: mlp_rad_b0"),
        (vec![("uq_schema_version", array::<i64>(&[1], &[3]))], "'uq_schema_version' is 3, expected 6"),
        (vec![("uq_feature_dim", array::<i64>(&[1], &[128]))], "array 'uq_feature_dim' is 128, expected 130"),
    ] {
        let error = changed(&changes).unwrap_err().to_string();
        assert!(error.contains(message), "{error}\nis not\n{message}");
    }
}

#[test]
fn scalars_come_in_either_shape_and_type() {
    for cutoff in [array::<i64>(&[], &[6]), array::<i64>(&[1], &[6]), array::<f64>(&[], &[6.0])] {
        assert_eq!(changed(&[("rcut", cutoff)]).unwrap().cutoff(), 6.0);
    }
}

#[test]
fn a_model_without_feature_arrays_has_no_features() {
    let model = changed(&[("uq_schema_version", None)]).unwrap();
    assert_eq!(model.feature_dimension(), 0);
    assert!(model.projection().is_none());
}
