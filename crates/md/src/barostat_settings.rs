//! Settings of a barostat.

use atoms::units::GPA_PER_EV_A3;
use atoms::{Matrix3, Structure};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::barostat::{Barostat, CellThermostat};
use crate::cell_freedom::CellFreedom;
use crate::nose_hoover::NoseHooverChain;
use crate::thermostat::{Thermostat, ThermostatSettings};
use crate::volume_ramp::extent;
use crate::wrong_setting::WrongSetting;

/// 1 eV/Å³ in bar.
pub const BAR_PER_EV_A3: f64 = 1e4 * GPA_PER_EV_A3;

/// The largest pressure, bar, that is taken for none on a slab or wire, whose volume is not defined: it changes the
/// lattice constant of a metal by less than the thermal expansion of one kelvin does.
const NEGLIGIBLE_PRESSURE: f64 = 10.0;

/// The pressure and the stress that a barostat keeps.
///
/// Every key has a default, that of the paper ('Uncertainty-biased data collection in aluminium and silicon') where it
/// names one, otherwise that of its walker (`grace_uq hal`).
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct BarostatSettings {
    /// Pressure, bar.
    pub pressure: f64,
    /// External stress in addition to the pressure, [xx, yy, zz, yz, xz, xy], bar, tension positive.
    pub stress: [f64; 6],
    /// Which motions of the cell are allowed.
    pub cell: CellFreedom,
    /// Relaxation time of the cell, fs.
    #[schemars(extend("exclusiveMinimum" = 0))]
    pub relaxation_time: f64,
}

impl Default for BarostatSettings {
    /// 1 bar and a fully flexible cell, as in the paper. 1000 fs, as in its walker: ten times the usual relaxation time of
    /// the atoms' thermostat, so that the cell moves slowly beside the atoms, and still short beside a walk.
    fn default() -> Self {
        Self { pressure: 1.0, stress: [0.0; 6], cell: CellFreedom::Flexible, relaxation_time: 1000.0 }
    }
}

impl BarostatSettings {
    /// The barostat at rest for `structure`. `temperature` (K) of the run; the thermostat of the cell is of the kind of
    /// that of the atoms.
    ///
    /// On a slab or wire, a pressure up to 10 bar is taken for none.
    pub fn start(&self, temperature: f64, thermostat: &Thermostat, structure: &Structure) -> Barostat {
        let [xx, yy, zz, yz, xz, xy] = self.stress.map(|stress| stress / BAR_PER_EV_A3);
        let is_bulk = structure.periodic == [true; 3];
        let is_none = !is_bulk && self.pressure.abs() <= NEGLIGIBLE_PRESSURE;
        Barostat {
            freedom: self.cell,
            temperature,
            damping_time: self.relaxation_time,
            pressure: if is_none { 0.0 } else { self.pressure / BAR_PER_EV_A3 },
            stress: [[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]],
            strain_rate: [[0.0; 3]; 3],
            thermostat: self.cell_thermostat(temperature, thermostat),
            bias_stress: Matrix3::default(),
            work: 0.0,
            heat: 0.0,
            reference_volume: extent(structure),
            volume_range: None,
            reflections: 0,
        }
    }

    /// Why a run of `structure` under this thermostat at `temperature` (K) cannot have this barostat, if it cannot.
    pub fn fault(
        &self,
        temperature: f64,
        thermostat: &ThermostatSettings,
        structure: &Structure,
    ) -> Option<&'static str> {
        let thermostat = thermostat.start(temperature);
        self.start(temperature, &thermostat, structure).invalid_setting(&thermostat, structure)
    }

    /// The first setting with an impossible value.
    pub fn wrong(&self) -> Option<WrongSetting> {
        let finite =
            [("pressure", self.pressure)].into_iter().chain(self.stress.map(|stress| ("stress", stress)));
        let mut wrong = finite.filter(|(_, found)| !found.is_finite());
        match wrong.next() {
            Some((key, found)) => Some(WrongSetting { key, found, expected: "a finite number" }),
            None => WrongSetting::unless_positive("relaxation_time", self.relaxation_time),
        }
    }

    fn cell_thermostat(&self, temperature: f64, thermostat: &Thermostat) -> CellThermostat {
        match thermostat {
            Thermostat::None => CellThermostat::None,
            Thermostat::NoseHooverChain(chain) => {
                let length = chain.velocities.len();
                CellThermostat::NoseHooverChain(NoseHooverChain::new(
                    temperature,
                    self.relaxation_time,
                    length,
                ))
            }
            Thermostat::Langevin(_) | Thermostat::VelocityRescaling(_) => CellThermostat::Langevin,
        }
    }
}
