//! One message-passing layer: the sum over neighbours and the operations on it.

use super::element_factors::ElementFactors;
use super::graph::Graph;
use super::harmonics::Harmonics;
use super::radial::RadialFunctions;
use super::readout::ReadoutBlock;
use super::tape::Tensor;
use super::tape_program::TapeProgram;
use super::vector::Vector;

/// The weights of one layer: T_q,lm,n = Σ_j R_nl(r) Y_lm(v) m_q,n(j), where the messages m of the neighbours
/// are results of the preceding layer, and the operations on T. In the first layer a message is one factor per
/// channel.
#[derive(Clone, Debug)]
pub(super) struct Layer<V: Vector> {
    pub radial: RadialFunctions<V>,
    pub harmonics: Harmonics,
    pub message: LayerMessage<V>,
    /// T, \[q\]\[lm\]\[channel\], at the start of the tape.
    pub density: Tensor,
    pub steps: TapeProgram<V>,
}

/// The message of an atom to its neighbours: m_q,n = x_q,n + c_q,n with the tensor x of the preceding layer,
/// zero beyond its components, and constants c of the atom's element.
#[derive(Clone, Debug)]
pub(super) struct LayerMessage<V> {
    /// x on the tape of the preceding layer; `None` in the first layer.
    pub from: Option<Tensor>,
    /// Number of components q.
    pub components: usize,
    /// c, \[element\]\[q\]\[channel\]
    pub constants: Vec<Vec<V>>,
    /// What the file says about c: that of the last component in models of one or two layers.
    pub factors: ElementFactors,
}

impl<V: Vector> LayerMessage<V> {
    /// Number of components that depend on the atom's environment.
    pub fn passed(&self) -> usize {
        self.from.map_or(0, |tensor| tensor.components)
    }

    /// Lanes of one atom's message.
    pub fn lanes(&self) -> usize {
        self.constants.first().map_or(0, Vec::len)
    }
}

/// A layer whose graph is complete.
pub(super) struct LayerDraft<'a, V: Vector> {
    pub graph: Graph<'a, V>,
    pub radial: RadialFunctions<V>,
    pub lmax: usize,
    pub message: LayerMessage<V>,
    pub block: ReadoutBlock<V>,
}

impl<V: Vector> LayerDraft<'_, V> {
    /// Completes the layer. `message` is the tensor that the next layer uses; receives its lanes.
    pub fn finish(self, message: Option<&mut Tensor>, training: bool) -> Layer<V> {
        Layer {
            radial: self.radial,
            harmonics: Harmonics::new(self.lmax),
            message: self.message,
            density: self.graph.density(),
            steps: self.graph.finish(message, training),
        }
    }
}
