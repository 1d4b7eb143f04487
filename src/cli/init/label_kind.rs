//! What makes the labels of a campaign of one's own.

use clap::ValueEnum;

/// What makes labels.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum InitLabelKind {
    /// ABINIT
    Abinit,
    /// Any ASE calculator
    Ase,
    /// A program of your own
    Command,
    /// CP2K
    Cp2k,
    /// Quantum ESPRESSO
    Espresso,
    /// GPAW
    Gpaw,
    /// A potential that calmwalk evaluates, such as another GRACE model
    Potential,
    /// VASP
    Vasp,
}

impl InitLabelKind {
    /// All names, for questions.
    pub fn names() -> String {
        let names = Self::value_variants().iter().map(|kind| kind.name());
        names.collect::<Vec<_>>().join(", ")
    }

    /// Its name in a configuration.
    pub fn name(self) -> &'static str {
        match self {
            Self::Abinit => "abinit",
            Self::Ase => "ase",
            Self::Command => "command",
            Self::Cp2k => "cp2k",
            Self::Espresso => "espresso",
            Self::Gpaw => "gpaw",
            Self::Potential => "potential",
            Self::Vasp => "vasp",
        }
    }

    /// What the labels come from.
    pub fn source(self) -> &'static str {
        match self {
            Self::Abinit => "directory of pseudopotentials, such as Si.psp8",
            Self::Ase => "Python file that defines calculator()",
            Self::Command => "script that reads structure.extxyz and writes label.extxyz",
            Self::Cp2k => "directory with BASIS_MOLOPT and GTH_POTENTIALS",
            Self::Espresso => "directory of pseudopotentials, such as Si.UPF",
            Self::Gpaw => "directory of PAW setups",
            Self::Potential => "file of a potential (.npz, .eam.alloy, .eam.fs, .sw)",
            Self::Vasp => "directory of POTCAR files, such as Al_pv/POTCAR",
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_kind_has_the_name_of_its_method() {
        for kind in InitLabelKind::value_variants() {
            let possible = kind.to_possible_value().unwrap();
            assert_eq!(possible.get_name(), kind.name());
            let is_method = dft::DftSettings::NAMES.contains(&kind.name());
            assert!(is_method || *kind == InitLabelKind::Potential, "{kind:?}");
        }
    }
}
