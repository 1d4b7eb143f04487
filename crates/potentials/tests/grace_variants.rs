//! Variants of the model format that no available model uses, each made equivalent to one that is tested
//! against the framework, or compared with its definition.

use std::sync::Arc;

use atoms::{Cell, Evaluation, NeighbourList, Structure};
use potentials::grace::{Grace, GraceModel, GraceProjection, PullBack};

use crate::common;
use crate::common::model_file::{BYTES, array, changed, changed_of, deep, floats, strings};
use crate::common::{check_forces, check_virial};

type Changes<'a> = Vec<(&'a str, Option<Vec<u8>>)>;

fn structure() -> Structure {
    let positions = vec![[0.0, 0.1, 0.0], [0.2, 2.1, 1.9], [2.0, -0.1, 2.2], [2.1, 2.0, 0.1]];
    Structure {
        species: vec!["Al".parse().unwrap(); 4],
        positions,
        cell: Cell([[4.1, 0.1, 0.0], [0.0, 4.2, 0.0], [0.2, 0.0, 4.0]]),
        periodic: [true; 3],
    }
}

fn forward(model: GraceModel) -> Grace {
    let mut structure = structure();
    let element = model.elements()[0];
    structure.species.fill(element);
    let mut grace = Grace::new(Arc::new(model));
    let mut neighbours = NeighbourList::new(grace.model().cutoff(), 0.0);
    neighbours.update(&structure).unwrap();
    grace.forward(&structure, &neighbours).unwrap();
    grace
}

/// The same energies and forces to rounding.
fn assert_equivalent(one: Changes, other: Changes) {
    let [one, other] = [one, other].map(|changes| {
        let mut grace = forward(changed(&changes).unwrap());
        let mut evaluation = Evaluation::default();
        grace.backward(None, &mut evaluation, &mut PullBack::default());
        evaluation
    });
    assert!((one.energy() - other.energy()).abs() < 1e-12, "{} {}", one.energy(), other.energy());
    common::assert_close("force", one.forces.as_flattened(), other.forces.as_flattened(), 1e-11);
}

fn zeros(name: &str) -> Option<Vec<u8>> {
    let (shape, data) = floats(name);
    array(&shape, &vec![0.0_f64; data.len()])
}

/// Removes what only products above order `order` need, and the features.
fn without_orders_above(order: usize) -> Changes<'static> {
    let mut changes = vec![
        ("rho_instruction_names", strings(&["A", "AA", "AAA", "AAAA"][..order])),
        ("uq_schema_version", None),
    ];
    for (needed_from, name) in [(2, "fc_A1"), (3, "fc_AA1"), (4, "fc_AA2")] {
        for suffix in [
            "w_left",
            "norm_left",
            "w_right",
            "norm_right",
            "w_tile_left",
            "w_tile_right",
            "collect_to",
            "collect_from",
            "norm_out_factor",
            "n_out",
            "left_coefs",
        ] {
            if order < needed_from {
                changes.push((format!("{name}_{suffix}").leak(), None));
            }
        }
    }
    for (needed_from, name) in [(2, "AA"), (3, "AAA"), (4, "AAAA")] {
        for (prefix, suffix) in [
            ("prod_", "_left_ind"),
            ("prod_", "_right_ind"),
            ("prod_", "_m_sum_ind"),
            ("prod_", "_cg_coeff"),
            ("prod_", "_n_output_funcs"),
            ("prod_", "_n_cg_terms"),
            ("prod_", "_lmax"),
            ("prod_", "_Lmax"),
            ("rho_reduce_", "_W"),
            ("rho_reduce_", "_norm"),
            ("rho_collect_ind_", ""),
            ("rho_w_l_tile_", ""),
            ("rho_total_sum_ind_", ""),
            ("rho_w_shape_", ""),
            ("rho_n_in_", ""),
        ] {
            if order < needed_from {
                changes.push((format!("{prefix}{name}{suffix}").leak(), None));
            }
        }
    }
    changes
}

#[test]
fn a_lower_maximum_order_is_the_full_model_with_zero_weights() {
    let full = [(2, "rho_reduce_AA_W"), (3, "rho_reduce_AAA_W"), (4, "rho_reduce_AAAA_W")];
    for order in 1..4 {
        let dropped = full.iter().filter(|(of, _)| *of > order);
        assert_equivalent(
            without_orders_above(order),
            dropped.map(|(_, name)| (*name, zeros(name))).collect(),
        );
    }
}

#[test]
fn a_left_input_without_weights_is_one_with_the_identity() {
    let (shape, _) = floats("fc_AA1_w_left");
    let [n, _, tiles] = shape[..] else { panic!("{shape:?}") };
    let identity: Vec<f64> =
        (0..n * n * tiles).map(|k| f64::from(u8::from(k / tiles / n == k / tiles % n))).collect();
    assert_equivalent(
        vec![
            ("fc_AA1_left_coefs", array(&[1], &[0_i64])),
            ("fc_AA1_w_left", None),
            ("fc_AA1_norm_left", None),
            ("fc_AA1_w_tile_left", None),
        ],
        vec![("fc_AA1_w_left", array(&shape, &identity)), ("fc_AA1_norm_left", array(&[], &[1.0]))],
    );
}

#[test]
fn weights_that_are_the_same_for_all_elements_have_one_dimension_less() {
    let mut changes = vec![("rho_is_central_atom_type_dependent", array(&[1], &[0_i64]))];
    for name in ["rho_reduce_A_W", "rho_reduce_AA_W", "rho_reduce_AAA_W", "rho_reduce_AAAA_W"] {
        let (shape, data) = floats(name);
        changes.push((name, array(&shape[1..], &data)));
    }
    assert_equivalent(changes, vec![]);
}

#[test]
fn one_cutoff_for_each_pair_may_be_the_same_for_all() {
    assert_equivalent(
        vec![
            ("has_bond_specific_cutoff", array(&[1], &[1_i64])),
            ("bond_cutoff_map", array(&[1, 1], &[6.5])),
        ],
        vec![],
    );
}

#[test]
fn shift_and_scale_may_be_absent() {
    let energy = |changes: Changes| forward(changed(&changes).unwrap()).atomic_energies()[0];
    let (shift, scale) = (floats("shift_values").1[0], floats("output_scale").1[0]);
    let bare = energy(vec![("shift_values", None), ("output_scale", None)]);
    assert!((energy(vec![]) - (scale * bare + shift)).abs() < 1e-12);
}

#[test]
fn a_readout_with_tanh_has_the_right_derivatives() {
    let model = changed(&[("energy_mlp_activation", array(&[1], &[1_i64]))]).unwrap();
    let mut grace = Grace::new(Arc::new(model));
    check_forces(&mut grace, &structure(), 1e-3, 1e-8);
    check_virial(&mut grace, &structure(), 1e-4, 1e-8);
    let silu = forward(changed(&[]).unwrap()).atomic_energies()[0];
    assert!((common::evaluate(&mut grace, &structure()).atomic_energies[0] - silu).abs() > 1e-6);
}

/// Features without normalisation or densities: p = B R, so the features of the committed model are p / ‖B‖.
#[test]
fn features_of_the_older_schemas_follow_their_definition() {
    check_older_schemas(&BYTES, 128, 2);
    check_older_schemas(&deep("two_layers.npz"), 6, 3);
    check_older_schemas(&deep("three_layers.npz"), 6, 4);
}

/// `d` projected features and `norms` of the basis and its blocks in a model of the newest schema.
fn check_older_schemas(model: &[u8], d: usize, norms: usize) {
    let flags = |version: i64, asinh: i64| {
        changed_of(
            model,
            &[
                ("uq_schema_version", array(&[1], &[version])),
                ("uq_rp_normalize", None),
                ("uq_rp_add_density_channel", None),
                ("uq_rp_density_scale", None),
                ("uq_feature_dim", array(&[1], &[d as i64])),
                ("uq_feature_transform", array(&[1], &[asinh])),
            ],
        )
        .unwrap()
    };
    let (newest, mut linear, mut asinh) =
        (forward(changed_of(model, &[]).unwrap()), forward(flags(3, 0)), forward(flags(4, 1)));
    for ((z, p), t) in
        newest.features().chunks(d + norms).zip(linear.features().chunks(d)).zip(asinh.features().chunks(d))
    {
        let norm = z[d].exp() - 1e-12;
        for k in 0..d {
            assert!((p[k] - z[k] * norm).abs() < 1e-12 * norm.max(1.0));
            assert!((t[k] - p[k].asinh()).abs() < 1e-14);
        }
    }
    // H = Σ asinh(p) has the cotangent 1/√(1 + p²) on the linear features.
    let (mut energy, mut of_asinh, mut of_linear) = Default::default();
    asinh.backward(Some(&vec![1.0; asinh.features().len()]), &mut energy, &mut of_asinh);
    let slopes: Vec<f64> = linear.features().iter().map(|p| 1.0 / (1.0 + p * p).sqrt()).collect();
    linear.backward(Some(&slopes), &mut energy, &mut of_linear);
    let (found, expected): (PullBack, PullBack) = (of_asinh, of_linear);
    common::assert_close("gradient", found.gradient.as_flattened(), expected.gradient.as_flattened(), 1e-12);
    common::assert_close("virial", found.virial.as_flattened(), expected.virial.as_flattened(), 1e-12);
}

#[test]
fn a_given_projection_replaces_that_of_the_file() {
    for bytes in [BYTES.clone(), deep("two_layers.npz"), deep("three_layers.npz")] {
        let own = changed_of(&bytes, &[]).unwrap();
        let projection = own.projection().unwrap().clone();
        let expected = forward(own.clone());
        let plain = changed_of(&bytes, &[("uq_schema_version", None)]).unwrap();
        assert_eq!(plain.feature_dimension(), 0);
        let given = plain.with_projection(projection.clone()).unwrap();
        assert_eq!(given.description(), own.description());
        let found = forward(given);
        assert_eq!(found.features(), expected.features());
        assert_eq!(found.atomic_energies(), expected.atomic_energies());

        // Other features of the same model: half as many, linear.
        let half = projection.dimension / 2;
        let matrix = projection.matrix.chunks(projection.dimension).flat_map(|row| row[..half].to_vec());
        let linear = GraceProjection {
            matrix: matrix.collect(),
            dimension: half,
            normalize: false,
            density_channels: false,
            ..projection.clone()
        };
        let linear = forward(own.clone().with_projection(linear).unwrap());
        assert_eq!(linear.model().description().feature_dimension, half);
        let rows = linear.features().chunks(half).zip(expected.features().chunks(own.feature_dimension()));
        for (p, z) in rows {
            let norm = z[projection.dimension].exp() - 1e-12;
            let near = |(p, z): (&f64, &f64)| (p - z * norm).abs() < 1e-12 * norm.max(1.0);
            assert!(p.iter().zip(z).all(near));
        }

        let other = GraceProjection { layers: projection.layers + 1, ..projection.clone() };
        let message = own.clone().with_projection(other).unwrap_err().to_string();
        assert!(message.contains("layers, the model has"), "{message}");
        let mut short = projection.clone();
        short.matrix.pop();
        let message = own.with_projection(short).unwrap_err().to_string();
        assert!(message.contains("numbers in its matrix, the model has"), "{message}");
    }
}
