//! Energy, forces and stress under the names that other programs use.

use super::{Column, ExtxyzValue, Frame};
use crate::cell::{Matrix3, Vec3};

/// The labels of a frame: the results of a calculation, usually DFT.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct FrameLabels {
    /// Total energy, eV.
    pub energy: Option<f64>,
    /// `[n]`, eV/Å.
    pub forces: Option<Vec<Vec3>>,
    /// eV/Å³, tension positive, symmetric.
    pub stress: Option<Matrix3>,
}

/// The naming convention for labels in a file.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum LabelKeys {
    /// `energy`, `forces`, `stress`: ASE reads them as calculator results.
    Ase,
    /// `REF_energy`, `REF_forces`, `REF_stress` (9 numbers): MACE's default keys for training.
    Mace,
    /// As [`LabelKeys::Ase`], plus the same energy as `free_energy`: gracemaker reads through ASE and prefers
    /// the free energy. If one frame of a file lacks the stress, gracemaker ignores all stresses of the file.
    Grace,
    /// `energy`, `force`, `virial` (eV, 9 numbers; −volume × stress): the default keys of QUIP's `gap_fit`.
    Gap,
}

/// An invalid label.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[error("the frame at line {line}: {key} is {found}, expected {expected}")]
pub struct LabelError {
    /// Where the frame starts.
    pub line: usize,
    /// The key or column.
    pub key: String,
    /// Its value.
    pub found: String,
    /// The valid values.
    pub expected: &'static str,
}

impl Frame {
    /// The labels of the frame.
    ///
    /// If the frame has any of `REF_energy`, `REF_free_energy`, `REF_forces`, `REF_stress` and `REF_virial`,
    /// only these are used (the plain ones may be a model's); otherwise the same names without `REF_`. `energy`
    /// takes precedence over `free_energy`, as in ASE; `stress` over `virial` (eV), with stress = −virial /
    /// volume; and `forces` over `force`, which QUIP writes. Of an asymmetric stress the upper triangle is
    /// used, as in ASE.
    pub fn labels(&self) -> Result<FrameLabels, LabelError> {
        let (energy, prefix) = (self.energy_label()?, self.label_prefix());
        let stress = match self.label(prefix, "stress", Self::matrix)? {
            None => self.label(prefix, "virial", Self::stress_from_virial)?,
            stress => stress,
        };
        Ok(FrameLabels { energy, forces: self.force_labels()?, stress })
    }

    /// The energy of [`Self::labels`], whatever the others are.
    pub fn energy_label(&self) -> Result<Option<f64>, LabelError> {
        let prefix = self.label_prefix();
        match self.label(prefix, "energy", Self::energy)? {
            None => self.label(prefix, "free_energy", Self::energy),
            energy => Ok(energy),
        }
    }

    /// The forces of [`Self::labels`], whatever the others are.
    pub fn force_labels(&self) -> Result<Option<Vec<Vec3>>, LabelError> {
        let prefix = self.label_prefix();
        match self.forces(&format!("{prefix}forces"))? {
            None => self.forces(&format!("{prefix}force")),
            forces => Ok(forces),
        }
    }

    /// What precedes the names of the labels that are used.
    fn label_prefix(&self) -> &'static str {
        let reference = QUANTITIES.map(|quantity| format!("REF_{quantity}"));
        let given = |key: &String| self.info.contains_key(key) || self.arrays.contains_key(key);
        if reference.iter().any(given) { "REF_" } else { "" }
    }

    /// Replaces all labels of the frame, under any names.
    pub fn set_labels(&mut self, labels: &FrameLabels, keys: LabelKeys) {
        for quantity in QUANTITIES {
            for key in [quantity.to_owned(), format!("REF_{quantity}")] {
                self.info.remove(&key);
                self.arrays.remove(&key);
            }
        }
        let prefix = if keys == LabelKeys::Mace { "REF_" } else { "" };
        if let Some(energy) = labels.energy {
            self.info.insert(format!("{prefix}energy"), energy.into());
            if keys == LabelKeys::Grace {
                self.info.insert("free_energy".to_owned(), energy.into());
            }
        }
        if let Some(forces) = &labels.forces {
            let key = if keys == LabelKeys::Gap { "force".to_owned() } else { format!("{prefix}forces") };
            self.arrays.insert(key, Column::vectors(forces));
        }
        if let (Some(stress), LabelKeys::Gap) = (labels.stress, keys) {
            let volume = self.structure.cell.volume();
            let virial = stress.concat().into_iter().map(|s| -s * volume);
            self.info.insert("virial".to_owned(), virial.collect::<Vec<_>>().into());
        } else if let Some(stress) = labels.stress {
            let value = if keys == LabelKeys::Mace { stress.concat().into() } else { stress.into() };
            self.info.insert(format!("{prefix}stress"), value);
        }
    }

    fn label<T>(
        &self,
        prefix: &str,
        quantity: &str,
        read: fn(&Self, &ExtxyzValue) -> Result<T, &'static str>,
    ) -> Result<Option<T>, LabelError> {
        let key = format!("{prefix}{quantity}");
        let read = |value| {
            read(self, value).map_err(|expected| self.label_error(&key, format!("'{value}'"), expected))
        };
        self.info.get(&key).map(read).transpose()
    }

    fn energy(&self, value: &ExtxyzValue) -> Result<f64, &'static str> {
        value.number().filter(|energy| energy.is_finite()).ok_or("a finite number")
    }

    fn matrix(&self, value: &ExtxyzValue) -> Result<Matrix3, &'static str> {
        let numbers = value.numbers().filter(|numbers| numbers.iter().all(|x| x.is_finite()));
        match numbers.as_deref() {
            Some(&[xx, xy, xz, _, yy, yz, _, _, zz]) | Some(&[xx, yy, zz, yz, xz, xy]) => {
                Ok([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
            }
            _ => Err("9 finite numbers (or 6)"),
        }
    }

    fn stress_from_virial(&self, value: &ExtxyzValue) -> Result<Matrix3, &'static str> {
        let volume = self.structure.cell.volume();
        if volume == 0.0 {
            return Err("none without a cell that has a volume");
        }
        self.matrix(value).map(|virial| virial.map(|row| row.map(|w| -w / volume)))
    }

    fn forces(&self, key: &str) -> Result<Option<Vec<Vec3>>, LabelError> {
        let Some(column) = self.arrays.get(key) else { return Ok(None) };
        let numbers = column.reals().filter(|_| column.width == 3);
        let numbers = numbers.filter(|numbers| numbers.len() == 3 * self.structure.len());
        let Some(numbers) = numbers else {
            let found = format!("a column of width {}", column.width);
            return Err(self.label_error(key, found, "three numbers for each atom"));
        };
        if let Some(index) = numbers.iter().position(|force| !force.is_finite()) {
            return Err(self.label_error(key, format!("not finite at atom {}", index / 3), "finite numbers"));
        }
        Ok(Some(numbers.as_chunks().0.to_vec()))
    }

    fn label_error(&self, key: &str, found: String, expected: &'static str) -> LabelError {
        LabelError { line: self.line, key: key.to_owned(), found, expected }
    }
}

const QUANTITIES: [&str; 6] = ["energy", "free_energy", "forces", "force", "stress", "virial"];
