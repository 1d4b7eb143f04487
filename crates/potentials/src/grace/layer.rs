//! One round of message passing: what an atom sums over its neighbours, and what it makes of it.

use super::graph::Graph;
use super::harmonics::Harmonics;
use super::radial::RadialFunctions;
use super::readout::Block;
use super::tape::Tensor;
use super::tape_program::TapeProgram;
use super::vector::Vector;

/// The weights of one layer: T_q,lm,n = Σ_j R_nl(r) Y_lm(v) m_q,n(j), the messages m of the neighbours being
/// the results of the layer before, and the operations on T. In the first layer a message is just a
/// factor for each channel.
#[derive(Clone, Debug)]
pub(super) struct Layer<V: Vector> {
    pub radial: RadialFunctions<V>,
    pub harmonics: Harmonics,
    pub message: Message<V>,
    /// T, \[q\]\[lm\]\[channel\], at the beginning of the tape.
    pub density: Tensor,
    pub steps: TapeProgram<V>,
}

/// What an atom tells its neighbours: m_q,n = x_q,n + c_q,n with the tensor x of the layer before, zero beyond its
/// components, and constants c of the atom's element.
#[derive(Clone, Debug)]
pub(super) struct Message<V> {
    /// x on the tape of the layer before; none in the first layer.
    pub from: Option<Tensor>,
    /// Number of components q.
    pub components: usize,
    /// c, [element][q][channel]
    pub constants: Vec<Vec<V>>,
}

impl<V: Vector> Message<V> {
    /// Components that depend on the atom's surroundings.
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
    pub message: Message<V>,
    pub block: Block<V>,
}

impl<V: Vector> LayerDraft<'_, V> {
    /// `message` is what the next layer takes from this one; learns where it stands.
    pub fn finish(self, message: Option<&mut Tensor>) -> Layer<V> {
        Layer {
            radial: self.radial,
            harmonics: Harmonics::new(self.lmax),
            message: self.message,
            density: self.graph.density(),
            steps: self.graph.finish(message),
        }
    }
}
