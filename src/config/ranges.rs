//! The range of each numeric key: a table that docs/configuration.md repeats.
//!
//! A number outside its possible range is an error. A number outside its usual range gives a warning of `validate` and `run`.
//! Defaults need no check.

use toml::de::{DeTable, DeValue};

use super::error::InvalidValue;
use crate::duration::Duration;

/// The range of a key.
pub struct Range {
    /// Dotted key.
    pub key: &'static str,
    /// Unit, or nothing.
    pub unit: &'static str,
    /// Smallest and largest possible value. Whether 0 itself is allowed is decided by the type of the key.
    pub possible: [f64; 2],
    /// Smallest and largest usual value.
    pub usual: [f64; 2],
    /// The probable mistake behind other values.
    pub hint: &'static str,
}

/// A number of a file whose key has a range.
pub struct RangedNumber {
    /// Its range.
    pub range: &'static Range,
    /// Its dotted key in that file.
    pub key: String,
    /// The number.
    pub value: f64,
    /// Offset in the file, bytes.
    pub offset: usize,
}

/// The unit of wall-clock times, which are text with a unit in a file and seconds here.
const TIME: &str = "time";
const DAY: f64 = 86_400.0;
const YEAR: f64 = 365.25 * DAY;

/// Upper limit of numbers of steps; no campaign has more.
const STEPS: f64 = 1e12;

const FEMTOSECONDS: &str = "it is in fs: 1 ps is 1000 fs";
const PER_FEMTOSECOND: &str = "it is in 1/fs: 1/ps is 0.001/fs";
const RELATIVE_VOLUME: &str = "it is V/V₀ and no percentage: +40 % is 1.4";
const RELATIVE_DRIFT: &str = "it is V/V₀ and no percentage: 1 % is 0.01";
const BAR: &str = "it is in bar: 1 GPa is 10000 bar";
const GAIN: &str = "it is the bias as a part of the bulk modulus: 0.005 to 0.1";
const TAU: &str = "it is the bias as a part of the force: 0.15 to 2";
const CUTOFF: &str = "it is in eV: 1 Ry is 13.6 eV, 1 Ha is 27.2 eV";
const K_SPACING: &str = "it is in 1/Å with 2π included: the paper's is 0.125";
const STRESS: &str = "it is in eV/Å³: 1 GPa is 0.00624 eV/Å³";
const PER_ATOM: &str = "give the value per atom, in eV: 1 meV is 0.001";
const SMEARING: &str = "it is in eV: 1 Ry is 13.6 eV, 1000 K are 0.086 eV";
const VACUUM: &str = "it is in Å";
const BOND_FRACTION: &str = "it is a fraction of the bond's length in the seed structure";
const RADII_FRACTION: &str = "it is a multiple of the sum of covalent radii";
const ZBL: &str = "it is a fraction of the sum of covalent radii, and in Å with rule = \"uniform\"";

const fn range(
    key: &'static str,
    unit: &'static str,
    possible: [f64; 2],
    usual: [f64; 2],
    hint: &'static str,
) -> Range {
    Range { key, unit, possible, usual, hint }
}

/// All ranges, by table.
pub static RANGES: [Range; 133] = [
    range("walk.temperature", "K", [0.0, 1e6], [10.0, 1e4], ""),
    range("walk.biased_steps", "", [0.0, STEPS], [10.0, 1e7], ""),
    range("walk.equilibration_steps", "", [0.0, STEPS], [0.0, 1e6], ""),
    range("walk.tau", "", [0.0, 1e3], [0.01, 5.0], TAU),
    range("walk.time_step", "fs", [0.0, 20.0], [0.1, 5.0], FEMTOSECONDS),
    range("walk.thermostat.langevin.friction", "1/fs", [0.0, 100.0], [1e-4, 0.2], PER_FEMTOSECOND),
    range("walk.thermostat.nose_hoover.relaxation_time", "fs", [0.0, 1e6], [10.0, 5e3], FEMTOSECONDS),
    range("walk.thermostat.velocity_rescaling.relaxation_time", "fs", [0.0, 1e6], [10.0, 5e3], FEMTOSECONDS),
    range("walk.thermostat.nose_hoover.chain_length", "", [1.0, 100.0], [1.0, 10.0], ""),
    range("walk.volume_ramp.from", "V/V₀", [0.05, 20.0], [0.4, 3.0], RELATIVE_VOLUME),
    range("walk.volume_ramp.to", "V/V₀", [0.05, 20.0], [0.4, 3.0], RELATIVE_VOLUME),
    range("walk.barostat.pressure", "bar", [-1e7, 1e7], [-1e5, 1e6], BAR),
    range("walk.barostat.relaxation_time", "fs", [0.0, 1e6], [100.0, 1e4], FEMTOSECONDS),
    range("walk.reference_steps", "", [0.0, STEPS], [0.0, 1e6], ""),
    range("walk.start_volume", "V/V₀", [0.25, 4.0], [0.4, 3.0], RELATIVE_VOLUME),
    range("walk.cell_bias.stress_scale", "GPa", [0.0, 1e5], [0.1, 1e3], "it is in GPa: 1 eV/Å³ is 160 GPa"),
    range("walk.cell_bias.gain", "", [0.0, 10.0], [1e-4, 0.5], GAIN),
    range("walk.cell_bias.window", "", [2.0, STEPS], [100.0, 1e5], ""),
    range("walk.cell_bias.min_drift", "V/V₀", [0.0, 10.0], [1e-4, 0.2], RELATIVE_DRIFT),
    range("walk.cell_bias.max_drift", "V/V₀", [0.0, 10.0], [1e-3, 0.5], RELATIVE_DRIFT),
    range("walk.cell_bias.end_after_collected", "", [0.0, 1e9], [0.0, 1e4], ""),
    range("walk.cell_bias.end_after_contacts", "", [1.0, 1e9], [1.0, 1e3], ""),
    range("walk.bias_averaging_steps", "", [0.0, STEPS], [1.0, 1e3], ""),
    range("walk.bias_norm_interval", "", [0.0, STEPS], [1.0, 10.0], ""),
    range("walk.trace_interval", "", [0.0, STEPS], [0.0, 1e5], ""),
    range("walk.trajectory_interval", "", [0.0, STEPS], [0.0, 1e5], ""),
    range("walk.skin", "Å", [0.0, 10.0], [0.05, 3.0], ""),
    range("calm.max_mean_square_growth", "", [1.0, 1e6], [1.5, 100.0], ""),
    range("seed_structures.min_atoms", "", [0.0, 1e5], [2.0, 1e3], ""),
    range("seed_structures.min_height", "Å", [0.0, 1e3], [2.0, 50.0], "it is in Å"),
    range("collect.criterion.threshold", "", [0.0, 1e12], [0.5, 1e3], ""),
    range("collect.criterion.min_atoms", "", [0.0, 1e9], [1.0, 1e3], ""),
    range("collect.update_target.threshold", "", [0.0, 1e12], [0.5, 1e3], ""),
    range("collect.update_target.target", "", [0.0, 1e12], [0.3, 1e3], ""),
    range("collect.update_target.min_atoms", "", [0.0, 1e9], [1.0, 1e3], ""),
    range("collect.min_interval", "", [0.0, STEPS], [0.0, 1e5], ""),
    range("collect.min_interval_after_decline", "", [0.0, STEPS], [1.0, 1e5], ""),
    range("collect.max_per_seed_structure", "", [0.0, 1e9], [1.0, 1e5], ""),
    range("collect.max_per_walk", "", [0.0, 1e9], [1.0, 1e4], ""),
    range("collect.max_structures", "", [0.0, 1e9], [1.0, 1e7], ""),
    range("collect.declined_features_mb", "MB", [0.0, 1e9], [0.0, 1e6], "it is in MB"),
    range("guard.min_distances.min_distance", "Å", [0.01, 10.0], [0.3, 4.0], "it is in Å"),
    range("guard.min_distances.fraction", "", [0.01, 1.0], [0.2, 0.95], ""),
    range("guard.min_distances.bonded", "", [0.01, 1.0], [0.5, 0.95], BOND_FRACTION),
    range("guard.min_distances.nonbonded", "", [0.01, 2.0], [0.4, 1.0], RADII_FRACTION),
    range("guard.min_distances.bond_cutoff", "", [0.5, 5.0], [1.1, 1.6], RADII_FRACTION),
    range("guard.zbl.inner", "", [0.0, 20.0], [0.1, 4.0], ZBL),
    range("guard.zbl.outer", "", [0.0, 20.0], [0.2, 5.0], ZBL),
    range("guard.wall.margin", "Å", [0.0, 1e3], [0.5, 50.0], "it is in Å"),
    range("guard.wall.stiffness", "eV/Å²", [0.0, 1e4], [0.01, 100.0], ""),
    range("guard.max_grade", "", [0.0, 1e12], [2.0, 1e4], ""),
    range("guard.max_temperature", "K", [0.0, 1e9], [300.0, 1e6], ""),
    range("guard.max_consecutive_rejections", "", [0.0, 1e9], [1.0, 1e3], ""),
    range("guard.max_rollbacks", "", [0.0, 1e9], [0.0, 100.0], ""),
    range("guard.checkpoint_interval", "", [0.0, STEPS], [1.0, 1e5], ""),
    range("label.concurrency", "", [0.0, 1024.0], [0.0, 256.0], ""),
    range("label.lease_timeout", TIME, [1.0, 86_400.0], [10.0, 86_400.0], ""),
    range("label.max_attempts", "", [0.0, 1e9], [1.0, 20.0], ""),
    range("label.max_force", "eV/Å", [0.0, 1e9], [5.0, 1e5], ""),
    range("label.max_stress", "eV/Å³", [0.0, 1e9], [0.01, 1e3], STRESS),
    range("label.max_energy_per_atom", "eV", [0.0, 1e12], [10.0, 1e7], "give the value per atom, in eV"),
    range(
        "label.max_energy_difference_per_atom",
        "eV",
        [0.0, 1e12],
        [0.1, 1e4],
        "give the value per atom, in eV",
    ),
    range("label.min_state_difference", "eV/atom", [0.0, 1e3], [1e-5, 0.1], PER_ATOM),
    range("label.cores", "", [0.0, 4096.0], [1.0, 2048.0], ""),
    range("label.gpus", "", [0.0, 1024.0], [0.0, 64.0], ""),
    range("label.time_limit", TIME, [1.0, 30.0 * DAY], [10.0, 7.0 * DAY], ""),
    range("label.memory", "GB", [0.0, 1e6], [0.1, 1e4], "it is in GB"),
    range("label.queue_limit", "", [0.0, 1e9], [1.0, 1e6], ""),
    range("label.guard.min_height", "Å", [0.0, 1e3], [1.0, 50.0], "it is in Å"),
    range("label.guard.max_edge_ratio", "", [0.0, 1e6], [1.0, 100.0], ""),
    range("label.guard.min_volume_per_atom", "Å³", [0.0, 1e3], [1.0, 50.0], "give the value per atom, in Å³"),
    range("label.guard.max_volume_per_atom", "Å³", [0.0, 1e6], [5.0, 1e3], "give the value per atom, in Å³"),
    range("label.guard.max_atoms", "", [0.0, 1e9], [1.0, 1e5], ""),
    range("label.reference_check.max_energy_difference", "eV/atom", [0.0, 1e3], [1e-4, 0.1], PER_ATOM),
    range("label.reference_check.max_force_difference", "eV/Å", [0.0, 1e3], [1e-3, 0.5], ""),
    range("label.reference_check.max_stress_difference", "eV/Å³", [0.0, 1e3], [1e-4, 0.1], STRESS),
    range("label.method.abinit.cutoff", "eV", [20.0, 1e5], [100.0, 1e4], CUTOFF),
    range("label.method.abinit.fine_cutoff", "eV", [20.0, 1e6], [100.0, 5e4], CUTOFF),
    range("label.method.abinit.k_spacing", "1/Å", [0.005, 5.0], [0.03, 1.5], K_SPACING),
    range("label.method.abinit.smearing_width", "eV", [0.0, 20.0], [1e-3, 1.0], SMEARING),
    range("label.method.abinit.energy_tolerance", "eV", [0.0, 10.0], [1e-12, 1e-2], ""),
    range("label.method.abinit.max_scf_steps", "", [0.0, 1e6], [10.0, 1e3], ""),
    range("label.method.abinit.vacuum", "Å", [0.0, 1e3], [3.0, 30.0], VACUUM),
    range("label.method.espresso.cutoff", "eV", [20.0, 1e5], [100.0, 5e3], CUTOFF),
    range("label.method.espresso.density_cutoff", "eV", [80.0, 1e6], [400.0, 5e4], CUTOFF),
    range("label.method.espresso.k_spacing", "1/Å", [0.005, 5.0], [0.03, 1.5], K_SPACING),
    range("label.method.espresso.smearing_width", "eV", [0.0, 20.0], [1e-3, 1.0], SMEARING),
    range("label.method.espresso.energy_tolerance", "eV", [0.0, 10.0], [1e-12, 1e-2], ""),
    range("label.method.espresso.max_scf_steps", "", [0.0, 1e6], [10.0, 1e3], ""),
    range("label.method.espresso.vacuum", "Å", [0.0, 1e3], [3.0, 30.0], VACUUM),
    range("label.method.gpaw.cutoff", "eV", [20.0, 1e5], [100.0, 2e3], CUTOFF),
    range("label.method.gpaw.k_spacing", "1/Å", [0.005, 5.0], [0.03, 1.5], K_SPACING),
    range("label.method.gpaw.smearing_width", "eV", [0.0, 20.0], [1e-3, 1.0], SMEARING),
    range("label.method.gpaw.energy_tolerance", "eV", [0.0, 10.0], [1e-12, 1e-2], ""),
    range("label.method.gpaw.force_tolerance", "eV/Å", [0.0, 10.0], [1e-8, 0.1], ""),
    range("label.method.gpaw.max_scf_steps", "", [0.0, 1e6], [10.0, 1e3], ""),
    range("label.method.gpaw.vacuum", "Å", [0.0, 1e3], [3.0, 30.0], VACUUM),
    range("label.method.vasp.cutoff", "eV", [20.0, 1e5], [100.0, 2e3], CUTOFF),
    range("label.method.vasp.k_spacing", "1/Å", [0.005, 5.0], [0.03, 1.5], K_SPACING),
    range("label.method.vasp.smearing_width", "eV", [0.0, 20.0], [1e-3, 1.0], SMEARING),
    range("label.method.vasp.energy_tolerance", "eV", [0.0, 10.0], [1e-12, 1e-2], ""),
    range("label.method.vasp.max_scf_steps", "", [0.0, 1e6], [10.0, 1e3], ""),
    range("label.method.vasp.vacuum", "Å", [0.0, 1e3], [3.0, 30.0], VACUUM),
    range("label.method.cp2k.cutoff", "eV", [200.0, 1e6], [1e3, 5e4], CUTOFF),
    range("label.method.cp2k.relative_cutoff", "eV", [50.0, 1e5], [200.0, 5e3], CUTOFF),
    range("label.method.cp2k.k_spacing", "1/Å", [0.005, 5.0], [0.03, 1.5], K_SPACING),
    range("label.method.cp2k.smearing_width", "eV", [0.0, 20.0], [1e-3, 1.0], SMEARING),
    range("label.method.cp2k.vacuum", "Å", [0.0, 1e3], [3.0, 30.0], VACUUM),
    range("refit.replay_weight", "", [0.0, 1e6], [1e-4, 100.0], ""),
    range("refit.after_structures", "", [0.0, 1e9], [1.0, 1e5], ""),
    range("refit.after_time", TIME, [0.1, YEAR], [60.0, 30.0 * DAY], ""),
    range("refit.max_versions", "", [0.0, 1e4], [1.0, 100.0], ""),
    range("refit.max_replay_error_ratio", "", [0.0, 1e6], [0.5, 20.0], ""),
    range("refit.max_held_out_error_ratio", "", [0.0, 1e6], [0.5, 5.0], ""),
    range("refit.max_attempts", "", [0.0, 1e9], [1.0, 20.0], ""),
    range("refit.threads", "", [0.0, 1024.0], [0.0, 512.0], ""),
    range("refit.method.native.epochs", "", [0.0, 1e9], [1.0, 1e4], ""),
    range("refit.method.native.batch_size", "", [0.0, 1e6], [1.0, 256.0], ""),
    range("refit.method.native.learning_rate", "", [0.0, 1.0], [1e-6, 0.1], ""),
    range("refit.method.native.huber_delta", "", [0.0, 1e3], [1e-4, 1.0], ""),
    range("refit.method.native.patience", "", [0.0, 1e9], [1.0, 1e3], ""),
    range("refit.method.command.time_limit", TIME, [1.0, YEAR], [60.0, 30.0 * DAY], ""),
    range("budget.wall_time", TIME, [0.001, 10.0 * YEAR], [60.0, YEAR], ""),
    range("stop.max_steps_without_structure", "", [0.0, STEPS], [1e3, 1e9], ""),
    range("stop.min_improvement", "", [0.0, 100.0], [1e-3, 0.5], "it is a fraction: 5 % is 0.05"),
    range("run.walkers", "", [0.0, 1024.0], [0.0, 512.0], ""),
    range("run.threads_per_walker", "", [0.0, 256.0], [1.0, 128.0], ""),
    range("run.heartbeat_timeout", TIME, [5.0, 10.0 * DAY], [10.0, DAY], ""),
    range("run.agent_heartbeat_timeout", TIME, [0.1, 10.0 * DAY], [10.0, DAY], ""),
    range("run.max_restarts", "", [0.0, 1e9], [0.0, 100.0], ""),
    range("run.steps_per_assignment", "", [0.0, STEPS], [1.0, 1e5], ""),
    range("notify.stall_timeout", TIME, [0.1, 30.0 * DAY], [60.0, 14.0 * DAY], ""),
    range("notify.time_limit", TIME, [1.0, DAY], [1.0, 3600.0], ""),
];

impl Range {
    /// Whether the value is in the possible range.
    pub fn is_possible(&self, value: f64) -> bool {
        (self.possible[0]..=self.possible[1]).contains(&value)
    }

    /// Whether the value is in the usual range.
    pub fn is_usual(&self, value: f64) -> bool {
        (self.usual[0]..=self.usual[1]).contains(&value)
    }

    /// The possible range in words, with the hint.
    pub fn expected(&self) -> String {
        match self.hint {
            "" => self.possible_in_words(),
            hint => format!("{}: {hint}", self.possible_in_words()),
        }
    }

    /// The usual range in words, and the possible one of times, for the description in the schema.
    pub fn note(&self) -> String {
        let usual = format!("Usual: {}.", self.usual_in_words());
        if self.unit == TIME { format!("Possible: {}. {usual}", self.possible_in_words()) } else { usual }
    }

    fn possible_in_words(&self) -> String {
        let [least, most] = self.possible.map(|bound| self.shown(bound));
        let bounds =
            if self.possible[0] != 0.0 { format!("{least} to {most}") } else { format!("at most {most}") };
        self.with_unit(bounds)
    }

    fn usual_in_words(&self) -> String {
        let [least, most] = self.usual.map(|bound| self.shown(bound));
        self.with_unit(format!("{least} to {most}"))
    }

    /// The warning about an unusual value.
    pub fn unusual(&self, value: f64) -> String {
        let value = self.with_unit(self.shown(value));
        let hint = if self.hint.is_empty() { String::new() } else { format!("; {}", self.hint) };
        format!("{value} is unusual ({} is usual){hint}", self.usual_in_words())
    }

    /// A value in readable form, without unit; times include theirs.
    pub fn shown(&self, value: f64) -> String {
        match self.unit {
            TIME => Duration::from_fractional_seconds(value).to_string(),
            _ => shown(value),
        }
    }

    /// A value in the form of a configuration.
    pub fn written(&self, value: f64) -> String {
        if self.unit == TIME { self.shown(value) } else { value.to_string() }
    }

    fn with_unit(&self, number: String) -> String {
        if ["", TIME].contains(&self.unit) { number } else { format!("{number} {}", self.unit) }
    }
}

/// A number in readable form.
fn shown(x: f64) -> String {
    if x != 0.0 && !(1e-3..1e5).contains(&x.abs()) { format!("{x:e}") } else { x.to_string() }
}

/// The numbers of a file whose keys have ranges. `walk` is the table that has the keys of `[walk]`.
pub fn numbers_with_ranges(table: &DeTable<'_>, walk: &str) -> Vec<RangedNumber> {
    let find = |range: &'static Range| {
        let key = match range.key.strip_prefix("walk.") {
            // `calmwalk md` has no bias: its key is `steps`.
            Some("biased_steps") if walk != "walk" => format!("{walk}.steps"),
            Some(rest) => format!("{walk}.{rest}"),
            None => range.key.to_owned(),
        };
        let (value, offset) = number(table, &key)?;
        Some(RangedNumber { range, key, value, offset })
    };
    RANGES.iter().filter_map(find).collect()
}

/// What was found and what is expected, if `value` is outside the possible range of the key.
pub fn expected_instead(key: &str, value: f64) -> Option<(String, String)> {
    let range = RANGES.iter().find(|range| range.key == key)?;
    (!range.is_possible(value)).then(|| (range.written(value), range.expected()))
}

/// The usual range of a key in words, with its unit. `None`: the key has none.
pub fn usual_range(key: &str) -> Option<String> {
    RANGES.iter().find(|range| range.key == key).map(Range::usual_in_words)
}

/// The numbers of a text that are outside their possible ranges.
pub fn impossible(text: &str) -> Vec<InvalidValue> {
    let (table, _) = DeTable::parse_recoverable(text);
    let wrong = numbers_with_ranges(table.get_ref(), "walk")
        .into_iter()
        .filter(|found| !found.range.is_possible(found.value));
    wrong.map(|found| (found.key, found.range.written(found.value), found.range.expected())).collect()
}

/// The number at a dotted key, and its offset in the file.
fn number(table: &DeTable<'_>, key: &str) -> Option<(f64, usize)> {
    let (name, rest) = key.split_once('.').unwrap_or((key, ""));
    let value = table.get(name)?;
    let number = match value.get_ref() {
        DeValue::Table(inner) if !rest.is_empty() => return number(inner, rest),
        _ if !rest.is_empty() => return None,
        DeValue::String(text) => text.parse::<Duration>().ok()?.seconds(),
        DeValue::Float(float) => float.as_str().replace('_', "").parse().ok()?,
        DeValue::Integer(integer) => {
            i128::from_str_radix(&integer.as_str().replace('_', ""), integer.radix()).ok()? as f64
        }
        _ => return None,
    };
    Some((number, value.span().start))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_usual_is_possible() {
        for Range { key, possible, usual, .. } in &RANGES {
            assert!(possible[0] <= usual[0] && usual[0] < usual[1] && usual[1] <= possible[1], "{key}");
        }
    }

    #[test]
    fn numbers_are_found_by_their_keys() {
        let text =
            "[walk]\ntau = 1_5\n[walk.thermostat]\nlangevin = { friction = 1e1 }\n[run]\nwalkers = 0x10\n";
        let (table, _) = DeTable::parse_recoverable(text);
        let found: Vec<_> = numbers_with_ranges(table.get_ref(), "walk")
            .into_iter()
            .map(|found| (found.range.key, found.value))
            .collect();
        let expected =
            [("walk.tau", 15.0), ("walk.thermostat.langevin.friction", 10.0), ("run.walkers", 16.0)];
        assert_eq!(found, expected);
        let friction = &RANGES[5];
        assert_eq!(
            friction.unusual(10.0),
            "10 1/fs is unusual (1e-4 to 0.2 1/fs is usual); it is in 1/fs: 1/ps is 0.001/fs"
        );
        assert_eq!(friction.expected(), "at most 100 1/fs: it is in 1/fs: 1/ps is 0.001/fs");
    }
}
