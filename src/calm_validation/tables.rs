//! The tables of the page.

use super::detection::Detection;
use super::labelled::LabelledSet;
use super::set_names::of_set;
use super::{DetectionRule, Validation, labelled};
use crate::page::{PageTable, TableCell, count, percent, real, text};

/// All tables with rows, in the order of the page.
pub fn all(validation: &Validation) -> Vec<PageTable> {
    let mut tables = vec![
        detection(validation),
        bond_scans(validation),
        defects(validation),
        solutions(validation),
        training(validation),
        feature_space(validation),
        collisions(validation),
        matched_pairs(validation),
        feature_ranks(validation),
    ];
    tables.push(labelled::sets_table(&validation.labelled));
    for (number, LabelledSet { report, mixtures, .. }) in validation.labelled.iter().enumerate() {
        let mut tables_of_set = labelled::tables(report);
        tables_of_set.push(labelled::mixtures_table(mixtures, report));
        tables_of_set.iter_mut().for_each(|table| table.name = of_set(&table.name, number).into());
        tables.extend(tables_of_set);
    }
    tables.retain(|table| !table.rows.is_empty());
    tables
}

/// Yes, no, or a dash.
pub fn verdict(found: Option<bool>) -> &'static str {
    match found {
        Some(true) => "yes",
        Some(false) => "no",
        None => "–",
    }
}

/// Compression and stretching, as in the paper's Table 1.
pub fn both(detection: &Detection) -> String {
    format!("{}/{}", verdict(detection.compression), verdict(detection.stretching))
}

fn detection(validation: &Validation) -> PageTable {
    let caption = "Whether each score detects compression and stretching in the bond scans of all elements, but not \
                   the crystals at equilibrium. The largest value of each regime is that of the element where it is smallest.";
    let titles = [
        "score",
        "detected when",
        "compression/stretching",
        "equilibrium inside",
        "largest, compressed",
        "largest, stretched",
        "largest at equilibrium",
    ];
    let mut table = PageTable::new("detection", caption, &titles).whole();
    for score in &validation.scores {
        let found = &score.detection;
        table.rows.push(vec![
            text(&*score.name),
            text(match score.rule {
                Some(DetectionRule::Threshold(limit)) => format!("above {limit}"),
                Some(DetectionRule::TimesMedian(factor)) => format!("above {factor} × median at equilibrium"),
                None => "no rule".into(),
            }),
            text(both(found)),
            text(verdict(found.interpolation)),
            significant(found.largest_in_compression),
            significant(found.largest_in_stretching),
            significant(found.at_equilibrium),
        ]);
    }
    table
}

/// A number with three significant digits on the page.
fn significant(x: Option<f64>) -> TableCell {
    let exact = real(x, 0);
    let shown = x.map_or("–".to_owned(), |x| match x.abs() {
        size if !x.is_finite() || (size > 0.0 && !(1e-2..1e4).contains(&size)) => format!("{x:.1e}"),
        size if size >= 100.0 => format!("{x:.0}"),
        size if size >= 10.0 => format!("{x:.1}"),
        _ => format!("{x:.2}"),
    });
    TableCell { shown, ..exact }
}

fn bond_scans(validation: &Validation) -> PageTable {
    let caption = "Bond scans. The equilibrium distance is that of the model’s lowest energy near the published one, unless it has none \
                   there. Only ground states count for detection, and no crystals that stand in.";
    let titles = [
        "element",
        "crystal",
        "ground state",
        "d_{eq} (Å)",
        "of the model",
        "score",
        "compression/stretching",
        "largest, compressed",
        "at d_{eq}",
        "largest, stretched",
    ];
    let mut table = PageTable::new("bond-scans", caption, &titles);
    for scan in &validation.bond_scans {
        for (score, found) in validation.scores.iter().zip(&scan.detection) {
            let state = match (scan.is_ground_state, scan.is_own) {
                (true, true) => "yes",
                (true, false) => "stands in",
                _ => "no",
            };
            table.rows.push(vec![
                text(&*scan.element),
                text(&*scan.prototype),
                text(state),
                real(scan.equilibrium, 3),
                text(verdict(Some(scan.is_relaxed))),
                text(&*score.name),
                text(both(found)),
                significant(found.largest_in_compression),
                significant(found.at_equilibrium),
                significant(found.largest_in_stretching),
            ]);
        }
    }
    table
}

fn defects(validation: &Validation) -> PageTable {
    let caption = "Grades at defects: of the perfect crystal, next to the defect and farthest from it. The longest displacement is that of the \
                   relaxation; crystals that the element does not form keep ideal positions.";
    let titles = [
        "element",
        "crystal",
        "defect",
        "atoms",
        "relaxed",
        "displacement (Å)",
        "γ of the crystal",
        "γ next to it",
        "γ far away",
        "γ_{nbr} next to it",
        "atoms γ > 1 (%)",
    ];
    let mut table = PageTable::new("defects", caption, &titles).whole();
    for defect in &validation.defects {
        let (near, far) = (defect.shells.first(), defect.shells.last());
        let atoms: usize = defect.shells.iter().map(|shell| shell.atoms).sum();
        let above = defect.graded.as_ref().map(|(_, gamma, _)| {
            gamma.iter().filter(|gamma| **gamma > 1.0).count() as f64 / gamma.len() as f64
        });
        let relaxed = match (&defect.relaxation, &defect.error) {
            (_, Some(_)) => "not graded",
            (Some(relaxation), _) if relaxation.is_converged => "yes",
            (Some(_), _) => "not converged",
            (None, _) => "no",
        };
        table.rows.push(vec![
            text(&*defect.element),
            text(&*defect.prototype),
            text(defect.name),
            count(atoms as u64),
            text(relaxed),
            real(defect.relaxation.as_ref().map(|of| of.largest_displacement), 2),
            significant(defect.crystal.first().copied()),
            significant(near.map(|shell| shell.scores[0])),
            significant(far.map(|shell| shell.scores[0])),
            significant(near.map(|shell| shell.averages[0])),
            percent(above),
        ]);
    }
    table
}

fn solutions(validation: &Validation) -> PageTable {
    let caption = "Random solid solutions by composition.";
    let titles = [
        "elements",
        "lattice",
        "second element (%)",
        "distance (Å)",
        "structures",
        "mean γ",
        "mean γ_{nbr}",
        "atoms γ > 1 (%)",
        "atoms γ_{nbr} > 1 (%)",
    ];
    let mut table = PageTable::new("solutions", caption, &titles);
    for solution in &validation.solutions {
        for of in &solution.compositions {
            table.rows.push(vec![
                text(solution.elements.join("–")),
                text(&*solution.prototype),
                real(100.0 * of.fraction, 0),
                real(of.distance, 3),
                count(of.structures as u64),
                significant(of.scores.first().copied()),
                significant(of.averages.first().copied()),
                percent(Some(of.above_1)),
                percent(Some(of.averages_above_1)),
            ]);
        }
    }
    table
}

fn training(validation: &Validation) -> PageTable {
    let caption = "Training structures of two elements alone, and the shares of the second element in them; mean absolute errors of the model on all \
                   training structures with labels, of energies without the offsets of the elements and of forces as vectors.";
    let titles = [
        "elements",
        "structures",
        "smallest share (%)",
        "largest share (%)",
        "energy MAE (meV/atom)",
        "force MAE (eV/Å)",
    ];
    let mut table = PageTable::new("training-data", caption, &titles);
    let Some(training) = &validation.training else { return table };
    let errors = training.errors;
    for pair in &training.pairs {
        table.rows.push(vec![
            text(pair.elements.join("–")),
            count(pair.structures),
            percent(pair.range.map(|[low, _]| low)),
            percent(pair.range.map(|[_, high]| high)),
            real(errors.and_then(|errors| errors.energy).map(|error| 1000.0 * error), 2),
            real(errors.and_then(|errors| errors.force), 3),
        ]);
    }
    table
}

fn feature_space(validation: &Validation) -> PageTable {
    let caption = "Components of the mixture by element: their number, the share of the variance of all their data along the first two principal \
                   components, the largest condition number of a covariance; labelled atoms and the share of them with γ above 1.";
    let titles = [
        "element",
        "components",
        "PC 1 (%)",
        "PC 2 (%)",
        "largest condition number",
        "labelled atoms",
        "γ > 1 (%)",
    ];
    let mut table = PageTable::new("feature-space", caption, &titles);
    for plane in &validation.feature_planes {
        let [within, beyond] = plane.atoms;
        let atoms = within + beyond;
        table.rows.push(vec![
            text(&*plane.element),
            count(plane.components.len() as u64),
            percent(Some(plane.shares[0])),
            percent(Some(plane.shares[1])),
            significant(plane.condition_number),
            count(atoms),
            percent((atoms > 0).then(|| beyond as f64 / atoms as f64)),
        ]);
    }
    table
}

fn collisions(validation: &Validation) -> PageTable {
    let caption = "Colliding environments: an atom in the middle of an octagon, with neighbours at the places 0, 1, 3, 4 (A) or 0, 1, 2, 5 (B). \
                   Distances and angles are the same, so features of pairs and triples of atoms would have no distance. Rounding is the \
                   relative distance between A and its mirror image.";
    let titles = [
        "element",
        "features",
        "|z_{A} − z_{B}| / |z_{A}|",
        "rounding",
        "E_{A} − E_{B} (eV)",
        "γ_{A}",
        "γ_{B}",
    ];
    let mut table = PageTable::new("collisions", caption, &titles);
    for collision in &validation.collisions {
        for features in &collision.features {
            let [a, b] =
                [&collision.scores[0], &collision.scores[1]].map(|of| significant(of.first().copied()));
            table.rows.push(vec![
                text(&*collision.element),
                text(features.variant),
                significant(Some(features.distance)),
                significant(Some(features.rounding)),
                significant(Some(collision.energies[0] - collision.energies[1])),
                a,
                b,
            ]);
        }
    }
    table
}

fn matched_pairs(validation: &Validation) -> PageTable {
    let caption = "Environments A and B of an atom with M neighbours, after the features of B were brought as close to those of A as a minimisation \
                   over its positions could. They are other environments if no rotation, reflection and order of the atoms makes them equal: \
                   the sorted distances between all atoms, or the mean ones of each atom, differ. The readout’s densities can tell apart \
                   environments of the smallest M. Energies and forces are those of the atom.";
    let titles = [
        "element",
        "features",
        "start of B",
        "M",
        "|z_{A} − z_{B}| / |z_{A}| at the start",
        "found",
        "other environment",
        "distances differ by (Å)",
        "superposed (Å)",
        "E_{A} − E_{B} (eV)",
        "|F_{A}| (eV/Å)",
        "|F_{B}| (eV/Å)",
        "γ_{A}",
        "γ_{B}",
        "evaluations",
    ];
    let mut table = PageTable::new("collision-search", caption, &titles);
    for pair in &validation.matched_pairs {
        let [a, b] = [&pair.scores[0], &pair.scores[1]].map(|of| significant(of.first().copied()));
        table.rows.push(vec![
            text(&*pair.element),
            text(pair.features.name()),
            text(pair.start.name()),
            count(pair.neighbours as u64),
            significant(Some(pair.start_distance)),
            significant(Some(pair.distance)),
            text(verdict(Some(pair.is_different))),
            significant(Some(pair.distances.max(pair.spreads))),
            significant(Some(pair.superposed)),
            significant(Some(pair.energies[0] - pair.energies[1])),
            significant(Some(pair.forces[0])),
            significant(Some(pair.forces[1])),
            a,
            b,
            count(pair.evaluations as u64),
        ]);
    }
    table
}

fn feature_ranks(validation: &Validation) -> PageTable {
    let caption = "Rank of the Jacobian of features by the positions of the N atoms of environment A, of the atom in the middle or of all atoms. Of \
                   the 3N − 6 directions without translations and rotations, those of the null space change no feature. Singular values \
                   count above 10^{−10} of the largest.";
    let titles = [
        "element",
        "features",
        "of atoms",
        "number of features",
        "3N − 6",
        "rank",
        "null space",
        "smallest that counts",
        "largest that does not",
    ];
    let mut table = PageTable::new("feature-ranks", caption, &titles);
    for rank in &validation.feature_ranks {
        table.rows.push(vec![
            text(&*rank.element),
            text(rank.features.name()),
            count(rank.atoms as u64),
            count(rank.dimension as u64),
            count(rank.directions as u64),
            count(rank.rank as u64),
            count(rank.free() as u64),
            significant(Some(rank.smallest)),
            significant(rank.next),
        ]);
    }
    table
}
