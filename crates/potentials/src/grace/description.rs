//! What a model is: its architecture and sizes.

use atoms::Species;

/// The number of message-passing layers.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Architecture {
    /// GRACE-1L
    OneLayer,
    /// GRACE-2L
    TwoLayer,
    /// GRACE-3L
    ThreeLayer,
}

impl Architecture {
    /// The number of layers.
    pub fn layers(self) -> usize {
        match self {
            Self::OneLayer => 1,
            Self::TwoLayer => 2,
            Self::ThreeLayer => 3,
        }
    }

    /// The number of layers in words.
    pub(super) fn number_of_layers(self) -> &'static str {
        match self {
            Self::OneLayer => "one",
            Self::TwoLayer => "two",
            Self::ThreeLayer => "three",
        }
    }
}

impl std::fmt::Display for Architecture {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.pad(match self {
            Self::OneLayer => "GRACE-1L",
            Self::TwoLayer => "GRACE-2L",
            Self::ThreeLayer => "GRACE-3L",
        })
    }
}

/// A summary of a model.
#[derive(Clone, Debug, PartialEq)]
pub struct GraceDescription {
    /// Number of layers.
    pub architecture: Architecture,
    /// Symbols, in the order of element indices.
    pub elements: Vec<Species>,
    /// The largest cutoff, Å. Information travels as many cutoffs as there are layers.
    pub cutoff: f64,
    /// Whether cutoffs depend on the pair of elements.
    pub pair_cutoffs: bool,
    /// The highest order l of the spherical harmonics.
    pub lmax: usize,
    /// Number of Chebyshev polynomials.
    pub radial_basis_size: usize,
    /// Radial channels of the first layer.
    pub channels: usize,
    /// The tensors in the energy, layer by layer: A, AA, AAA, AAAA.
    pub basis_functions: Vec<String>,
    /// D_basis, the number of invariants.
    pub basis_dimension: usize,
    /// D, the dimension of z; 0 without a projection.
    pub feature_dimension: usize,
    /// Number of weights that can be trained, the elements' shifts included.
    pub weights: usize,
    /// Tables of radial functions: number of intervals, and the measured relative errors of values and
    /// derivatives; empty on the exact path.
    pub radial_tables: Vec<(usize, [f64; 2])>,
}
