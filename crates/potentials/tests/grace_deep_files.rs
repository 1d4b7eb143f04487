//! Two- and three-layer model files that are corrupt or describe another graph are rejected.

use proptest::prelude::*;

use crate::common::model_file::{array, changed_of, deep, floats_of, integers_of, length, names, strings};

const FILES: [&str; 2] = ["two_layers.npz", "three_layers.npz"];

/// Arrays that may be absent or are not needed.
fn is_optional(name: &str) -> bool {
    let copied = ["I_out_0_", "I_out_1_", "I_1_LN_", "rho_LN_"];
    let known = ["shift_values", "output_scale", "nn_dtype", "chem_embedding_size", "embedding_size"];
    // Without its version the feature map is ignored, so its flags may be absent.
    let features = ["uq_schema_version", "uq_rp_density_scale", "uq_rp_normalize"].contains(&name);
    let switches = ["_has_chem_emb", "_embed_i", "_embed_j", "_indicator_l_depend", "_sum_neighbors"];
    let unused = ["_lmax", "_Lmax", "_w_tile_left"];
    // Switches whose absence means the default, and placeholders of three-layer models.
    let placeholders =
        ["nradbase", "rcut", "radial_basis_p", "energy_mlp_activation", "has_bond_specific_cutoff"];
    copied.iter().any(|prefix| name.starts_with(prefix))
        || features
        || known.contains(&name)
        || placeholders.contains(&name)
        || name.ends_with("_norm_map")
        || name.ends_with("_only_invar")
        || switches.iter().chain(&unused).any(|suffix| name.ends_with(suffix))
}

#[test]
fn every_array_is_missed_and_called_by_its_name() {
    for file in FILES {
        let model = deep(file);
        changed_of(&model, &[]).unwrap();
        for name in names(&model) {
            match changed_of(&model, &[(&name, None)]) {
                Ok(_) => assert!(is_optional(&name), "{file}: {name} was not missed"),
                // Without these names the loader assumes another depth, so its error names other arrays.
                Err(_) if name == "spb_names" || name == "spbf_names" => {}
                // Without one of its flags a feature map contradicts its version or its dimension.
                Err(error) if name.starts_with("uq_rp_") => assert!(error.to_string().contains("'uq_")),
                Err(error) => {
                    let error = error.to_string();
                    // If an optional array is absent, its alias remains unread.
                    let of_copy = is_optional(&name) && error.contains("unknown for a");
                    assert!(error.contains(&name) || of_copy, "{file}: {error} is not about {name}");
                }
            }
        }
    }
}

#[test]
fn every_array_that_is_not_known_is_refused() {
    for (file, depth) in FILES.into_iter().zip(["two", "three"]) {
        let error = changed_of(&deep(file), &[("eq9_norm_map", array(&[], &[2.0]))]).unwrap_err().to_string();
        assert!(error.contains(&format!("unknown for a {depth}-layer model")), "{error}");
        assert!(error.ends_with("may change its energy: eq9_norm_map"), "{error}");
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(96))]

    /// Any other numbers in place of any array give an error, never a panic.
    #[test]
    fn another_size_is_an_error(
        file in 0..2_usize,
        place in 0.0..1.0_f64,
        shape in proptest::collection::vec(0..4_u64, 0..5),
    ) {
        let model = deep(FILES[file]);
        let names = names(&model);
        let name = &names[(place * names.len() as f64) as usize];
        let items = shape.iter().product::<u64>() as usize;
        let as_many = length(&model, name) == items;
        for change in [array(&shape, &vec![0.25_f64; items]), array(&shape, &vec![1_i64; items])] {
            let accepted = changed_of(&model, &[(name, change)]).is_ok();
            prop_assert!(!accepted || as_many || is_optional(name), "{name}: {shape:?} is accepted");
        }
    }
}

#[test]
fn a_graph_of_another_kind_is_refused() {
    let two: &[(&str, Option<Vec<u8>>, &str)] = &[
        ("fc_names", strings(&["A1", "AA1", "B1", "BB1", "BB3"]), "'fc_names' lists A1, AA1, B1, BB1, BB3"),
        ("spb_names", strings(&["A", "C0"]), "supported models of this depth have A, B0"),
        ("reduce_names", strings(&["I1", "I", "B", "I_out_1"]), "expected I1, I, B"),
        ("rms_names", strings(&["I_1_LN"]), "array 'rms_names' is a list of 1"),
        (
            "I_out_0_reduce_A_norm",
            array(&[], &[0.5]),
            "'I_out_0_reduce_A_norm' differs from rho_reduce_A_norm",
        ),
        ("I_1_LN_type", array(&[1], &[2_i64]), "array 'I_1_LN_type' differs from"),
        ("I_nl_LN_type", array(&[1], &[3_i64]), "array 'I_nl_LN_type' is 3, expected a number from 0 to 2"),
        ("mlp_rad_R1_embed_j", array(&[1], &[1_i64]), "an embedding of the neighbour's element"),
        ("YI_m_sum_ind", array(&[80], &[99_i64; 80]), "array 'YI_m_sum_ind' is a list with the index 99"),
        ("I2_n_out", array(&[1], &[4_i64]), "array 'I2_n_out' is 4, expected 5"),
    ];
    let three: &[(&str, Option<Vec<u8>>, &str)] = &[
        ("spbf_names", strings(&["A1", "A2"]), "'spbf_names' lists A1, A2"),
        ("prod_names", strings(&["A1_2", "A1_3"]), "'prod_names' lists A1_2, A1_3, but"),
        ("out1_origins", strings(&["rho1"]), "'out1_origins' lists rho1, but"),
        ("energy_mlp_n_origins", array(&[1], &[2_i64]), "array 'energy_mlp_n_origins' is 2, expected 3"),
        ("A2_equivariant", array(&[1], &[0_i64]), "array 'A2_equivariant' is 0, expected 1"),
        (
            "has_bond_specific_cutoff",
            array(&[1], &[1_i64]),
            "cutoffs for pairs of elements in a three-layer model",
        ),
        ("A3_n_lm_ind", array(&[1], &[9_i64]), "array 'A3_n_lm_ind' is 9, expected 18"),
        ("A1_l_tile", array(&[9], &[0_i64; 9]), "array 'A1_l_tile' is [0, 0, 0, 0, 0, 0, 0, 0, 0]"),
        ("A2_mlp_b2", array(&[1, 6], &[0.0; 6]), "may change its energy: A2_mlp_b2"),
        ("eq1_norm_eps", array(&[], &[0.0]), "array 'eq1_norm_eps' is 0, expected"),
        ("A1_2_nfunc", array(&[1], &[25_i64]), "array 'A1_2_nfunc' is 25, expected 24"),
        ("rho2_instruction_names", strings(&["A2_red"]), "'rho2_instruction_names' lists A2_red, but"),
    ];
    for (file, changes) in FILES.into_iter().zip([two, three]) {
        for (name, change, message) in changes {
            let error = changed_of(&deep(file), &[(name, change.clone())]).unwrap_err().to_string();
            assert!(error.contains(message), "{error}\nis not\n{message}");
        }
    }
}

/// Names and shapes are right, but components of different orders are coupled.
#[test]
fn a_model_that_knows_directions_is_refused() {
    for (file, name) in [
        ("two_layers.npz", "prod_BB_right_ind"),
        ("two_layers.npz", "YI_lr_inds"),
        ("three_layers.npz", "A1_2_right_ind"),
        ("three_layers.npz", "A3_3_left_ind"),
    ] {
        let model = deep(file);
        let (shape, mut data) = integers_of(&model, name);
        let half = data.len() / 4 * 2;
        data.rotate_left(half);
        let error = changed_of(&model, &[(name, array(&shape, &data))]).unwrap_err().to_string();
        assert!(error.contains("eV when a cluster is rotated"), "{name}: {error}");
    }
}

#[test]
fn not_a_number_is_found_anywhere() {
    for file in FILES {
        let model = deep(file);
        for name in ["chem_embedding", "rho1_norm_scale", "I_nl_LN_scale", "YI_cg_coeff", "A3_cg_W", "A2_4_U"]
        {
            if !names(&model).iter().any(|known| known == name) {
                continue;
            }
            let (shape, mut data) = floats_of(&model, name);
            data[0] = f64::NAN;
            let error = changed_of(&model, &[(name, array(&shape, &data))]).unwrap_err().to_string();
            assert!(error.contains(&format!("array '{name}' is partly NaN")), "{error}");
        }
    }
}
