//! Analytically tractable potentials, crystals, and statistics of time series.
use atoms::{Cell, Evaluation, NeighbourList, Potential, PotentialError, Species, Structure, Vec3};
use md::{BarostatSettings, CellMotion, Dynamics, DynamicsSettings, State, Stream, Thermostat};
use potentials::Eam;

/// Lennard-Jones for argon, 4ε((σ/r)¹² − (σ/r)⁶) (1 − r²/c²)³: smooth to the second derivative at c.
pub struct LennardJones {
    species: [Species; 1],
    pub evaluations: usize,
}

impl LennardJones {
    const EPSILON: f64 = 0.0103;
    const SIGMA: f64 = 3.405;
    const CUTOFF: f64 = 7.0;

    pub fn argon() -> Self {
        Self { species: ["Ar".parse().unwrap()], evaluations: 0 }
    }

    /// Energy and its derivative.
    fn pair(r: f64) -> (f64, f64) {
        let s6 = (Self::SIGMA / r).powi(6);
        let (bare, slope) =
            (4.0 * Self::EPSILON * s6 * (s6 - 1.0), -24.0 * Self::EPSILON * s6 * (2.0 * s6 - 1.0) / r);
        let x = 1.0 - (r / Self::CUTOFF).powi(2);
        (bare * x.powi(3), slope * x.powi(3) - bare * 6.0 * x * x * r / Self::CUTOFF.powi(2))
    }
}

impl Potential for LennardJones {
    fn cutoff(&self) -> f64 {
        Self::CUTOFF
    }

    fn species(&self) -> &[Species] {
        &self.species
    }

    fn evaluate(
        &mut self,
        structure: &Structure,
        neighbours: &NeighbourList,
        out: &mut Evaluation,
    ) -> Result<(), PotentialError> {
        self.evaluations += 1;
        out.reset(structure.len());
        let mut bonds = Vec::new();
        for i in 0..structure.len() {
            neighbours.bonds_within(structure, i, Self::CUTOFF, &mut bonds);
            for bond in &bonds {
                let (energy, slope) = Self::pair(bond.r);
                out.atomic_energies[i] += 0.5 * energy;
                for k in 0..3 {
                    out.forces[i][k] += slope * bond.d[k] / bond.r;
                    for l in 0..3 {
                        out.virial[k][l] -= 0.5 * slope * bond.d[k] * bond.d[l] / bond.r;
                    }
                }
            }
        }
        Ok(())
    }
}

/// Each atom on a spring attached to its own site.
pub struct Springs {
    species: [Species; 1],
    pub sites: Vec<Vec3>,
    /// eV/Å².
    pub stiffness: f64,
}

impl Springs {
    pub fn new(sites: Vec<Vec3>, stiffness: f64) -> Self {
        Self { species: ["Ar".parse().unwrap()], sites, stiffness }
    }
}

impl Potential for Springs {
    fn cutoff(&self) -> f64 {
        1.0
    }

    fn species(&self) -> &[Species] {
        &self.species
    }

    fn evaluate(
        &mut self,
        structure: &Structure,
        _: &NeighbourList,
        out: &mut Evaluation,
    ) -> Result<(), PotentialError> {
        out.reset(structure.len());
        for (i, (r, site)) in structure.positions.iter().zip(&self.sites).enumerate() {
            let u = atoms::cell::sub(*r, *site);
            out.atomic_energies[i] = 0.5 * self.stiffness * atoms::cell::dot(u, u);
            out.forces[i] = u.map(|x| -self.stiffness * x);
        }
        Ok(())
    }
}

/// Atoms without interaction.
pub struct IdealGas([Species; 1]);

impl IdealGas {
    pub fn argon() -> Self {
        Self(["Ar".parse().unwrap()])
    }
}

impl Potential for IdealGas {
    fn cutoff(&self) -> f64 {
        0.1
    }

    fn species(&self) -> &[Species] {
        &self.0
    }

    fn evaluate(
        &mut self,
        structure: &Structure,
        _: &NeighbourList,
        out: &mut Evaluation,
    ) -> Result<(), PotentialError> {
        out.reset(structure.len());
        Ok(())
    }
}

/// The embedded-atom potential of aluminium in `configs/data`.
pub fn aluminium() -> Eam {
    Eam::load(concat!(env!("CARGO_MANIFEST_DIR"), "/../../configs/data/Al_mm.eam.fs")).unwrap()
}

/// Face-centred cubic argon of n³ cubic cells.
pub fn argon_crystal(n: usize) -> Structure {
    crystal("Ar", 5.4, n)
}

/// A face-centred cubic crystal of n³ cubic cells with the lattice constant `a`, Å.
pub fn crystal(element: &str, a: f64, n: usize) -> Structure {
    let basis = [[0.0, 0.0, 0.0], [0.5, 0.5, 0.0], [0.5, 0.0, 0.5], [0.0, 0.5, 0.5]];
    let mut positions = Vec::new();
    for cell in 0..n * n * n {
        let corner = [cell % n, cell / n % n, cell / (n * n)].map(|x| x as f64);
        positions.extend(basis.map(|b| std::array::from_fn(|k| a * (corner[k] + b[k]))));
    }
    let edge = a * n as f64;
    Structure {
        species: vec![element.parse().unwrap(); positions.len()],
        positions,
        cell: Cell::orthorhombic(edge, edge, edge),
        periodic: [true; 3],
    }
}

pub fn settings(time_step: f64, thermostat: Thermostat) -> DynamicsSettings {
    DynamicsSettings {
        time_step,
        thermostat,
        cell_motion: CellMotion::Fixed,
        stream: Stream::new(2024, 1, 0),
        skin: 0.6,
    }
}

/// These settings with a barostat for `structure`.
pub fn with_barostat(
    settings: DynamicsSettings,
    barostat: &BarostatSettings,
    temperature: f64,
    structure: &Structure,
) -> DynamicsSettings {
    let cell_motion = barostat.start(temperature, &settings.thermostat, structure).into();
    DynamicsSettings { cell_motion, ..settings }
}

/// Argon at `temperature` after `steps` steps away from the perfect crystal.
pub fn warm_argon(
    n: usize,
    temperature: f64,
    settings: DynamicsSettings,
    steps: usize,
) -> (Dynamics, LennardJones) {
    let state = State::thermal(argon_crystal(n), temperature, &settings.stream);
    let mut potential = LennardJones::argon();
    let mut dynamics = Dynamics::new(state, settings, &mut potential).unwrap();
    (0..steps).for_each(|_| dynamics.step(&mut potential).unwrap());
    (dynamics, potential)
}

/// Mean and variance of a correlated series with standard errors from block averages (Flyvbjerg & Petersen, J.
/// Chem. Phys. 91, 461 (1989)). Blocks must be much longer than the correlation time.
pub fn mean_and_variance(series: &[f64], blocks: usize) -> ([f64; 2], [f64; 2]) {
    let (mean, mean_error) = block_average(series, blocks);
    let squares: Vec<f64> = series.iter().map(|x| (x - mean).powi(2)).collect();
    let (variance, variance_error) = block_average(&squares, blocks);
    ([mean, mean_error], [variance, variance_error])
}

fn block_average(series: &[f64], blocks: usize) -> (f64, f64) {
    let length = series.len() / blocks;
    let means: Vec<f64> = series
        .chunks_exact(length)
        .take(blocks)
        .map(|block| block.iter().sum::<f64>() / length as f64)
        .collect();
    let mean = means.iter().sum::<f64>() / blocks as f64;
    let scatter = means.iter().map(|m| (m - mean).powi(2)).sum::<f64>() / (blocks - 1) as f64;
    (mean, (scatter / blocks as f64).sqrt())
}

/// The slope a of ln(p₁/p₂) = a x + b for samples of two distributions, by maximum likelihood, with its standard error
/// from blocks, each left out once.
pub fn log_odds_slope(first: &[f64], second: &[f64], blocks: usize) -> [f64; 2] {
    let slope = logistic_slope(first, second);
    let without = |series: &[f64], block: usize| -> Vec<f64> {
        let length = series.len() / blocks;
        let kept = |k: &usize| k / length != block;
        (0..series.len()).filter(kept).map(|k| series[k]).collect()
    };
    let slopes = (0..blocks).map(|block| logistic_slope(&without(first, block), &without(second, block)));
    let variance = slopes.map(|s| (s - slope).powi(2)).sum::<f64>() * (blocks - 1) as f64 / blocks as f64;
    [slope, variance.sqrt()]
}

/// Newton's method for the logistic regression of the origin of each sample.
fn logistic_slope(first: &[f64], second: &[f64]) -> f64 {
    let all = || first.iter().map(|x| (*x, 1.0)).chain(second.iter().map(|x| (*x, 0.0)));
    let count = (first.len() + second.len()) as f64;
    let mean = all().map(|(x, _)| x).sum::<f64>() / count;
    let width = (all().map(|(x, _)| (x - mean).powi(2)).sum::<f64>() / count).sqrt();
    let (mut a, mut b) = (0.0, 0.0);
    for _ in 0..20 {
        let (mut gradient, mut hessian) = ([0.0; 2], [0.0; 3]);
        for (x, is_first) in all() {
            let x = (x - mean) / width;
            let p = 1.0 / (1.0 + f64::exp(-(a * x + b)));
            let (miss, weight) = (is_first - p, p * (1.0 - p));
            gradient = [gradient[0] + miss * x, gradient[1] + miss];
            hessian = [hessian[0] + weight * x * x, hessian[1] + weight * x, hessian[2] + weight];
        }
        let determinant = hessian[0] * hessian[2] - hessian[1] * hessian[1];
        a += (hessian[2] * gradient[0] - hessian[1] * gradient[1]) / determinant;
        b += (hessian[0] * gradient[1] - hessian[1] * gradient[0]) / determinant;
    }
    a / width
}
