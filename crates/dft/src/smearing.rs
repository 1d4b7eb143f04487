//! Partial occupation of electronic states.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Occupation function of the states near the Fermi level.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Smearing {
    /// f = ½ erfc((ε − μ) / width).
    #[default]
    Gaussian,
    /// f = 1 / (exp((ε − μ) / width) + 1); the width is k_B T.
    FermiDirac,
    /// Methfessel and Paxton, Phys. Rev. B 40, 3616 (1989), first order.
    MethfesselPaxton,
}
