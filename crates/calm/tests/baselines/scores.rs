//! LLPR, distances and likelihood against their definitions.

use calm::baselines::{BaselineError, BaselineKind, BaselineSettings, Builder};
use calm::{Component, Mixture};

use super::{built, dot, frames, joined, mixture, solve};
use crate::common::{Random, assert_close};

/// √(hᵀ(G + λI)⁻¹h)
fn llpr(rows: &[Vec<f64>], regularisation: f64, h: &[f64]) -> f64 {
    let dimension = h.len();
    let sum = |i: usize, j: usize| rows.iter().map(|row| row[i] * row[j]).sum::<f64>();
    let mut gram: Vec<Vec<f64>> =
        (0..dimension).map(|i| (0..dimension).map(|j| sum(i, j)).collect()).collect();
    let trace: f64 = (0..dimension).map(|k| gram[k][k]).sum();
    (0..dimension).for_each(|k| gram[k][k] += regularisation * trace / dimension as f64);
    dot(h, &solve(gram, h.to_vec()).0).sqrt()
}

#[test]
fn llpr_is_that_of_its_gram_matrix() {
    let (dimension, elements) = (5, 2);
    let (frames, mixture) = (frames(3, dimension, elements, 200), mixture(3, dimension, elements));
    let queries = Random(1).take(20 * dimension);
    let sum = |features: &[f64]| -> Vec<f64> {
        (0..dimension).map(|axis| features.iter().skip(axis).step_by(dimension).sum()).collect()
    };
    for regularisation in [1e-12, 1e-3] {
        let settings = BaselineSettings { regularisation, ..BaselineSettings::default() };
        for kind in [BaselineKind::Llpr, BaselineKind::LlprSum] {
            let rows: Vec<Vec<f64>> = frames
                .iter()
                .map(|(elements, features)| {
                    let atoms = if kind == BaselineKind::Llpr { elements.len() as f64 } else { 1.0 };
                    sum(features).iter().map(|x| x / atoms).collect()
                })
                .collect();
            let baseline = built(kind, &settings, &frames, dimension, &mixture);
            let expected: Vec<f64> =
                queries.chunks_exact(dimension).map(|h| llpr(&rows, regularisation, h)).collect();
            assert_close(kind.name(), &baseline.score(&[0; 20], &queries).unwrap(), &expected, 1e-9);
            assert_eq!(baseline.score_forces(&queries).unwrap(), None);
        }
    }
}

#[test]
fn llpr_of_forces_has_the_rows_of_forces() {
    let (dimension, atoms) = (4, 3);
    let settings =
        BaselineSettings { regularisation: 1e-6, force_weight: 0.25, ..BaselineSettings::default() };
    let mut builder = Builder::new(BaselineKind::LlprForces, &settings, dimension, 1, None).unwrap();
    let mut rows = Vec::new();
    for seed in 0..60 {
        let (features, forces) =
            (Random(seed).take(atoms * dimension), Random(seed + 1000).take(3 * atoms * dimension));
        builder.add(&[0; 3], &features).unwrap();
        builder.add_forces(&forces).unwrap();
        let mean = |axis: usize| features.iter().skip(axis).step_by(dimension).sum::<f64>() / atoms as f64;
        rows.push((0..dimension).map(mean).collect::<Vec<_>>());
        rows.extend(forces.chunks_exact(dimension).map(|row| row.iter().map(|x| 0.5 * x).collect()));
    }
    assert!(!builder.end_sweep());
    let baseline = builder.finish().unwrap();
    let forces = Random(5).take(3 * atoms * dimension);
    let components: Vec<f64> = forces.chunks_exact(dimension).map(|row| llpr(&rows, 1e-6, row)).collect();
    let expected: Vec<f64> = components.chunks_exact(3).map(|u| dot(u, u).sqrt()).collect();
    assert_close("forces", &baseline.score_forces(&forces).unwrap().unwrap(), &expected, 1e-10);
    let wrong = baseline.score_forces(&forces[..2 * dimension]).unwrap_err();
    assert!(matches!(wrong, BaselineError::Length { .. }), "{wrong}");
}

fn distance(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).map(|(a, b)| (a - b) * (a - b)).sum::<f64>().sqrt()
}

#[test]
fn distances_are_those_of_all_pairs() {
    let (dimension, elements) = (6, 2);
    let (frames, mixture) = (frames(5, dimension, elements, 150), mixture(5, dimension, elements));
    let (of, features) = joined(&frames);
    let queries = Random(2).take(40 * dimension);
    let of_queries: Vec<usize> = (0..40).map(|k| k % 2).collect();
    let rows = || queries.chunks_exact(dimension).zip(&of_queries);

    let euclidean = built(BaselineKind::Euclidean, &BaselineSettings::default(), &[], dimension, &mixture);
    let nearest = |(z, element): (&[f64], &usize)| {
        let components = mixture.components(*element).unwrap().iter();
        components.map(|component| distance(z, component.centroid())).fold(f64::INFINITY, f64::min)
    };
    let expected: Vec<f64> = rows().map(nearest).collect();
    assert_close("euclidean", &euclidean.score(&of_queries, &queries).unwrap(), &expected, 1e-14);

    for neighbours in [1, 5, 10_000] {
        let settings = BaselineSettings { neighbours, ..BaselineSettings::default() };
        let baseline = built(BaselineKind::KNearest, &settings, &frames, dimension, &mixture);
        let nth = |(z, element): (&[f64], &usize)| {
            let training = features.chunks_exact(dimension).zip(&of).filter(|(_, of)| *of == element);
            let mut all: Vec<f64> = training.map(|(row, _)| distance(z, row)).collect();
            all.sort_by(f64::total_cmp);
            all[neighbours.min(all.len()) - 1]
        };
        let expected: Vec<f64> = rows().map(nth).collect();
        assert_close("k nearest", &baseline.score(&of_queries, &queries).unwrap(), &expected, 1e-12);
    }
    // A training atom is its own nearest neighbour, exactly.
    let settings = BaselineSettings { neighbours: 1, ..BaselineSettings::default() };
    let own =
        built(BaselineKind::KNearest, &settings, &frames, dimension, &mixture).score(&of, &features).unwrap();
    assert!(own.iter().all(|distance| *distance < 1e-15), "{own:?}");
}

#[test]
fn a_sample_is_bounded_and_does_not_depend_on_batches() {
    let (dimension, elements) = (2, 2);
    let (frames, mixture) = (frames(6, dimension, elements, 400), mixture(6, dimension, elements));
    let settings = BaselineSettings { sample: 50, neighbours: 50, ..BaselineSettings::default() };
    let build = |frames: &[_], seed| {
        built(
            BaselineKind::KNearest,
            &BaselineSettings { seed, ..settings.clone() },
            frames,
            dimension,
            &mixture,
        )
    };
    let sampled = build(&frames, 42);
    assert_eq!(sampled, build(&[joined(&frames)], 42));
    assert_ne!(sampled, build(&frames, 43));
    // The furthest of 50 is nearer than the furthest of all.
    let all = BaselineSettings { neighbours: 10_000, ..BaselineSettings::default() };
    let all = built(BaselineKind::KNearest, &all, &frames, dimension, &mixture);
    let (near, far) = (sampled.score(&[0], &[0.0, 0.0]).unwrap(), all.score(&[0], &[0.0, 0.0]).unwrap());
    assert!(near[0] > 0.0 && near[0] <= far[0]);
}

#[test]
fn the_likelihood_is_that_of_normal_distributions() {
    let (dimension, elements) = (4, 2);
    let mixture = mixture(9, dimension, elements);
    let baseline = built(BaselineKind::Likelihood, &BaselineSettings::default(), &[], dimension, &mixture);
    let queries: Vec<f64> = Random(3).take(30 * dimension).iter().map(|x| 1.0 + x).collect();
    let of: Vec<usize> = (0..30).map(|k| k % 2).collect();
    let likelihood = |(z, element): (&[f64], &usize)| {
        let counts = [30.0 + *element as f64, 10.0];
        let components = mixture.components(*element).unwrap().iter().zip(counts);
        let density = components.map(|(component, count)| {
            let normal = |axis: usize| {
                let variance = 0.02 + 0.01 * axis as f64 + 1e-6;
                let delta = z[axis] - component.centroid()[axis];
                (-0.5 * delta * delta / variance).exp() / (std::f64::consts::TAU * variance).sqrt()
            };
            count / (counts[0] + counts[1]) * (0..dimension).map(normal).product::<f64>()
        });
        -density.sum::<f64>().ln()
    };
    let expected: Vec<f64> = queries.chunks_exact(dimension).zip(&of).map(likelihood).collect();
    assert_close("likelihood", &baseline.score(&of, &queries).unwrap(), &expected, 1e-9);
    // Where the density underflows, its logarithm does not.
    let far = baseline.score(&[0], &[1e4; 4]).unwrap();
    assert!(far[0].is_finite() && far[0] > 1e9, "{far:?}");
}

#[test]
fn wrong_input_is_refused() {
    let settings = BaselineSettings::default();
    let mixture = mixture(1, 3, 1);
    let refused = |kind, settings: &BaselineSettings, dimension, elements, mixture: Option<&Mixture>| {
        Builder::new(kind, settings, dimension, elements, mixture).unwrap_err().to_string()
    };
    assert_eq!(
        refused(BaselineKind::Euclidean, &settings, 3, 1, None),
        "euclidean needs a mixture of the same features"
    );
    assert_eq!(
        refused(BaselineKind::Euclidean, &settings, 4, 1, Some(&mixture)),
        "the mixture has 3 features, expected 4"
    );
    assert_eq!(
        refused(BaselineKind::Euclidean, &settings, 3, 2, Some(&mixture)),
        "the mixture has 1 elements, expected 2"
    );
    let wrong = BaselineSettings { tolerance: -1.0, ..settings.clone() };
    assert_eq!(
        refused(BaselineKind::Llpr, &wrong, 3, 1, None),
        "tolerance: found -1, expected a number above 0"
    );
    let bare = Component::new(vec![0.0; 3], vec![0.0; 9], 1.0, None).unwrap();
    let bare = Mixture::new(0, vec![vec![bare.into()]]).unwrap();
    assert!(refused(BaselineKind::Likelihood, &settings, 3, 1, Some(&bare)).contains("no counts"));

    for kind in BaselineKind::ALL.into_iter().filter(|kind| kind.needs_data()) {
        let mut builder = Builder::new(kind, &settings, 3, 1, Some(&mixture)).unwrap();
        let wrong = |found: Result<(), BaselineError>| found.unwrap_err().to_string();
        assert_eq!(wrong(builder.add(&[0], &[0.0; 2])), "features: found 2 numbers, expected 3");
        assert!(wrong(builder.add(&[0], &[0.0, f64::NAN, 0.0])).starts_with("features of atom 0"));
        if !matches!(kind, BaselineKind::Llpr | BaselineKind::LlprSum | BaselineKind::LlprForces) {
            assert!(
                wrong(builder.add(&[1], &[0.0; 3]))
                    .contains("has element index 1, the baseline has 1 elements")
            );
        }
        assert!(builder.end_sweep() || builder.finish().is_err());
    }
}
