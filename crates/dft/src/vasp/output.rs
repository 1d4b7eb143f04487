//! The data that both of VASP's output files contain.

use atoms::cell::{Matrix3, Vec3};
use atoms::units::GPA_PER_EV_A3;
use atoms::{Species, Structure};

/// A calculation that ran to its end, converged or not, in the order of POSCAR.
#[derive(Clone, Debug)]
pub(super) struct Output {
    /// As VASP writes it: `5.4.4.18Apr17-6-g9f103f2a35`.
    pub version: String,
    /// The calculated structure, of the last step if the atoms moved.
    pub structure: Structure,
    /// Precision of positions in the file, Å.
    pub resolution: f64,
    /// Number of ionic steps.
    pub ionic_steps: u32,
    /// Maximum number of electronic steps (NELM).
    pub most_steps: u32,
    /// Number of electronic steps.
    pub steps: u32,
    /// Free energy, eV.
    pub energy: f64,
    /// Energy extrapolated to zero smearing, eV.
    pub energy_without_smearing: f64,
    /// `[n]`, eV/Å.
    pub forces: Vec<Vec3>,
    /// eV/Å³, tension positive.
    pub stress: Option<Matrix3>,
}

/// Stress from VASP's, which is in kB with compression positive. Symmetrises it; VASP's is symmetric up to
/// rounding.
pub(super) fn stress(kilobar: &Matrix3) -> Matrix3 {
    const KILOBAR: f64 = 0.1 / GPA_PER_EV_A3;
    std::array::from_fn(|i| std::array::from_fn(|k| -KILOBAR * 0.5 * (kilobar[i][k] + kilobar[k][i])))
}

/// The element of a symbol in VASP's spelling; some versions misspell two of them.
pub(super) fn element(symbol: &str) -> Option<Species> {
    match symbol {
        "r" => "Zr",
        "X" => "Xe",
        symbol => symbol,
    }
    .parse()
    .ok()
}
