//! The invariant basis B of a model, whose rows of the projection matrix follow one another in the file's order.

use super::vector::Vector;

/// Where the invariants of each layer are in B.
#[derive(Clone, Debug)]
pub(super) struct BasisLayout {
    /// D_basis
    pub dimension: usize,
    /// The layers in the order of their blocks in B.
    pub blocks: Vec<usize>,
    /// The index in B of each invariant of each layer's padded basis, `None` for padding.
    pub rows: Vec<Vec<Option<usize>>>,
}

/// Components and channels of each source of a layer's basis.
pub(super) type Sources = [(usize, usize)];

impl BasisLayout {
    /// `sources` describes each layer's basis, `blocks` the order of the layers in the file.
    pub fn new<V: Vector>(sources: &[Vec<(usize, usize)>], blocks: &[usize]) -> Self {
        let (mut firsts, mut dimension) = (vec![0; sources.len()], 0);
        for layer in blocks {
            firsts[*layer] = dimension;
            dimension += size(&sources[*layer]);
        }
        let rows =
            firsts.into_iter().zip(sources).map(|(first, sources)| rows::<V>(first, sources)).collect();
        Self { dimension, blocks: blocks.to_vec(), rows }
    }
}

fn size(sources: &Sources) -> usize {
    sources.iter().map(|(components, channels)| components * channels).sum()
}

/// The index in B for each index of a layer's padded basis, whose first one is `first`. Sources follow one
/// another; the file is channel-major (row n · components + c), the evaluation \[component\]\[padded channel\].
fn rows<V: Vector>(mut first: usize, sources: &Sources) -> Vec<Option<usize>> {
    let mut rows = Vec::new();
    for (components, channels) in sources {
        let padded = channels.next_multiple_of(V::LANES);
        for c in 0..*components {
            rows.extend((0..padded).map(|n| (n < *channels).then_some(first + n * components + c)));
        }
        first += components * channels;
    }
    rows
}
