//! The HAL force: the potential biased along the gradient of the extrapolation grade.
//!
//! F_i^HAL = F_i^phys + τ_r ∇_i 𝒰, 𝒰 = Σ_j γ_j, τ_r = τ Σ_i‖F_i^phys‖ / Σ_i‖∇_i 𝒰‖, both sums exponentially
//! averaged (paper, Eq. hal-force). Energy and grade share one forward pass and one reverse sweep. A switched ZBL
//! repulsion is added with its virial after the biased force, so it does not enter τ_r.
//!
//! Both norms need both gradients. Where they are measured in every n-th evaluation only ([`BiasedPotential::norm_interval`]), the
//! evaluations between take their averages as they are, and need one gradient only: that of Σ E − τ_r 𝒰.
//!
//! The bias does not enter the virial: the cell has a bias of its own, along the direction of ∂𝒰/∂ε, which is averaged
//! here ([`crate::cell_bias`]).

mod work;

use std::sync::Arc;

use atoms::{Evaluation, Matrix3, NeighbourList, Potential, PotentialError, Species, Structure, Vec3, cell};
use calm::{BatchedGrades, GradeError, Grades, Mixture};
use potentials::grace::PullBack;
use potentials::{PotentialWithFeatures, Wall, Zbl};
use serde::{Deserialize, Serialize};

pub use work::BiasWork;

/// State of the bias, part of a walk's checkpoint.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct BiasState {
    /// Evaluations with the bias switched on.
    pub evaluations: u64,
    /// Running average of Σ‖F^phys‖, eV/Å.
    pub force_norm: f64,
    /// Running average of Σ‖∇𝒰‖, 1/Å.
    pub gradient_norm: f64,
    /// Running average of the unit direction of ∂𝒰/∂ε.
    pub strain_direction: Matrix3,
    /// Work of the bias on the atoms so far.
    pub work: BiasWork,
}

impl BiasState {
    /// Evaluations since the norms were last measured, if the next one measures them, with `interval` evaluations from one to the next;
    /// `None` if it does not. While the averages settle, all do, and so does the first with a bias. The last of each `interval` with a bias
    /// does: at the usual intervals, points of the trace then need no evaluation of their own.
    fn measures_after(&self, steps: u64, interval: u64) -> Option<u64> {
        let interval = interval.max(1);
        match self.evaluations.checked_sub(steps) {
            None | Some(0) => Some(1),
            Some(biased) if !(biased + 1).is_multiple_of(interval) => None,
            // Since the first with a bias, or since the last of the interval before.
            Some(biased) => Some(interval.min(biased)),
        }
    }

    /// Adds sums and ∂𝒰/∂ε, measured `elapsed` evaluations after the last ones, to the averages and returns τ_r / τ, eV. The averages start
    /// at the first values. The bias is zero for the first `steps` evaluations, while they settle.
    fn advance(
        &mut self,
        (force_norm, gradient_norm): (f64, f64),
        strain: &Matrix3,
        steps: u64,
        elapsed: u64,
    ) -> f64 {
        let weight = match elapsed {
            _ if self.evaluations == 0 => 1.0,
            1 => 1.0 / steps.max(1) as f64,
            // The average keeps its time, however seldom it is measured.
            _ => 1.0 - (1.0 - 1.0 / steps.max(1) as f64).powf(elapsed as f64),
        };
        self.force_norm += weight * (force_norm - self.force_norm);
        self.gradient_norm += weight * (gradient_norm - self.gradient_norm);
        let direction = unit(strain);
        for (mean, new) in self.strain_direction.iter_mut().flatten().zip(direction.as_flattened()) {
            *mean += weight * (new - *mean);
        }
        self.evaluations += 1;
        if self.evaluations <= steps { 0.0 } else { self.ratio() }
    }

    /// τ_r / τ by the averages, eV.
    fn ratio(&self) -> f64 {
        if self.gradient_norm <= 0.0 { 0.0 } else { self.force_norm / self.gradient_norm }
    }
}

/// A tensor divided by its Frobenius norm; zero stays zero.
fn unit(tensor: &Matrix3) -> Matrix3 {
    let norm = tensor.iter().flatten().map(|x| x * x).sum::<f64>().sqrt();
    if norm > 0.0 { tensor.map(|row| row.map(|x| x / norm)) } else { Matrix3::default() }
}

/// Why a structure has no grades.
#[derive(Debug, thiserror::Error)]
pub enum UngradedError {
    /// Its features cannot be computed.
    #[error(transparent)]
    Potential(#[from] PotentialError),
    /// Its features cannot be graded.
    #[error(transparent)]
    Grade(#[from] GradeError),
}

/// A potential with features, with bias and short-range repulsion.
pub struct BiasedPotential {
    potential: Box<dyn PotentialWithFeatures>,
    elements: Vec<usize>,
    zbl: Option<Zbl>,
    /// A wall around a cluster, added like the repulsion.
    pub wall: Option<Wall>,
    mixture: Arc<Mixture>,
    /// τ; 0 leaves the dynamics unbiased and computes no grades.
    pub tau: f64,
    /// State of the running averages.
    pub state: BiasState,
    bias_averaging_steps: u64,
    /// Biased evaluations from one that measures the norms of τ_r to the next. Above 1, the virial of those between contains that of the
    /// bias, and [`BiasedPotential::separate`] must take them apart before [`BiasedPotential::physical`] and what tells of the bias.
    pub norm_interval: u64,
    /// τ_r at the last evaluation, eV.
    scale: f64,
    pull_back: PullBack,
    /// With the bias on.
    parts: BatchedGrades,
    /// With the bias off.
    grades: Grades,
    physical: Evaluation,
    /// Whether `physical` has the bias in it, as the last evaluation had one gradient for both.
    is_combined: bool,
    /// Evaluations since the last one that measured the norms, if the last one did.
    measured_after: Option<u64>,
    /// τ_r ∂𝒰/∂ε as far as it is in the virial of the last evaluation, eV.
    bias_virial: Matrix3,
    /// What a separation needs.
    apart: (Evaluation, PullBack),
}

impl BiasedPotential {
    /// A potential for one composition, with the bias off (τ = 0).
    ///
    /// # Errors
    /// An element that the model does not know.
    pub fn new(
        potential: Box<dyn PotentialWithFeatures>,
        mixture: Arc<Mixture>,
        zbl: Option<Zbl>,
        bias_averaging_steps: u64,
        species: &[Species],
    ) -> Result<Self, PotentialError> {
        let elements = potential.model().element_indices(species)?;
        Ok(Self {
            potential,
            elements,
            zbl,
            wall: None,
            mixture,
            tau: 0.0,
            state: BiasState::default(),
            bias_averaging_steps,
            norm_interval: 1,
            scale: 0.0,
            pull_back: PullBack::default(),
            parts: BatchedGrades::default(),
            grades: Grades::default(),
            physical: Evaluation::default(),
            is_combined: false,
            measured_after: Some(1),
            bias_virial: Matrix3::default(),
            apart: Default::default(),
        })
    }

    /// Takes forces and bias of the last evaluation, which must have been of this structure, apart, by one more evaluation without bias if
    /// they are known as a sum only. It changes nothing that later evaluations depend on.
    ///
    /// # Errors
    /// As of an evaluation.
    pub fn separate(
        &mut self,
        structure: &Structure,
        neighbours: &NeighbourList,
    ) -> Result<(), PotentialError> {
        if !self.is_combined {
            return Ok(());
        }
        let (alone, unused) = &mut self.apart;
        self.potential.forward(structure, neighbours)?;
        self.potential.backward(None, alone, unused)?;
        let both = &self.physical;
        // The gradient of a bias that is zero is not known, and not needed.
        let per_scale = if self.scale == 0.0 { 0.0 } else { 1.0 / self.scale };
        self.pull_back.gradient.clear();
        let pairs = both.forces.iter().zip(&alone.forces);
        self.pull_back
            .gradient
            .extend(pairs.map(|(both, alone)| cell::scale(cell::sub(*both, *alone), per_scale)));
        self.bias_virial =
            std::array::from_fn(|i| std::array::from_fn(|k| both.virial[i][k] - alone.virial[i][k]));
        self.pull_back.virial = self.bias_virial.map(|row| row.map(|x| per_scale * x));
        std::mem::swap(&mut self.physical, alone);
        self.is_combined = false;
        Ok(())
    }

    /// Energy, forces and virial of the potential alone at the last evaluation.
    pub fn physical(&self) -> &Evaluation {
        debug_assert!(!self.is_combined, "forces and bias are not apart");
        &self.physical
    }

    /// τ_r ∂𝒰/∂ε as far as it is in the virial of the last evaluation, eV; known as [`BiasedPotential::physical`] is.
    pub fn bias_virial(&self) -> &Matrix3 {
        debug_assert!(!self.is_combined, "forces and bias are not apart");
        &self.bias_virial
    }

    /// Evaluations since the last one that measured the norms of τ_r, if the last one did.
    pub fn measured_after(&self) -> Option<u64> {
        self.measured_after
    }

    /// ∂𝒰/∂ε at the last evaluation with the bias on, symmetric; known as [`BiasedPotential::physical`] is.
    pub fn strain_derivative(&self) -> &Matrix3 {
        debug_assert!(!self.is_combined, "forces and bias are not apart");
        &self.pull_back.virial
    }

    /// σ_bias = −`stress` Ŵ, eV/Å³, tension positive, for `stress` = τ_s B. Zero as long as the bias on the forces is.
    pub fn cell_stress(&self, stress: f64) -> Matrix3 {
        if self.tau == 0.0 || self.state.evaluations <= self.bias_averaging_steps {
            return Matrix3::default();
        }
        unit(&self.state.strain_direction).map(|row| row.map(|x| -stress * x))
    }

    /// τ_r at the last evaluation, eV.
    pub fn bias_scale(&self) -> f64 {
        self.scale
    }

    /// Σ‖τ_r ∇𝒰‖ / Σ‖F^phys‖ at the last evaluation; 0 without bias, and without forces. Known as [`BiasedPotential::physical`] is.
    pub fn bias_share(&self) -> f64 {
        debug_assert!(!self.is_combined, "forces and bias are not apart");
        let force_norm = norms(&self.physical.forces);
        if self.scale == 0.0 || force_norm <= 0.0 {
            return 0.0;
        }
        self.scale * norms(&self.pull_back.gradient) / force_norm
    }

    /// Power of the bias of the last evaluation on atoms with these velocities (Å/fs), eV/fs; known as [`BiasedPotential::physical`] is.
    pub fn bias_power(&self, velocities: &[Vec3]) -> f64 {
        debug_assert!(!self.is_combined, "forces and bias are not apart");
        if self.scale == 0.0 {
            return 0.0;
        }
        let pairs = self.pull_back.gradient.iter().zip(velocities);
        self.scale * pairs.map(|(gradient, velocity)| cell::dot(*gradient, *velocity)).sum::<f64>()
    }

    /// Features of the atoms that [`BiasedPotential::grades`] graded, [n × D].
    pub fn features(&self) -> &[f64] {
        self.potential.features()
    }

    /// Element index of each atom.
    pub fn elements(&self) -> &[usize] {
        &self.elements
    }

    /// Grades at the last evaluation, which must have been of this structure. With the bias off, they are computed
    /// here.
    ///
    /// # Errors
    /// Features that are not finite.
    pub fn grades(
        &mut self,
        structure: &Structure,
        neighbours: &NeighbourList,
    ) -> Result<&Grades, UngradedError> {
        if self.tau != 0.0 {
            return Ok(self.parts.finish()?);
        }
        self.potential.forward(structure, neighbours)?;
        self.grades.evaluate(&self.mixture, &self.elements, self.potential.features(), None)?;
        Ok(&self.grades)
    }

    /// γ of the atoms that [`BiasedPotential::grades`] graded, under another mixture.
    ///
    /// # Errors
    /// Features that are not finite.
    pub fn grades_under(&self, mixture: &Mixture) -> Result<Grades, GradeError> {
        let mut grades = Grades::default();
        grades.evaluate(mixture, &self.elements, self.features(), None)?;
        Ok(grades)
    }

    fn evaluate_biased(
        &mut self,
        structure: &Structure,
        neighbours: &NeighbourList,
        out: &mut Evaluation,
    ) -> Result<(), PotentialError> {
        self.measured_after = self.state.measures_after(self.bias_averaging_steps, self.norm_interval);
        let Some(elapsed) = self.measured_after else {
            return self.evaluate_combined(structure, neighbours, out);
        };
        let Self { potential, mixture, elements, parts, pull_back, .. } = self;
        parts.begin(elements.len());
        let grade = |atoms: &[u32], features: &[f64], cotangent: &mut [f64]| {
            parts.add(mixture, elements, atoms, features, cotangent);
        };
        potential.evaluate_graded(structure, neighbours, &grade, out, Some(pull_back))?;
        copy(out, &mut self.physical);
        if self.parts.finish().is_ok() {
            self.add_bias(out, elapsed);
        }
        Ok(())
    }

    /// Forces and bias, with the norms that were measured last, as one gradient.
    fn evaluate_combined(
        &mut self,
        structure: &Structure,
        neighbours: &NeighbourList,
        out: &mut Evaluation,
    ) -> Result<(), PotentialError> {
        let scale = self.tau * self.state.ratio();
        let Self { potential, mixture, elements, parts, .. } = self;
        parts.begin(elements.len());
        let grade = |atoms: &[u32], features: &[f64], cotangent: &mut [f64]| {
            parts.add(mixture, elements, atoms, features, cotangent);
            cotangent.iter_mut().for_each(|x| *x *= -scale);
        };
        potential.evaluate_combined(structure, neighbours, &grade, out)?;
        copy(out, &mut self.physical);
        self.is_combined = true;
        self.scale = scale;
        if self.parts.finish().is_ok() {
            self.state.evaluations += 1;
        }
        Ok(())
    }

    fn add_bias(&mut self, out: &mut Evaluation, elapsed: u64) {
        let norms = (norms(&out.forces), norms(&self.pull_back.gradient));
        let (strain, steps) = (&self.pull_back.virial, self.bias_averaging_steps);
        let scale = self.tau * self.state.advance(norms, strain, steps, elapsed);
        self.scale = scale;
        for (force, gradient) in out.forces.iter_mut().zip(&self.pull_back.gradient) {
            *force = cell::add(*force, cell::scale(*gradient, scale));
        }
    }
}

impl Potential for BiasedPotential {
    fn cutoff(&self) -> f64 {
        self.potential.cutoff()
    }

    fn species(&self) -> &[Species] {
        self.potential.species()
    }

    fn evaluate(
        &mut self,
        structure: &Structure,
        neighbours: &NeighbourList,
        out: &mut Evaluation,
    ) -> Result<(), PotentialError> {
        (self.scale, self.is_combined, self.bias_virial) = (0.0, false, Matrix3::default());
        self.measured_after = Some(1);
        if self.tau == 0.0 {
            self.potential.evaluate(structure, neighbours, out)?;
            copy(out, &mut self.physical);
        } else {
            self.evaluate_biased(structure, neighbours, out)?;
        }
        if let Some(zbl) = &self.zbl {
            zbl.add(structure, neighbours, out)?;
        }
        if let Some(wall) = &self.wall {
            wall.add(structure, out);
        }
        Ok(())
    }
}

/// Σ‖v‖
fn norms(vectors: &[Vec3]) -> f64 {
    vectors.iter().map(|v| cell::norm(*v)).sum()
}

/// Copies `from` to `to`, whose memory is reused.
fn copy(from: &Evaluation, to: &mut Evaluation) {
    to.atomic_energies.clone_from(&from.atomic_energies);
    to.forces.clone_from(&from.forces);
    to.virial = from.virial;
}
