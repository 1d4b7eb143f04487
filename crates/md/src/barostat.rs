//! The barostat of Martyna, Tobias and Klein.

use atoms::cell::{add, row_times};
use atoms::units::{ACCELERATION, BOLTZMANN};
use atoms::{Cell, Matrix3, Structure, Vec3};
use serde::{Deserialize, Serialize};

use crate::cell_freedom::{CellFreedom, CellSpace};
use crate::error::DynamicsError;
use crate::lattice_reduction::is_skew;
use crate::nose_hoover::NoseHooverChain;
use crate::random::{Stream, StreamId};
use crate::state::kinetic_tensor;
use crate::strain_rate::{IDENTITY, StrainModes, combined, contraction, phi, trace, transposed};
use crate::thermostat::Thermostat;
use crate::volume_ramp::{extent, scale_volume};
use crate::wrong_setting::is_positive;

/// The largest change of a length of the cell in one step. A cell at equilibrium changes by a thousandth of that.
const MAX_STRAIN: f64 = 0.05;

/// Relative volumes that no phase of a material reaches at a pressure at which it is one.
const RELATIVE_VOLUMES: [f64; 2] = [0.25, 4.0];

/// A cell that moves under the difference between the stress inside and the set one (Martyna, Tobias & Klein, J. Chem.
/// Phys. 101, 4177 (1994); Martyna, Tuckerman, Tobias & Klein, Mol. Phys. 87, 1117 (1996)), factorised as in
/// Tuckerman, Alejandre, López-Rendón, Jochim & Martyna, J. Phys. A 39, 5629 (2006).
///
/// With row vectors, the lattice vectors h, the strain rate ν and N_f degrees of freedom of the atoms:
///
/// ```text
/// dr/dt = v + r ν      dv/dt = F/m − v νᵀ − (Tr ν / N_f) v      dh/dt = h ν
/// W dν/dt = V (P − P_ext) + (2K / N_f) 1,    V P = Σ m vᵀv + virial
/// ```
///
/// of which ν keeps the part that [`CellFreedom`] allows. W = (N_f + d) k_B T t² / d with the damping time t and d
/// periodic directions. [docs/dynamics.md](../../../docs/dynamics.md) has the ensemble and its derivation.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Barostat {
    /// Which motions of the cell are allowed.
    pub freedom: CellFreedom,
    /// Temperature of the cell, K.
    pub temperature: f64,
    /// Damping time t, fs.
    pub damping_time: f64,
    /// The set pressure, eV/Å³.
    pub pressure: f64,
    /// External stress in addition to the pressure, symmetric, eV/Å³, tension positive.
    pub stress: Matrix3,
    /// ν, 1/fs.
    pub strain_rate: Matrix3,
    /// The thermostat of the cell.
    pub thermostat: CellThermostat,
    /// A stress that is added to that of the potential, symmetric, eV/Å³, tension positive: the bias on the cell.
    pub bias_stress: Matrix3,
    /// Work on the cell by `stress` and `bias_stress` so far, eV.
    pub work: f64,
    /// Energy given to the cell by its random force so far, eV.
    pub heat: f64,
    /// Volume at the start, Å³ (Å² for a slab, Å for a wire).
    pub reference_volume: f64,
    /// Smallest and largest volume, at which the cell is reflected, in the unit of `reference_volume`.
    pub volume_range: Option<[f64; 2]>,
    /// Number of reflections so far.
    pub reflections: u64,
}

/// The thermostat of the cell.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub enum CellThermostat {
    /// None: constant enthalpy, if the atoms have none either.
    None,
    /// Friction 1/t and a random force, t being the damping time of the cell.
    Langevin,
    /// A chain with the damping time of the cell.
    NoseHooverChain(NoseHooverChain),
}

impl CellThermostat {
    /// Whether it is of the kind of that of the atoms.
    fn suits(&self, atoms: &Thermostat) -> bool {
        match atoms {
            Thermostat::None => *self == Self::None,
            Thermostat::Langevin(_) | Thermostat::VelocityRescaling(_) => *self == Self::Langevin,
            Thermostat::NoseHooverChain(_) => matches!(self, Self::NoseHooverChain(_)),
        }
    }
}

/// The atoms as the barostat sees them.
pub(crate) struct Atoms<'a> {
    pub masses: &'a [f64],
    /// N_f.
    pub degrees_of_freedom: usize,
}

impl Barostat {
    /// Number of independent motions of the cell of `structure`.
    pub fn degrees_of_freedom(&self, structure: &Structure) -> usize {
        self.space(structure).degrees_of_freedom()
    }

    /// ½ W Tr ν², eV, for N_f degrees of freedom of the atoms.
    pub fn kinetic_energy(&self, structure: &Structure, atoms_degrees_of_freedom: usize) -> f64 {
        let space = self.space(structure);
        0.5 * self.mass(&space, atoms_degrees_of_freedom) * space.square(&self.strain_rate)
    }

    /// What the cell adds to the conserved energy, eV: ½ W Tr ν² + P V and the energy of its chain, less the work of the
    /// bias and of the external stress, and less the heat of the random force.
    pub fn energy(&self, structure: &Structure, atoms_degrees_of_freedom: usize) -> f64 {
        let chain = match &self.thermostat {
            CellThermostat::NoseHooverChain(chain) => chain.energy(self.degrees_of_freedom(structure)),
            CellThermostat::None | CellThermostat::Langevin => 0.0,
        };
        let kinetic = self.kinetic_energy(structure, atoms_degrees_of_freedom);
        kinetic + self.pressure * structure.cell.volume() + chain - self.work - self.heat
    }

    /// The thermostat of the cell acts, before the first and after the last kick of a step of `time_step` fs.
    pub(crate) fn thermostat_half_step(&mut self, structure: &Structure, atoms: &Atoms, time_step: f64) {
        let kinetic = self.kinetic_energy(structure, atoms.degrees_of_freedom);
        let freedom = self.degrees_of_freedom(structure);
        if let CellThermostat::NoseHooverChain(chain) = &mut self.thermostat {
            let factor = chain.half_step(kinetic, freedom, time_step);
            self.strain_rate = self.strain_rate.map(|row| row.map(|x| factor * x));
        }
    }

    /// The stress acts on the cell for `time` fs. `virial` in eV, `velocities` in Å/fs.
    pub(crate) fn kick_cell(
        &mut self,
        structure: &Structure,
        velocities: &[Vec3],
        virial: &Matrix3,
        atoms: &Atoms,
        time: f64,
    ) {
        let (space, volume) = (self.space(structure), structure.cell.volume());
        let kinetic = kinetic_tensor(velocities, atoms.masses);
        let diagonal = trace(&kinetic) / atoms.degrees_of_freedom as f64 - self.pressure * volume;
        let outside = combined(&self.stress, &self.bias_stress, |stress, bias| volume * (stress - bias));
        let inside = combined(&kinetic, virial, |k, w| k + w);
        let on_diagonal = IDENTITY.map(|row| row.map(|x| diagonal * x));
        let force = combined(&combined(&inside, &on_diagonal, |a, b| a + b), &outside, |a, b| a + b);
        let rate = time / self.mass(&space, atoms.degrees_of_freedom);
        let before = self.strain_rate;
        self.strain_rate = combined(&before, &space.project(&force), |v, f| v + rate * f);
        // The mean of the strain rates before and after gives the exact work of a constant force.
        let mean = combined(&before, &self.strain_rate, |a, b| 0.5 * (a + b));
        self.work += time * contraction(&outside, &mean);
    }

    /// Solves dv/dt = F/m − v νᵀ − (Tr ν / N_f) v over `time` (fs). Forces in eV/Å, velocities in Å/fs.
    pub(crate) fn kick(
        &self,
        structure: &Structure,
        velocities: &mut [Vec3],
        forces: &[Vec3],
        atoms: &Atoms,
        time: f64,
    ) {
        let modes = self.modes(structure);
        let drag = trace(&self.strain_rate) / atoms.degrees_of_freedom as f64;
        let kept = transposed(&modes.function(|rate| (-(rate + drag) * time).exp()));
        let gained = transposed(&modes.function(|rate| time * phi(-(rate + drag) * time)));
        for ((v, force), mass) in velocities.iter_mut().zip(forces).zip(atoms.masses) {
            let acceleration = force.map(|f| ACCELERATION / mass * f);
            *v = add(row_times(*v, &kept), row_times(acceleration, &gained));
        }
    }

    /// Solves dr/dt = v + r ν and dh/dt = h ν over `time` (fs).
    pub(crate) fn drift(&self, structure: &mut Structure, velocities: &[Vec3], time: f64) {
        let modes = self.modes(structure);
        let stretch = modes.function(|rate| (rate * time).exp());
        let moved = modes.function(|rate| time * phi(rate * time));
        for (r, v) in structure.positions.iter_mut().zip(velocities) {
            *r = add(row_times(*r, &stretch), row_times(*v, &moved));
        }
        let Cell(rows) = &mut structure.cell;
        for (row, _) in rows.iter_mut().zip(structure.periodic).filter(|(_, periodic)| *periodic) {
            *row = row_times(*row, &stretch);
        }
    }

    /// The random force acts on the cell, between the two drifts of a step of `time_step` fs: the exact
    /// Ornstein–Uhlenbeck step with friction 1/t.
    pub(crate) fn exchange(
        &mut self,
        structure: &Structure,
        atoms: &Atoms,
        time_step: f64,
        stream: &Stream,
        step: u64,
    ) {
        if self.thermostat != CellThermostat::Langevin {
            return;
        }
        let (space, before) =
            (self.space(structure), self.kinetic_energy(structure, atoms.degrees_of_freedom));
        let kept = (-time_step / self.damping_time).exp();
        let renewed = -(-2.0 * time_step / self.damping_time).exp_m1();
        let mass = self.mass(&space, atoms.degrees_of_freedom);
        let width = (renewed * BOLTZMANN * self.temperature / mass).sqrt();
        let noise = space.normal([0, 1].map(|number| stream.normals(step, number, StreamId::Cell)));
        self.strain_rate = combined(&self.strain_rate, &noise, |v, x| kept * v + width * x);
        self.heat += self.kinetic_energy(structure, atoms.degrees_of_freedom) - before;
    }

    /// Checks that the cell does not change too fast for a step of `time_step` fs.
    pub(crate) fn check_rate(
        &self,
        structure: &Structure,
        time_step: f64,
        step: u64,
    ) -> Result<(), DynamicsError> {
        let rates = self.modes(structure).rates;
        let strain = rates.iter().fold(0.0, |most, rate| f64::max(most, (rate * time_step).abs()));
        let is_slow = strain <= MAX_STRAIN && rates.iter().all(|rate| rate.is_finite());
        if is_slow { Ok(()) } else { Err(DynamicsError::CellStrain { percent: 100.0 * strain, step }) }
    }

    /// Reflects the cell at a volume that is out of range. The cell is rescaled onto the boundary, and the isotropic part
    /// of its strain rate reversed if it leads out; the rest of the strain rate stays.
    ///
    /// # Errors
    /// Without a range, a volume that no material has.
    pub(crate) fn limit_volume(&mut self, structure: &mut Structure, step: u64) -> Result<(), DynamicsError> {
        let volume = extent(structure);
        let ratio = volume / self.reference_volume;
        let Some([least, most]) = self.volume_range else {
            let is_material = (RELATIVE_VOLUMES[0]..=RELATIVE_VOLUMES[1]).contains(&ratio);
            return if is_material { Ok(()) } else { Err(DynamicsError::CellVolume { ratio, step }) };
        };
        let boundary = if volume < least {
            least
        } else if volume > most {
            most
        } else {
            return Ok(());
        };
        scale_volume(structure, boundary / volume);
        self.reflections += 1;
        if trace(&self.strain_rate) * (volume - boundary) > 0.0 {
            let isotropic = self.space(structure).isotropic(&self.strain_rate);
            self.strain_rate = combined(&self.strain_rate, &isotropic, |v, i| v - 2.0 * i);
        }
        Ok(())
    }

    /// The first invalid setting or variable.
    pub(crate) fn invalid_setting(
        &self,
        thermostat: &Thermostat,
        structure: &Structure,
    ) -> Option<&'static str> {
        let numbers = [self.pressure, self.work, self.heat].into_iter();
        let matrices = [self.stress, self.bias_stress, self.strain_rate];
        let mut entries = numbers.chain(matrices.iter().flatten().flatten().copied());
        if structure.periodic == [false; 3] {
            return Some("a cluster has no periodic direction that could move");
        }
        if structure.len() < 2 {
            return Some("a barostat needs at least two atoms: a single one has no thermal motion");
        }
        if !is_positive(self.temperature)
            || !is_positive(self.damping_time)
            || !is_positive(self.reference_volume)
        {
            return Some("temperature, damping time and reference volume must be positive and finite");
        }
        if !entries.all(f64::is_finite) {
            return Some("pressure, stress, strain rate, work and heat must be finite");
        }
        if [self.stress, self.bias_stress].iter().any(|m| *m != transposed(m)) {
            return Some("the external stress and the bias stress must be symmetric");
        }
        let acts = self.pressure != 0.0 || self.stress != Matrix3::default();
        if acts && structure.periodic != [true; 3] {
            return Some("a slab or wire has no volume on which a pressure could act: it must be 0");
        }
        if self.freedom == CellFreedom::FixedAngles && is_skew(structure) {
            return Some(
                "the lattice vectors are too skew to be stretched at fixed angles: give shorter ones",
            );
        }
        if self
            .volume_range
            .is_some_and(|[least, most]| !(is_positive(least) && least < most && most.is_finite()))
        {
            return Some("the range of volumes must be positive and ascending");
        }
        (!self.thermostat.suits(thermostat))
            .then_some("the thermostat of the cell must be of the kind of the atoms'")
    }

    fn space(&self, structure: &Structure) -> CellSpace {
        CellSpace::new(self.freedom, structure)
    }

    fn modes(&self, structure: &Structure) -> StrainModes {
        self.space(structure).modes(&self.strain_rate)
    }

    /// W, eV fs².
    fn mass(&self, space: &CellSpace, atoms_degrees_of_freedom: usize) -> f64 {
        let d = space.dimensions() as f64;
        let freedom = atoms_degrees_of_freedom as f64 + d;
        freedom * BOLTZMANN * self.temperature * self.damping_time * self.damping_time / d
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::barostat_settings::BarostatSettings;

    #[test]
    fn reflection_turns_the_isotropic_rate_alone() {
        let mut structure = Structure {
            species: vec!["Al".parse().unwrap(); 2],
            positions: vec![[0.0; 3], [1.0, 2.0, 3.0]],
            cell: Cell([[4.0, 0.3, 0.0], [0.0, 5.0, 0.2], [0.1, 0.0, 6.0]]),
            periodic: [true; 3],
        };
        let mut barostat = BarostatSettings::default().start(300.0, &Thermostat::None, &structure);
        let volume = structure.cell.volume();
        barostat.volume_range = Some([0.75 * volume, 1.3 * volume]);
        let rate = [[3e-4, 1e-4, -2e-4], [1e-4, -1e-4, 5e-5], [-2e-4, 5e-5, 4e-4]];
        for (ratio, sign, boundary) in
            [(1.31, 1.0, 1.3), (1.31, -1.0, 1.3), (0.7, -1.0, 0.75), (0.7, 1.0, 0.75)]
        {
            let (mut cell, reflections) = (structure.clone(), barostat.reflections);
            scale_volume(&mut cell, ratio);
            barostat.strain_rate = rate.map(|row| row.map(|x| sign * x));
            let before = barostat.strain_rate;
            barostat.limit_volume(&mut cell, 7).unwrap();
            assert!((cell.cell.volume() / volume - boundary).abs() < 1e-12);
            assert_eq!(barostat.reflections, reflections + 1);
            let outward = sign * (ratio - 1.0) > 0.0;
            let turned =
                combined(&before, &IDENTITY, |v, one| v - if outward { sign * 4e-4 * one } else { 0.0 });
            let error = combined(&barostat.strain_rate, &turned, |a, b| (a - b).abs());
            assert!(error.iter().flatten().all(|x| *x < 1e-18), "{error:?}");
        }
        scale_volume(&mut structure, 1.2);
        let before = (structure.clone(), barostat.clone());
        barostat.limit_volume(&mut structure, 7).unwrap();
        assert_eq!(before, (structure, barostat));
    }

    /// Each motion has the mean energy k_B T / 2 under the random force alone.
    #[test]
    fn random_force_gives_each_motion_its_thermal_energy() {
        for freedom in [CellFreedom::Flexible, CellFreedom::Isotropic, CellFreedom::FixedAngles] {
            for periodic in [[true; 3], [true, true, false], [false, false, true]] {
                let structure = Structure {
                    species: vec!["Al".parse().unwrap(); 2],
                    positions: vec![[0.0; 3], [1.0, 2.0, 3.0]],
                    cell: Cell([[4.0, 2.3, 0.0], [0.0, 5.0, 0.2], [0.1, 0.0, 6.0]]),
                    periodic,
                };
                let settings =
                    BarostatSettings { cell: freedom, relaxation_time: 10.0, ..Default::default() };
                let mut barostat = settings.start(300.0, &Thermostat::None, &structure);
                barostat.thermostat = CellThermostat::Langevin;
                let (masses, stream) = ([27.0; 2], Stream::new(5, 0, 0));
                let atoms = Atoms { masses: &masses, degrees_of_freedom: 3 };
                let energies = (0..20_000).map(|step| {
                    // 50 fs: nearly independent samples.
                    barostat.exchange(&structure, &atoms, 50.0, &stream, step);
                    barostat.kinetic_energy(&structure, 3)
                });
                let mean = energies.sum::<f64>() / 20_000.0;
                let motions = barostat.degrees_of_freedom(&structure) as f64;
                let expected = 0.5 * motions * BOLTZMANN * 300.0;
                let error = expected * (2.0 / motions / 20_000.0_f64).sqrt();
                assert!(
                    (mean - expected).abs() < 5.0 * error,
                    "{freedom:?} {periodic:?}: {mean} eV of {expected} eV"
                );
                assert!(
                    (barostat.heat - barostat.kinetic_energy(&structure, 3)).abs()
                        < 1e-9 * expected * 20_000.0
                );
            }
        }
    }
}
