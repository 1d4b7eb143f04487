//! Whether a model's derivatives are those of its energies and features, before a campaign relies on them.

use atoms::{Cell, NeighbourList, Species, Structure, StructureError};

use crate::call::{BondGeometry, Topology};

/// Distance of the atoms of the test in sums of covalent radii.
const SPACING: f64 = 1.1;
/// Largest displacement from the lattice, in distances.
const JITTER: f64 = 0.12;
/// Skin of the neighbour list, Å.
const SKIN: f64 = 0.3;
/// Step of the differences, Å, or strain.
const STEP: f64 = 4e-3;
/// Largest error of a derivative, of its scale.
const TOLERANCE: f64 = 2e-5;
/// Largest error of a sum, in rounding errors.
const ROUNDING: f64 = 30.0;

/// What is asked of a model.
#[derive(Clone, Copy, Debug)]
pub(crate) enum Asked<'a> {
    /// Energies, forces, virial and features.
    Forces,
    /// Energies and features.
    NoForces,
    /// Gradients and virials of the pull-back of cotangents of the features, and of the energy if wanted.
    Gradients {
        /// For each structure.
        cotangents: &'a [&'a [f64]],
        /// Whether the energy is added.
        with_energy: bool,
        /// Whether the model pulls back from what its evaluation of the same structures, asked for just before, has kept.
        kept: bool,
    },
}

/// What a model evaluates at once, for the test.
pub(crate) trait Evaluate {
    /// The results for each structure, or what went wrong.
    fn ask(&mut self, structures: &[&BondGeometry], asked: Asked<'_>) -> Result<Vec<TestResult>, String>;
}

/// The numbers of one structure.
#[derive(Clone, Debug, Default, PartialEq)]
pub(crate) struct TestResult {
    pub energies: Vec<f64>,
    pub vectors: Vec<f64>,
    pub virial: Vec<f64>,
    pub features: Vec<f64>,
}

/// What the test has found.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct SelfTestReport {
    /// Each comparison: what, its error, its tolerance.
    pub figures: Vec<(String, f64, f64)>,
    /// Whether a repeated call gives the same bits, and a pull-back those of one that evaluates anew.
    pub is_deterministic: bool,
    /// Whether a structure has the same bits alone and beside others.
    pub is_batch_independent: bool,
}

/// Why a model is refused.
#[derive(Debug, thiserror::Error)]
pub enum SelfTestError {
    /// A derivative is wrong.
    #[error(
        "the self-test of the model failed: {what} differs by {error:.2e}, tolerance {tolerance:.2e}\n{figures}"
    )]
    Wrong {
        /// What was compared.
        what: String,
        /// Its error.
        error: f64,
        /// Its tolerance.
        tolerance: f64,
        /// All figures, a line each.
        figures: String,
    },
    /// A call failed.
    #[error("the self-test of the model failed: {0}")]
    Call(String),
    /// No structure could be made.
    #[error("the self-test of the model failed: {0}")]
    Structure(#[from] StructureError),
}

/// Some numbers of a result.
type Part = fn(&TestResult) -> &Vec<f64>;

/// What is tested.
pub(crate) struct TestSubject<'a> {
    /// Its elements.
    pub elements: &'a [Species],
    /// Its cutoff, Å.
    pub cutoff: f64,
    /// Number of features; 0: none.
    pub dimension: usize,
    /// Whether evaluations without forces, and pull-backs with the gradient of the energy, are tested too.
    pub combined: bool,
    /// Rounding error of its numbers.
    pub epsilon: f64,
}

/// Runs the test.
///
/// # Errors
/// A model that fails it, with the figures.
pub(crate) fn run(
    subject: &TestSubject<'_>,
    model: &mut impl Evaluate,
) -> Result<SelfTestReport, SelfTestError> {
    let mut test = SelfTest { subject, model, report: SelfTestReport::default() };
    let cluster = structure(subject.elements, false);
    let crystal = structure(subject.elements, true);
    test.derivatives(&cluster, "of a cluster")?;
    test.derivatives(&crystal, "of a crystal")?;
    test.strain(&crystal)?;
    test.permutation(&cluster)?;
    test.skin(&crystal)?;
    test.repeats(&cluster, &crystal)?;
    if subject.combined && subject.dimension > 0 {
        test.combined_gradients(&cluster, &crystal)?;
    }
    test.verdict()
}

/// The structure that shows later whether a server still gives what it gave at the start.
pub(crate) fn reference(subject: &TestSubject<'_>) -> Result<BondGeometry, StructureError> {
    geometry(&structure(subject.elements, false), subject, SKIN)
}

struct SelfTest<'a, M> {
    subject: &'a TestSubject<'a>,
    model: &'a mut M,
    report: SelfTestReport,
}

impl<M: Evaluate> SelfTest<'_, M> {
    fn ask(
        &mut self,
        structures: &[&Structure],
        skin: f64,
        asked: Asked<'_>,
    ) -> Result<Vec<TestResult>, SelfTestError> {
        let geometries = structures.iter().map(|one| geometry(one, self.subject, skin));
        let geometries = geometries.collect::<Result<Vec<_>, _>>()?;
        let references: Vec<_> = geometries.iter().collect();
        self.model.ask(&references, asked).map_err(SelfTestError::Call)
    }

    fn evaluate(&mut self, structures: &[Structure]) -> Result<Vec<TestResult>, SelfTestError> {
        let structures: Vec<_> = structures.iter().collect();
        self.ask(&structures, SKIN, Asked::Forces)
    }

    fn pull_back(&mut self, structure: &Structure, cotangent: &[f64]) -> Result<TestResult, SelfTestError> {
        let results = self.pull_back_all(&[(structure, cotangent)], false, false)?;
        results.into_iter().next().ok_or_else(|| SelfTestError::Call("no result".to_owned()))
    }

    fn pull_back_all(
        &mut self,
        all: &[(&Structure, &[f64])],
        with_energy: bool,
        kept: bool,
    ) -> Result<Vec<TestResult>, SelfTestError> {
        let (structures, cotangents): (Vec<_>, Vec<_>) = all.iter().copied().unzip();
        self.ask(&structures, SKIN, Asked::Gradients { cotangents: &cotangents, with_energy, kept })
    }

    /// Pull-backs from what an evaluation kept against those that evaluate anew, since the device did not wait for them: which of the two a
    /// walker has depends on time.
    fn kept(&mut self, all: &[(&Structure, &[f64])], with_energy: bool) -> Result<(), SelfTestError> {
        let structures: Vec<_> = all.iter().map(|(structure, _)| *structure).collect();
        self.ask(&structures, SKIN, if with_energy { Asked::NoForces } else { Asked::Forces })?;
        let kept = self.pull_back_all(all, with_energy, true)?;
        let anew = self.pull_back_all(all, with_energy, false)?;
        self.report.is_deterministic &= kept == anew;
        let of = if with_energy { "energy and features together" } else { "the features" };
        let parts: [(Part, &str); 2] = [(|one| &one.vectors, "gradient"), (|one| &one.virial, "virial")];
        for (numbers, name) in parts {
            let pairs = kept.iter().zip(&anew);
            let error = pairs.map(|(a, b)| distance(numbers(a), numbers(b))).fold(0.0, f64::max);
            let scale: Vec<f64> = anew.iter().flat_map(numbers).copied().collect();
            let what = format!("the {name} of {of} by what the evaluation kept");
            self.compare(what, error, self.same(&scale));
        }
        Ok(())
    }

    fn compare(&mut self, what: String, error: f64, tolerance: f64) {
        self.report.figures.push((what, error, tolerance));
    }

    /// Forces and the gradient of a random combination of the features against differences along random directions.
    fn derivatives(&mut self, structure: &Structure, of: &str) -> Result<(), SelfTestError> {
        let n = structure.len();
        let plain = self.evaluate(std::slice::from_ref(structure))?.swap_remove(0);
        let cotangent = random_numbers(n * self.subject.dimension, 7);
        let gradient =
            if cotangent.is_empty() { None } else { Some(self.pull_back(structure, &cotangent)?.vectors) };
        for direction in 0..3 {
            let along = random_numbers(3 * n, 11 + direction);
            let moved = |step: f64| {
                let mut moved = structure.clone();
                moved.positions.as_flattened_mut().iter_mut().zip(&along).for_each(|(x, d)| *x += step * d);
                moved
            };
            let stencil = self.evaluate(&STENCIL.map(|(factor, _)| moved(factor * STEP)))?;
            let expected = -dot(&plain.vectors, &along);
            let what = format!("the force {of} along direction {}", direction + 1);
            let scale = norm(&plain.vectors) * norm(&along);
            self.compare_difference(what, expected, scale, &stencil, |one| &one.energies, None);
            if let Some(gradient) = &gradient {
                let what = format!("the gradient of the features {of} along direction {}", direction + 1);
                let scale = norm(gradient) * norm(&along);
                let expected = dot(gradient, &along);
                self.compare_difference(
                    what,
                    expected,
                    scale,
                    &stencil,
                    |one| &one.features,
                    Some(&cotangent),
                );
            }
        }
        Ok(())
    }

    /// Virials of energy and features against differences along a random strain.
    fn strain(&mut self, crystal: &Structure) -> Result<(), SelfTestError> {
        let plain = self.evaluate(std::slice::from_ref(crystal))?.swap_remove(0);
        let cotangent = random_numbers(crystal.len() * self.subject.dimension, 8);
        let strain = symmetric(&random_numbers(6, 17));
        let stencil = self.evaluate(&STENCIL.map(|(factor, _)| strained(crystal, &strain, factor * STEP)))?;
        let strain = strain.as_flattened();
        let scale = norm(&plain.virial) * norm(strain);
        let expected = -dot(&plain.virial, strain);
        self.compare_difference(
            "the virial".to_owned(),
            expected,
            scale,
            &stencil,
            |one| &one.energies,
            None,
        );
        if !cotangent.is_empty() {
            let virial = self.pull_back(crystal, &cotangent)?.virial;
            let (scale, expected) = (norm(&virial) * norm(strain), dot(&virial, strain));
            let what = "the virial of the features".to_owned();
            self.compare_difference(what, expected, scale, &stencil, |one| &one.features, Some(&cotangent));
        }
        Ok(())
    }

    /// Compares with the difference of a sum over `numbers`, or of their combination with `weights`.
    fn compare_difference(
        &mut self,
        what: String,
        expected: f64,
        scale: f64,
        stencil: &[TestResult],
        numbers: Part,
        weights: Option<&[f64]>,
    ) {
        let weigh =
            |values: &[f64]| weights.map_or_else(|| values.iter().sum(), |weights| dot(values, weights));
        let difference: f64 =
            stencil.iter().zip(STENCIL).map(|(one, (_, weight))| weight * weigh(numbers(one))).sum();
        let size = |values: &[f64]| match weights {
            None => values.iter().map(|x| x.abs()).sum::<f64>(),
            Some(weights) => values.iter().zip(weights).map(|(x, w)| (x * w).abs()).sum(),
        };
        let rounding =
            stencil.iter().map(|one| size(numbers(one))).fold(0.0, f64::max) * self.subject.epsilon / STEP;
        let tolerance = TOLERANCE * scale + ROUNDING * rounding + f64::MIN_POSITIVE;
        self.compare(what, (difference / STEP - expected).abs(), tolerance);
    }

    /// The same atoms in another order.
    fn permutation(&mut self, cluster: &Structure) -> Result<(), SelfTestError> {
        let n = cluster.len();
        let order: Vec<usize> = (0..n).map(|k| (k * 3 + 1) % n).collect();
        debug_assert!((0..n).all(|k| order.contains(&k)));
        let mut permuted = cluster.clone();
        for (to, from) in order.iter().enumerate() {
            permuted.species[to] = cluster.species[*from];
            permuted.positions[to] = cluster.positions[*from];
        }
        let (plain, other) =
            (self.evaluate(std::slice::from_ref(cluster))?, self.evaluate(std::slice::from_ref(&permuted))?);
        let parts: [(Part, usize, &str); 3] = [
            (|one| &one.energies, 1, "energies"),
            (|one| &one.vectors, 3, "forces"),
            (|one| &one.features, self.subject.dimension, "features"),
        ];
        for (numbers, width, name) in parts {
            let (plain, other) = (numbers(&plain[0]), numbers(&other[0]));
            let pairs = order.iter().enumerate().flat_map(|(to, from)| {
                let (own, others) = (&plain[from * width..][..width], &other[to * width..][..width]);
                own.iter().zip(others)
            });
            let error = pairs.map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
            self.compare(format!("the {name} of permuted atoms"), error, self.same(plain));
        }
        Ok(())
    }

    /// Bonds beyond the cutoff contribute nothing.
    fn skin(&mut self, crystal: &Structure) -> Result<(), SelfTestError> {
        let (near, far) =
            (self.ask(&[crystal], 0.0, Asked::Forces)?, self.ask(&[crystal], 0.8, Asked::Forces)?);
        let error = distance(&near[0].energies, &far[0].energies);
        self.compare(
            "the energies with bonds beyond the cutoff".to_owned(),
            error,
            self.same(&near[0].energies),
        );
        Ok(())
    }

    /// Bits of a repeated call, and of a structure beside others.
    fn repeats(&mut self, cluster: &Structure, crystal: &Structure) -> Result<(), SelfTestError> {
        let alone = self.evaluate(std::slice::from_ref(cluster))?;
        let again = self.evaluate(std::slice::from_ref(cluster))?;
        let beside = self.evaluate(&[crystal.clone(), cluster.clone(), crystal.clone()])?;
        self.report.is_deterministic = alone == again;
        self.report.is_batch_independent = alone[0] == beside[1];
        let error = distance(&alone[0].vectors, &beside[1].vectors);
        self.compare("the forces beside other structures".to_owned(), error, self.same(&alone[0].vectors));
        let cotangent = random_numbers(cluster.len() * self.subject.dimension, 9);
        if !cotangent.is_empty() {
            let first = self.pull_back(cluster, &cotangent)?;
            self.report.is_deterministic &= first == self.pull_back(cluster, &cotangent)?;
            let of_crystal = random_numbers(crystal.len() * self.subject.dimension, 10);
            let neighbour = (crystal, &of_crystal[..]);
            let all = [neighbour, (cluster, &cotangent[..]), neighbour];
            let beside = self.pull_back_all(&all, false, false)?;
            self.report.is_batch_independent &= beside.get(1) == Some(&first);
            self.kept(&all, false)?;
        }
        Ok(())
    }

    /// Evaluations without forces, and one gradient of energy and features, against those apart.
    fn combined_gradients(&mut self, cluster: &Structure, crystal: &Structure) -> Result<(), SelfTestError> {
        let mut ask = |structures: &[&Structure]| self.ask(structures, SKIN, Asked::NoForces);
        let (alone, again) = (ask(&[cluster])?, ask(&[cluster])?);
        let beside = ask(&[crystal, cluster, crystal])?;
        self.report.is_deterministic &= alone == again;
        self.report.is_batch_independent &= alone[0] == beside[1];
        let plain = self.evaluate(std::slice::from_ref(cluster))?.swap_remove(0);
        let parts: [(Part, &str); 2] = [(|one| &one.energies, "energies"), (|one| &one.features, "features")];
        for (numbers, name) in parts {
            let error = distance(numbers(&alone[0]), numbers(&plain));
            self.compare(format!("the {name} without forces"), error, self.same(numbers(&plain)));
        }
        let cotangent = random_numbers(cluster.len() * self.subject.dimension, 9);
        let of_crystal = random_numbers(crystal.len() * self.subject.dimension, 10);
        let (own, neighbour) = ((cluster, &cotangent[..]), (crystal, &of_crystal[..]));
        let first = self.pull_back_all(&[own], true, false)?;
        let again = self.pull_back_all(&[own], true, false)?;
        self.report.is_deterministic &= first == again;
        let all = [neighbour, own, neighbour];
        let beside = self.pull_back_all(&all, true, false)?;
        self.report.is_batch_independent &= beside.get(1) == first.first();
        self.kept(&all, true)?;
        let apart = self.pull_back(cluster, &cotangent)?;
        let parts: [(Part, &str); 2] = [(|one| &one.vectors, "gradient"), (|one| &one.virial, "virial")];
        for (numbers, name) in parts {
            let sum: Vec<f64> = numbers(&apart)
                .iter()
                .zip(numbers(&plain))
                .map(|(gradient, force)| gradient - force)
                .collect();
            let scale: Vec<f64> = numbers(&apart).iter().chain(numbers(&plain)).copied().collect();
            let error = distance(numbers(&first[0]), &sum);
            self.compare(format!("the {name} of energy and features together"), error, self.same(&scale));
        }
        Ok(())
    }

    /// Largest difference of the same numbers from sums in another order.
    fn same(&self, numbers: &[f64]) -> f64 {
        let largest = numbers.iter().map(|x| x.abs()).fold(0.0, f64::max);
        1e3 * ROUNDING * self.subject.epsilon * (largest + 1e-3)
    }

    fn verdict(self) -> Result<SelfTestReport, SelfTestError> {
        let wrong =
            self.report.figures.iter().find(|(_, error, tolerance)| error.is_nan() || error > tolerance);
        let Some((what, error, tolerance)) = wrong else { return Ok(self.report) };
        let line = |(what, error, tolerance): &(String, f64, f64)| {
            let verdict = if error <= tolerance { "ok" } else { "WRONG" };
            format!("  {what}: error {error:.2e}, tolerance {tolerance:.2e}: {verdict}")
        };
        let figures: Vec<_> = self.report.figures.iter().map(line).collect();
        Err(SelfTestError::Wrong {
            what: what.clone(),
            error: *error,
            tolerance: *tolerance,
            figures: figures.join("\n"),
        })
    }
}

/// Central difference of the fourth order: steps and weights.
const STENCIL: [(f64, f64); 4] =
    [(-2.0, 1.0 / 12.0), (-1.0, -8.0 / 12.0), (1.0, 8.0 / 12.0), (2.0, -1.0 / 12.0)];

fn geometry(
    structure: &Structure,
    subject: &TestSubject<'_>,
    skin: f64,
) -> Result<BondGeometry, StructureError> {
    let mut list = NeighbourList::new(subject.cutoff, skin);
    list.update(structure)?;
    let index =
        |species: &Species| subject.elements.iter().position(|known| known == species).unwrap_or_default();
    let species: Vec<usize> = structure.species.iter().map(index).collect();
    Ok(BondGeometry::from_structure(structure, Topology::from_list(&species, &list, None)))
}

/// Eight atoms on a distorted cubic lattice, of all elements in turn.
fn structure(elements: &[Species], is_periodic: bool) -> Structure {
    let species: Vec<Species> = (0..8).map(|k| elements[k % elements.len()]).collect();
    let largest = species.iter().map(|one| one.covalent_radius()).fold(0.0, f64::max);
    let spacing = SPACING * 2.0 * largest;
    let jitter = random_numbers(24, 3);
    let position = |k: usize| {
        std::array::from_fn(|axis| spacing * ((k >> axis & 1) as f64 + JITTER * jitter[3 * k + axis]))
    };
    let mut cell = [[0.0; 3]; 3];
    if is_periodic {
        let length = 2.0 * spacing;
        cell = [
            [length, 0.0, 0.0],
            [0.11 * length, 1.04 * length, 0.0],
            [-0.07 * length, 0.05 * length, 0.97 * length],
        ];
    }
    Structure {
        species,
        positions: (0..8).map(position).collect(),
        cell: Cell(cell),
        periodic: [is_periodic; 3],
    }
}

fn strained(structure: &Structure, strain: &[[f64; 3]; 3], step: f64) -> Structure {
    let moved = |vector: &[f64; 3]| -> [f64; 3] {
        std::array::from_fn(|i| vector[i] + step * (0..3).map(|k| strain[i][k] * vector[k]).sum::<f64>())
    };
    let positions = structure.positions.iter().map(moved).collect();
    Structure { positions, cell: Cell(structure.cell.0.map(|row| moved(&row))), ..structure.clone() }
}

fn symmetric(six: &[f64]) -> [[f64; 3]; 3] {
    [[six[0], six[5], six[4]], [six[5], six[1], six[3]], [six[4], six[3], six[2]]]
}

/// Numbers between −1 and 1, always the same ones (a multiplicative congruential generator, Park & Miller 1988).
pub(crate) fn random_numbers(count: usize, seed: u64) -> Vec<f64> {
    let mut state = 1 + seed * 7919;
    let mut next = || {
        state = state * 48271 % 2_147_483_647;
        2.0 * state as f64 / 2_147_483_647.0 - 1.0
    };
    for _ in 0..10 {
        next();
    }
    (0..count).map(|_| next()).collect()
}

fn dot(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).map(|(a, b)| a * b).sum()
}

fn norm(a: &[f64]) -> f64 {
    dot(a, a).sqrt()
}

fn distance(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max)
}
