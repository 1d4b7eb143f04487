//! What both of VASP's output files tell.

use atoms::cell::{Matrix3, Vec3};
use atoms::units::GPA_PER_EV_A3;
use atoms::{Species, Structure};

/// A calculation that came to its end, converged or not, in the order of POSCAR.
#[derive(Clone, Debug)]
pub(super) struct Output {
    /// As VASP writes it: `5.4.4.18Apr17-6-g9f103f2a35`.
    pub version: String,
    /// What was calculated, in the last step if the atoms moved.
    pub structure: Structure,
    /// How far the digits of the file let an atom appear from where it is, Å.
    pub resolution: f64,
    /// Times that the atoms moved, and one.
    pub ionic_steps: u32,
    /// Most electronic steps allowed (NELM).
    pub most_steps: u32,
    /// Electronic steps, the last included.
    pub steps: u32,
    /// Free energy, eV.
    pub energy: f64,
    /// Extrapolated to no smearing, eV.
    pub energy_without_smearing: f64,
    /// [n], eV/Å
    pub forces: Vec<Vec3>,
    /// eV/Å³, tension positive.
    pub stress: Option<Matrix3>,
}

/// Stress from VASP's, which is in kB and positive for compression; symmetric, which VASP's is but for rounding.
pub(super) fn stress(kilobar: &Matrix3) -> Matrix3 {
    const KILOBAR: f64 = 0.1 / GPA_PER_EV_A3;
    std::array::from_fn(|i| std::array::from_fn(|k| -KILOBAR * 0.5 * (kilobar[i][k] + kilobar[k][i])))
}

/// The element of a symbol as VASP writes it: some versions spoil two of them.
pub(super) fn element(symbol: &str) -> Option<Species> {
    match symbol {
        "r" => "Zr",
        "X" => "Xe",
        symbol => symbol,
    }
    .parse()
    .ok()
}
