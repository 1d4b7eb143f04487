//! The report against statistics of the same numbers.

use ::figures::{to_png, to_svg};
use analysis::{Bootstrap, quantile, roc_auc, spearman};
use atoms::Species;
use atoms::cell::{norm, sub};
use atoms::extxyz::FrameLabels;

use super::report::IntervalEstimate;
use super::*;

const BOOTSTRAP: Bootstrap = Bootstrap { draws: 60, level: 0.9, seed: 3 };
const ATOMS: usize = 8;

/// A deterministic number between 0 and 1.
fn uniform(place: usize) -> f64 {
    let mut x = (place as u64 + 1).wrapping_mul(0x9e37_79b9_7f4a_7c15);
    x = (x ^ (x >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    ((x ^ (x >> 27)) >> 11) as f64 / (1_u64 << 53) as f64
}

/// A structure of aluminium and nickel with errors that grow with the first score; the second is the first, smoothed.
struct Sample {
    species: Vec<Species>,
    scores: [Vec<f64>; 2],
    predicted: FrameLabels,
    labels: FrameLabels,
}

/// Energies of the labels are those of the model plus 1 eV for each aluminium and −2 eV for each nickel atom, to ± 8 meV.
fn sample(number: usize) -> Sample {
    let nickel = number % (ATOMS + 1);
    let element = |atom: usize| Species::from_atomic_number(if atom < nickel { 28 } else { 13 }).unwrap();
    let place = |atom: usize, k: usize| 1000 * number + 10 * atom + k;
    let scores: Vec<_> = (0..ATOMS).map(|atom| 3.0 * uniform(place(atom, 0)).powi(2)).collect();
    let mean = scores.iter().sum::<f64>() / ATOMS as f64;
    let smooth = scores.iter().map(|score| 0.5 * (score + mean)).collect();
    let error = |atom: usize| [1, 2, 3].map(|k| scores[atom] * (uniform(place(atom, k)) - 0.5));
    let offset = (ATOMS - nickel) as f64 - 2.0 * nickel as f64 + 0.016 * (uniform(place(0, 9)) - 0.5);
    Sample {
        species: (0..ATOMS).map(element).collect(),
        predicted: FrameLabels {
            energy: Some(-3.5),
            forces: Some(vec![[0.1, 0.2, -0.3]; ATOMS]),
            stress: Some([[0.01; 3]; 3]),
        },
        labels: FrameLabels {
            energy: Some(-3.5 + offset),
            forces: Some((0..ATOMS).map(|atom| sub([0.1, 0.2, -0.3], error(atom))).collect()),
            stress: number.is_multiple_of(2).then_some([[0.013; 3]; 3]),
        },
        scores: [scores, smooth],
    }
}

fn columns() -> Vec<ScoreColumn> {
    vec![ScoreColumn::grade("γ"), ScoreColumn { name: "d_{nn}".into(), limit: None }]
}

fn collected(mut errors: LabelledErrors, samples: &[Sample]) -> LabelledErrors {
    for Sample { species, scores: [a, b], predicted, labels } in samples {
        errors.add(&LabelledStructure { species, scores: &[a, b], predicted, labels });
    }
    errors
}

/// Force errors and scores of all atoms.
fn atoms(samples: &[Sample]) -> (Vec<f64>, [Vec<f64>; 2]) {
    let forces = |sample: &Sample| {
        let (a, b) = (sample.predicted.forces.clone().unwrap(), sample.labels.forces.clone().unwrap());
        a.into_iter().zip(b).map(|(a, b)| norm(sub(a, b))).collect::<Vec<_>>()
    };
    let column = |k: usize| samples.iter().flat_map(|sample| sample.scores[k].clone()).collect();
    (samples.iter().flat_map(forces).collect(), [column(0), column(1)])
}

fn assert_near(found: Option<f64>, expected: Option<f64>) {
    let (found, expected) = (found.unwrap(), expected.unwrap());
    assert!((found - expected).abs() < 1e-12, "{found} {expected}");
}

#[test]
fn a_report_has_the_statistics_of_its_atoms() {
    let samples: Vec<_> = (0..45).map(sample).collect();
    let report = collected(LabelledErrors::new(columns()), &samples).report(BOOTSTRAP);
    let (errors, scores) = atoms(&samples);
    assert_eq!((report.structures, report.atoms, report.left_out), (45, 360, 0));
    assert_eq!((report.sampled_atoms, report.sampled_structures), (360, 45));
    for (of, scores) in report.scores.iter().zip(&scores) {
        assert_near(of.spearman.value, spearman(scores, &errors));
        for (k, threshold) in report.thresholds.iter().enumerate() {
            assert_eq!(of.auc[k].value.is_some(), roc_auc(scores, &errors, *threshold).is_some());
            if let Some(expected) = roc_auc(scores, &errors, *threshold) {
                assert_near(of.auc[k].value, Some(expected));
            }
        }
        let (low, high) = of.spearman.interval.unwrap();
        assert!(low < of.spearman.value.unwrap() && of.spearman.value.unwrap() < high);
    }
    let share = |test: &dyn Fn(f64) -> bool, of: &[f64]| {
        Some(of.iter().filter(|x| test(**x)).count() as f64 / of.len() as f64)
    };
    let kept: Vec<_> =
        errors.iter().zip(&scores[0]).filter(|(_, score)| **score <= 1.0).map(|(x, _)| *x).collect();
    let histograms = report.scores[0].error_histograms.as_ref().unwrap();
    let [within, beyond] = &histograms.populations;
    assert_near(within.mean, Some(kept.iter().sum::<f64>() / kept.len() as f64));
    assert!(beyond.mean > within.mean && beyond.median > within.median, "{histograms:?}");
    assert_eq!(beyond.counts.iter().sum::<u64>(), 360 - kept.len() as u64);
    let components = report.scores[0].component_histograms.as_ref().unwrap();
    let of_sample = |sample: &Sample| {
        let (a, b) = (sample.predicted.forces.clone().unwrap(), sample.labels.forces.clone().unwrap());
        let atoms = a.into_iter().zip(b).zip(sample.scores[0].clone());
        atoms.flat_map(|((a, b), score)| sub(a, b).map(|x| (score, x.abs()))).collect::<Vec<_>>()
    };
    let of_beyond: Vec<_> = samples.iter().flat_map(of_sample).filter(|(score, _)| *score > 1.0).collect();
    let number = of_beyond.len() as f64;
    assert_near(
        components.populations[1].mean,
        Some(of_beyond.iter().map(|(_, error)| error).sum::<f64>() / number),
    );
    assert_eq!(number, 3.0 * (360 - kept.len()) as f64);
    let confident = report.scores[0].confident.as_ref().unwrap();
    assert_near(confident.retention.value, share(&|score| score <= 1.0, &scores[0]));
    for (k, threshold) in report.thresholds.iter().enumerate() {
        assert_near(confident.contamination[k].value, share(&|error| error > *threshold, &kept));
        assert_near(report.unfiltered[k], share(&|error| error > *threshold, &errors));
    }
    assert!(report.scores[1].confident.is_none() && report.scores[1].bins.is_empty());
    assert_eq!(report.scores[0].bins.iter().map(|bin| bin.atoms).sum::<u64>(), 360);
}

#[test]
fn the_worst_decile_is_that_of_each_element() {
    let samples: Vec<_> = (0..45).map(sample).collect();
    let report = collected(LabelledErrors::new(columns()), &samples).report(BOOTSTRAP);
    let (errors, scores) = atoms(&samples);
    let species: Vec<_> = samples.iter().flat_map(|sample| sample.species.clone()).collect();
    let mut areas = Vec::new();
    for of in &report.scores[0].worst_decile_by_element {
        let select = |values: &[f64]| -> Vec<f64> {
            values.iter().zip(&species).filter(|(_, s)| s.symbol() == of.element).map(|(x, _)| *x).collect()
        };
        let (errors, scores) = (select(&errors), select(&scores[0]));
        let mut ascending = errors.clone();
        ascending.sort_by(f64::total_cmp);
        let threshold = quantile(&ascending, 0.9).unwrap();
        assert_eq!((of.atoms, of.threshold), (errors.len(), threshold));
        assert_near(of.auc.value, roc_auc(&scores, &errors, threshold));
        areas.push(of.auc.value.unwrap());
    }
    assert_eq!(areas.len(), 2);
    assert_near(report.scores[0].worst_decile.value, Some(0.5 * (areas[0] + areas[1])));
}

#[test]
fn bins_have_intervals() {
    let samples: Vec<_> = (0..45).map(sample).collect();
    let report = collected(LabelledErrors::new(columns()), &samples).report(BOOTSTRAP);
    let (errors, scores) = atoms(&samples);
    let bins = &report.scores[0].bins;
    let in_first = errors.iter().zip(&scores[0]).filter(|(_, score)| **score <= 0.5);
    let mut ascending: Vec<_> = in_first.map(|(error, _)| *error).collect();
    ascending.sort_by(f64::total_cmp);
    assert_eq!((bins[0].atoms, bins[0].up_to), (ascending.len() as u64, Some(0.5)));
    assert_near(bins[0].median.value, quantile(&ascending, 0.5));
    assert_near(bins[0].p90.value, quantile(&ascending, 0.9));
    // Errors are at most √3 / 2 times the score, so none of this bin is large, and in no draw.
    assert_eq!((bins[0].large.value, bins[0].large.interval), (Some(0.0), Some((0.0, 0.0))));
    for estimate in [bins[0].median, bins[0].p90, bins[5].large] {
        let (low, high) = estimate.interval.unwrap();
        assert!(low < high && (low..=high).contains(&estimate.value.unwrap()), "{estimate:?}");
    }
    // No score is above 5.
    let IntervalEstimate { value, interval } = bins[6].median;
    assert_eq!((bins[6].atoms, value, interval), (0, None, None));
    let quantiles = tables(&report).into_iter().find(|table| table.name == "quantiles").unwrap();
    let (low, high) = bins[0].median.interval.unwrap();
    assert_eq!(quantiles.rows[0][5].exact, format!("{low} to {high}"));
}

#[test]
fn a_heavy_tail_leaves_the_atoms_within_the_limit_in_their_bins() {
    let mut samples: Vec<_> = (0..45).map(sample).collect();
    for score in samples.iter_mut().flat_map(|sample| &mut sample.scores[0]).filter(|score| **score > 1.0) {
        *score *= 1e9;
    }
    let report = collected(LabelledErrors::new(columns()), &samples).report(BOOTSTRAP);
    let (_, scores) = atoms(&samples);
    let bands = &report.scores[0].bands;
    let low = bands[0].low;
    assert!(low < 0.1, "{low}");
    let expected = scores[0].iter().filter(|score| (low..=1.0).contains(*score)).count();
    let within = bands.iter().filter(|band| band.high < 1.01).map(|band| band.atoms).sum::<u64>();
    assert_eq!(within, expected as u64);
}

#[test]
fn areas_are_shown_by_element_and_by_threshold() {
    let samples: Vec<_> = (0..45).map(sample).collect();
    let report = collected(LabelledErrors::new(columns()), &samples).report(BOOTSTRAP);
    let rows = |name: &str| {
        let tables = tables(&report);
        let table = tables.iter().find(|table| table.name == name).unwrap();
        let csv = String::from_utf8(table.csv().into_bytes()).unwrap();
        csv.lines().skip(1).map(|line| line.split(',').map(str::to_owned).collect()).collect::<Vec<Vec<_>>>()
    };
    let number = |cell: &str| cell.parse::<f64>().ok();
    for (row, score) in rows("auc-thresholds").iter().zip(&report.scores) {
        for (k, threshold) in [0.1, 0.3, 1.0, 3.0].into_iter().enumerate() {
            let place = report.threshold(threshold).unwrap();
            assert_eq!(number(&row[1 + 2 * k]), score.auc[place].value, "{threshold}");
        }
    }
    let deciles = rows("worst-deciles");
    let places = [("Al", 0), ("Ni", 1)].into_iter().flat_map(|element| [(element, 0), (element, 1)]);
    for (row, ((symbol, element), score)) in deciles.iter().zip(places) {
        let of = &report.scores[score].worst_decile_by_element[element];
        assert_eq!((row[0].as_str(), row[1].as_str()), (symbol, of.atoms.to_string().as_str()));
        assert_eq!((number(&row[2]), number(&row[4])), (Some(of.threshold), of.auc.value));
        let (low, high) = of.auc.interval.unwrap();
        assert_eq!(row[5], format!("{low} to {high}"));
    }
}

#[test]
fn errors_and_scores_are_divided_by_element_and_by_composition() {
    let samples: Vec<_> = (0..45).map(sample).collect();
    let report = collected(LabelledErrors::new(columns()), &samples).report(BOOTSTRAP);
    // Of two elements, the heavier one is scanned. 5 of 45 structures have 2 of 8 nickel atoms, which is nearest to 30 %.
    let [scan] = &report.compositions[..] else { panic!("{:?}", report.compositions) };
    let shares: Vec<_> = scan.groups.iter().map(|group| (10.0 * group.share).round()).collect();
    assert_eq!((scan.element, &shares[..]), ("Ni", &[0.0, 1.0, 3.0, 4.0, 5.0, 6.0, 8.0, 9.0, 10.0][..]));
    let members: Vec<_> = (0..45).filter(|number| number % 9 == 2).map(sample).collect();
    let (errors, scores) = atoms(&members);
    let mean = |values: &[f64]| values.iter().sum::<f64>() / values.len() as f64;
    let group = &scan.groups[2];
    assert_eq!((group.structures, group.atoms), (5, 40));
    assert_near(group.forces.map(|of| of.mean), Some(mean(&errors)));
    let mut ascending = errors.clone();
    ascending.sort_by(f64::total_cmp);
    assert_near(group.forces.map(|of| of.quantiles[3]), quantile(&ascending, 0.75));
    assert_near(group.scores.first().map(|of| of.mean), Some(mean(&scores[0])));
    let beyond = scores[0].iter().filter(|score| **score > 1.0).count() as f64 / 40.0;
    assert_eq!((group.scores[0].beyond, group.scores[1].beyond), (Some(beyond), None));
    let offset = |species: &Species| {
        report.offsets.iter().find(|of| of.element == species.symbol()).map(|of| of.offset).unwrap()
    };
    let difference = |of: &Sample| {
        let offsets: f64 = of.species.iter().map(offset).sum();
        ((of.predicted.energy.unwrap() - of.labels.energy.unwrap() + offsets) / 8.0).abs()
    };
    let energies: Vec<_> = members.iter().map(difference).collect();
    assert_near(group.energy.map(|of| of.mean), Some(mean(&energies)));
    // Labels differ by 8 meV at most once the offsets of 1 and −2 eV are removed.
    assert!(mean(&energies) < 0.002, "{energies:?}");
    let structure = |of: &Sample| (mean(&of.scores[1]), difference(of));
    let (means, differences): (Vec<_>, Vec<_>) = samples.iter().map(structure).unzip();
    assert_near(report.scores[1].energy_spearman, spearman(&means, &differences));

    let elements: Vec<_> = report.elements.iter().map(|of| (of.element, of.atoms)).collect();
    assert_eq!(elements, [("Al", 180), ("Ni", 180)]);
    let (errors, scores) = atoms(&samples);
    let species: Vec<_> = samples.iter().flat_map(|sample| sample.species.clone()).collect();
    let of_nickel = |values: &[f64]| -> Vec<f64> {
        values.iter().zip(&species).filter(|(_, s)| s.symbol() == "Ni").map(|(x, _)| *x).collect()
    };
    let nickel = &report.elements[1];
    assert_near(Some(nickel.forces.mean), Some(mean(&of_nickel(&errors))));
    assert_near(nickel.spearman[1], spearman(&of_nickel(&scores[1]), &of_nickel(&errors)));
}

#[test]
fn energies_are_compared_with_and_without_offsets() {
    let samples: Vec<_> = (0..45).map(sample).collect();
    let report = collected(LabelledErrors::new(columns()), &samples).report(BOOTSTRAP);
    assert!(report.energy.mean_absolute.value.unwrap() > 0.5, "{:?}", report.energy);
    assert!(report.energy_without_offsets.root_mean_square.value.unwrap() < 0.001);
    for (found, (element, offset)) in report.offsets.iter().zip([("Al", 1.0), ("Ni", -2.0)]) {
        assert_eq!((found.element, found.is_separate), (element, true));
        assert!((found.offset - offset).abs() < 1e-3, "{found:?}");
    }
    // Every other structure has a stress, six components with an error of 3 meV/Å³ each.
    assert_eq!(report.stress.number, 23.0 * 6.0);
    assert_near(report.stress.mean_absolute.value, Some(0.003));
    let (low, high) = report.stress.root_mean_square.interval.unwrap();
    assert!((low - 0.003).abs() < 1e-12 && (high - 0.003).abs() < 1e-12);
    assert_eq!(report.forces.number, 360.0 * 3.0);
}

#[test]
fn a_bounded_sample_leaves_counts_exact() {
    let samples: Vec<_> = (0..200).map(sample).collect();
    let whole = collected(LabelledErrors::new(columns()), &samples).report(BOOTSTRAP);
    let part = collected(LabelledErrors::with_room(columns(), 600, 90), &samples).report(BOOTSTRAP);
    assert!(part.sampled_atoms <= 600 && part.sampled_structures <= 200 && part.atoms == 1600);
    assert_eq!(part.unfiltered, whole.unfiltered);
    assert_eq!(part.forces.mean_absolute.value, whole.forces.mean_absolute.value);
    let confident = |report: &LabelledReport| {
        let found = report.scores[0].confident.as_ref().unwrap();
        (found.retention.value, found.contamination.iter().map(|of| of.value).collect::<Vec<_>>())
    };
    assert_eq!(confident(&part), confident(&whole));
    // Five standard deviations of the correlation of n pairs, 1 / √n, for at least a quarter of the room.
    let rho = |report: &LabelledReport| report.scores[0].spearman.value.unwrap();
    assert!((rho(&part) - rho(&whole)).abs() < 5.0 / 150_f64.sqrt());
}

#[test]
fn atoms_without_a_finite_score_are_only_counted() {
    let mut samples: Vec<_> = (0..9).map(sample).collect();
    samples[3].scores[1][2] = f64::NAN;
    let report = collected(LabelledErrors::new(columns()), &samples).report(BOOTSTRAP);
    assert_eq!((report.atoms, report.left_out), (71, 1));
}

#[test]
fn what_has_no_labels_says_nothing() {
    let mut samples: Vec<_> = (0..3).map(sample).collect();
    samples.iter_mut().for_each(|sample| sample.labels = FrameLabels::default());
    let report = collected(LabelledErrors::new(columns()), &samples).report(BOOTSTRAP);
    assert_eq!((report.structures, report.atoms), (0, 0));
    assert!(tables(&report).is_empty() && figures(&report, None).is_empty());
    assert_eq!(report.scores[0].spearman.value, None);
    assert!(serde_json::to_string(&report).unwrap().contains("\"structures\":0"));
}

#[test]
fn figures_and_tables_show_every_score() {
    // One structure, for which no band has enough atoms, and enough of them.
    for number in [1, 60] {
        let samples: Vec<_> = (0..number).map(sample).collect();
        let report = collected(LabelledErrors::new(columns()), &samples).report(BOOTSTRAP);
        let figures = figures(&report, None);
        let names: Vec<_> = figures.iter().map(|figure| figure.name.clone()).collect();
        let all = [
            "reliability",
            "error-histograms",
            "score-distributions",
            "contamination",
            "auc-sweep",
            "composition-errors",
        ];
        // A single structure has one composition.
        assert_eq!(names, all[..if number == 1 { 5 } else { 6 }]);
        for figure in figures {
            let drawn = figure.drawn.unwrap();
            let svg = to_svg(&drawn.figure);
            assert!(!svg.contains("NaN"), "{}", figure.name);
            // An inset has the rank of the only score with a limit, and needs a bin with enough atoms.
            if figure.name == "error-histograms" {
                assert_eq!(svg.matches(">ρ = ").count(), usize::from(number > 1), "{svg}");
            }
            assert!(to_png(&drawn.figure, 40.0).is_ok());
            let rows = String::from_utf8(drawn.numbers.into_bytes()).unwrap();
            assert!(rows.lines().count() > 5 && rows.contains('γ'), "{rows}");
        }
        let mut text = Vec::new();
        write(&report, &mut text).unwrap();
        let text = String::from_utf8(text).unwrap();
        for words in ["labelled structure", "d_nn", "γ ≤ 1", "> 5", "stress components"] {
            assert!(text.contains(words), "{text}");
        }
        let tables = tables(&report);
        let rows: Vec<_> = tables.iter().map(|table| (&*table.name, table.rows.len())).collect();
        // A single structure has no energy offsets, and this one has one element.
        let expected: &[_] = match number {
            1 => &[
                ("label-errors", 3),
                ("ranks", 2),
                ("confident", 2),
                ("auc-thresholds", 2),
                ("quantiles", 7),
            ],
            _ => &[
                ("label-errors", 4),
                ("ranks", 2),
                ("confident", 2),
                ("auc-thresholds", 2),
                ("worst-deciles", 4),
                ("quantiles", 7),
                ("element-errors", 4),
                // 0, 1, … 8 nickel atoms of eight.
                ("composition-errors", 9),
            ],
        };
        assert_eq!(rows, expected);
    }
}

#[test]
fn contamination_has_a_row_for_each_grade_and_a_panel_for_each_dimension() {
    let samples: Vec<_> = (0..45).map(sample).collect();
    let grades = ["γ", "γ_{nbr}"].map(ScoreColumn::grade).to_vec();
    let report = collected(LabelledErrors::new(grades), &samples).report(BOOTSTRAP);
    let mixture = |dimension, components: usize| ComparedMixture {
        artifact: format!("{dimension}-{components}.npz"),
        dimension,
        components: vec![components; 2],
        scores: report.scores.clone(),
    };
    let mixtures = [mixture(128, 8), mixture(64, 4), mixture(128, 4)];
    let drawn = mixtures_figure(&mixtures, &report).unwrap().drawn.unwrap();
    let svg = to_svg(&drawn.figure);
    assert!(!svg.contains("NaN"));
    assert_eq!(svg.matches("<clipPath").count(), 4, "{svg}");
    for dimension in [64, 128] {
        assert_eq!(svg.matches(&format!(" ≤ 1, D = {dimension}<")).count(), 2, "{svg}");
    }
    // Each panel has the mixtures of its dimension.
    let entries = |number| svg.matches(&format!(">{number}: K = ")).count();
    assert_eq!([1, 2, 3].map(entries), [2; 3]);
    let rows = String::from_utf8(drawn.numbers.into_bytes()).unwrap();
    // The curve of all atoms, and two for each mixture.
    assert_eq!(rows.lines().count(), 1 + report.thresholds.len() * (1 + 2 * 3));
    for (name, score) in ["γ", "γ_nbr"].iter().zip(&report.scores) {
        let first = score.confident.as_ref().unwrap().contamination[0].value.unwrap();
        assert!(rows.contains(&format!("\n{name},2,64,4,0.01,{first},")), "{rows}");
    }
    assert!(mixtures_figure(&[], &report).is_none());
}

#[test]
fn mixtures_are_mapped_by_dimension_and_components() {
    let samples: Vec<_> = (0..45).map(sample).collect();
    let report = collected(LabelledErrors::new(columns()), &samples).report(BOOTSTRAP);
    let mixture = |dimension, components| ComparedMixture {
        artifact: "a.npz".into(),
        dimension,
        components,
        scores: report.scores.clone(),
    };
    let mixtures = [mixture(64, vec![4, 4]), mixture(128, vec![4, 4]), mixture(128, vec![1, 8])];
    let drawn = mixture_map(&mixtures, &report).unwrap().drawn.unwrap();
    assert!(!to_svg(&drawn.figure).contains("NaN"));
    let rows = String::from_utf8(drawn.numbers.into_bytes()).unwrap();
    let confident = report.scores[0].confident.as_ref().unwrap();
    let [kept, above] = [confident.retention, confident.contamination[report.threshold(0.5).unwrap()]]
        .map(|of| of.value.unwrap());
    // The other score has no limit.
    let expected =
        [("64", "4"), ("128", "4"), ("128", "1–8")].map(|(d, k)| format!("γ,{d},{k},{above},{kept}"));
    assert_eq!(rows.lines().skip(1).collect::<Vec<_>>(), expected);
    // One mixture is no map, and two in one place cannot be drawn.
    assert!(mixture_map(&mixtures[..1], &report).is_none());
    let twice = [mixture(64, vec![4, 4]), mixture(64, vec![4, 4])];
    assert!(mixture_map(&twice, &report).unwrap().drawn.is_err());
}
