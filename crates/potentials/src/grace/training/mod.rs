//! Derivatives of a loss of energies, forces and stresses with respect to the weights.
//!
//! Let L depend on the energy E, the forces F_a = −∂E/∂r_a and the virial W = −∂E/∂ε of a structure. With its derivatives
//! Ē, F̄_a and W̄ at the current weights w,
//!
//! ∂L/∂w = ∂/∂w \[Ē E − D E\],
//!
//! where D is the derivative along the direction in which atoms move by F̄_a and the structure is strained by W̄: a bond d
//! from a to b changes by F̄_b − F̄_a + W̄ d. The passes here carry D beside each value (forward) and the cotangents of both
//! back (forward over reverse). Together with the evaluation that gives E, F and W they cost
//! three to five times as much as it (`cargo bench -p potentials --bench grace -- training`).
//!
//! R_nl(r) depends on the coefficients of its table. The network behind them is evaluated at the knots of the table once
//! an update, and the coefficients' derivatives are pulled back through it once.

mod dual_bonds;
mod dual_passes;
mod dual_readout;
mod knot_traces;
mod moving_bonds;
mod sums;
mod trainable;
mod worker;

pub use moving_bonds::LossGradient;
pub use sums::WeightSums;
pub use trainable::{TrainableGrace, WeightGroup};
pub use worker::GradientWorker;
