//! Checks that time and memory grow linearly with the number of atoms.

use potentials::grace::Precision;

use crate::case::{Case, Model};
use crate::{measure, quantiles};

/// Cells along an edge of the crystals, four atoms in a cell: 108 to 19 652 atoms.
const EDGES: [usize; 5] = [3, 5, 8, 12, 17];

/// Time and memory per atom of growing crystals. Memory is the resident size after the calls: the model with
/// its mixture, the structure, its neighbour list and all scratch arrays, which are reused between calls.
pub fn report(model: &Model) {
    println!("\n{}, growing crystals", model.name);
    for edge in EDGES {
        let before = resident_kilobytes();
        let mut case = Case::new(model, edge, Precision::Double);
        let found = measure(&mut case, |_| None);
        let atoms = case.structure.len() as f64;
        let [plain, graded] =
            [found.plain, found.graded].map(|times| quantiles(&times).map(|t| 1e3 * t / atoms));
        println!(
            "  {atoms} atoms: {:.4} ms an atom ({:.4} to {:.4}), with γ and ∇Σγ {:.4} ({:.4} to {:.4}); {:.1} MB",
            plain[1],
            plain[0],
            plain[2],
            graded[1],
            graded[0],
            graded[2],
            1e-3 * (resident_kilobytes() - before)
        );
    }
}

/// Resident memory of this process, kB; NaN if unavailable.
fn resident_kilobytes() -> f64 {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let line = status.lines().find_map(|line| line.strip_prefix("VmRSS:"));
    line.and_then(|line| line.split_whitespace().next()?.parse().ok()).unwrap_or(f64::NAN)
}
