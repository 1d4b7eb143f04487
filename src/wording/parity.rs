//! Names and units of the quantities that labels and the potential have in common.

use atoms::units::GPA_PER_EV_A3;

/// How a quantity is shown. Values in its unit are those of the store times a factor.
#[derive(Clone, Copy, Debug)]
pub struct ParityQuantity {
    /// Its name.
    pub name: &'static str,
    /// A short name, for axes.
    pub short: &'static str,
    /// Unit of values.
    pub figure_unit: &'static str,
    /// Factor of values.
    pub value_factor: f64,
    /// Unit of errors.
    pub error_unit: &'static str,
    /// Factor of errors.
    pub error_factor: f64,
    /// Decimals of errors.
    pub digits: usize,
    /// What is counted.
    pub counted: &'static str,
}

/// Energy per atom.
pub const ENERGY: ParityQuantity = ParityQuantity {
    name: "energy",
    short: "E",
    figure_unit: "eV per atom",
    value_factor: 1.0,
    error_unit: "meV per atom",
    error_factor: 1000.0,
    digits: 2,
    counted: "structures",
};

/// Components of forces.
pub const FORCE: ParityQuantity = ParityQuantity {
    name: "force",
    short: "F",
    figure_unit: "eV Å^{−1}",
    value_factor: 1.0,
    error_unit: "eV/Å",
    error_factor: 1.0,
    digits: 4,
    counted: "components",
};

/// Components of the stress.
pub const STRESS: ParityQuantity = ParityQuantity {
    name: "stress",
    short: "stress",
    figure_unit: "GPa",
    value_factor: GPA_PER_EV_A3,
    error_unit: "GPa",
    error_factor: GPA_PER_EV_A3,
    digits: 3,
    counted: "components",
};
