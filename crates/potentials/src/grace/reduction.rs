//! Reductions: weighted sums of several tensors; the weights may depend on the central atom's element.

use std::collections::BTreeMap;

use super::error::{GraceError, mismatch};
use super::graph::Graph;
use super::linear::{Linear, LinearPart};
use super::tape::{TapeOperation, Tensor};
use super::vector::Vector;
use super::weight_map::{WeightBlock, WeightMap};
use super::weights::Weights;

/// The part of a reduction that reads one tensor.
struct ReductionSource {
    name: String,
    tensor: Tensor,
    /// The components to read,
    collect: Vec<usize>,
    /// the weights of each,
    tiles: Vec<usize>,
    /// and the component of the result to which it is added.
    sums: Vec<usize>,
    /// Number of distinct weights.
    n_tiles: usize,
    /// Name of the weights `[type, k, n, tile]`, and their norm.
    array: String,
    norm: f64,
}

/// The sizes of a reduction and its sources.
struct Reduction {
    n_types: usize,
    n_out: usize,
    sources: Vec<ReductionSource>,
}

impl Reduction {
    /// W_kn of this tile for inputs from `first_input`.
    fn block(&self, source: &ReductionSource, tile: usize, first_input: usize) -> WeightBlock {
        let (channels, tiles) = (source.tensor.channels, source.n_tiles);
        WeightBlock {
            array: source.array.clone(),
            norm: source.norm,
            factor: 1.0,
            first: tile,
            strides: [self.n_out * channels * tiles, tiles, channels * tiles],
            inputs: [first_input, channels],
            outputs: [0, self.n_out],
        }
    }

    /// The matrix of these blocks.
    fn map(&self, inputs: usize, blocks: Vec<WeightBlock>) -> WeightMap {
        WeightMap { types: self.n_types, inputs, outputs: self.n_out, identity: 0.0, blocks }
    }
}

impl<V: Vector> Graph<'_, V> {
    /// The invariant reduction `prefix`: collects the basis B from its sources and returns the weights W of y_k
    /// = Σ_b W_kb B_b.
    pub fn invariants(
        &mut self,
        prefix: &str,
        n_elements: usize,
    ) -> Result<(Weights<V>, WeightMap), GraceError> {
        let key = format!("{prefix}_only_invar");
        if self.archive.contains(&key) {
            self.archive.expect_count(&key, 1)?;
            self.archive.expect_count(&format!("{prefix}_n_funcs"), 1)?;
        }
        let reduction = self.reduction(prefix, n_elements, 1)?;
        // The basis is padded to whole lanes.
        let (mut blocks, mut inputs) = (Vec::new(), 0);
        for source in &reduction.sources {
            for (component, tile) in source.collect.iter().zip(&source.tiles) {
                self.basis.push((source.tensor.row(*component), source.tensor.width));
                blocks.push(reduction.block(source, *tile, inputs));
                inputs += source.tensor.width * V::LANES;
            }
            self.sources.push((source.collect.len(), source.tensor.channels));
            self.source_names.push(source.name.clone());
        }
        if blocks.is_empty() {
            let key = format!("{prefix}_instruction_names");
            return Err(mismatch(self.archive, &key, "a list of tensors without invariants", "invariants"));
        }
        let map = reduction.map(inputs, blocks);
        Ok((map.fill(&self.weights), map))
    }

    /// The reduction `prefix` to a tensor of that name: out_k,f = Σ over sources and c with sum(c) = f of Σ_n
    /// W_kn x_n,collect(c).
    pub fn reduce(&mut self, prefix: &str, n_elements: usize) -> Result<Tensor, GraceError> {
        let archive = self.archive;
        let components = archive.count(&format!("{prefix}_n_funcs"), 1, 1 << 16)?;
        if archive.count(&format!("{prefix}_only_invar"), 0, 1)? == 1 {
            archive.expect_count(&format!("{prefix}_n_funcs"), 1)?;
        }
        let reduction = self.reduction(prefix, n_elements, components)?;
        let out = self.push(prefix, components, reduction.n_out)?;
        let mut parts = Vec::new();
        for source in &reduction.sources {
            let mut rows: BTreeMap<usize, (Vec<u32>, Vec<u32>)> = BTreeMap::new();
            for ((component, tile), sum) in source.collect.iter().zip(&source.tiles).zip(&source.sums) {
                let (from, to) = rows.entry(*tile).or_default();
                from.push(source.tensor.row(*component) as u32);
                to.push(out.row(*sum) as u32);
            }
            for (tile, rows) in rows {
                let map = reduction.map(source.tensor.channels, vec![reduction.block(source, tile, 0)]);
                parts.push(LinearPart::new(map, &self.weights, rows));
            }
        }
        self.operations.push(TapeOperation::Linear(Linear { parts }));
        Ok(out)
    }

    fn reduction(
        &mut self,
        prefix: &str,
        n_elements: usize,
        components: usize,
    ) -> Result<Reduction, GraceError> {
        let archive = self.archive;
        let n_out = archive.count(&format!("{prefix}_n_out"), 1, 4096)?;
        let by_element = archive.count(&format!("{prefix}_is_central_atom_type_dependent"), 0, 1)? == 1;
        let types_key = format!("{prefix}_number_of_atom_types");
        if by_element {
            archive.expect_count(&types_key, n_elements)?;
        } else {
            archive.ignore(&types_key);
        }
        let n_types = if by_element { n_elements } else { 1 };
        let norm = archive.scalar_or(&format!("{prefix}_norm_map"), 1.0)?;
        let names_key = format!("{prefix}_instruction_names");
        let names = archive.strings(&names_key)?;
        if names.is_empty() || (1..names.len()).any(|k| names[..k].contains(&names[k])) {
            return Err(mismatch(archive, &names_key, format!("{names:?}"), "tensors, each once"));
        }
        let mut sources = Vec::new();
        for name in &names {
            let shape = [n_types, n_out, usize::from(by_element)];
            sources.push(self.source(prefix, name, shape, components, norm)?);
        }
        Ok(Reduction { n_types, n_out, sources })
    }

    fn source(
        &mut self,
        prefix: &str,
        name: &str,
        [n_types, n_out, by_element]: [usize; 3],
        components: usize,
        norm: f64,
    ) -> Result<ReductionSource, GraceError> {
        let archive = self.archive;
        let key = |suffix: &str| format!("{prefix}_{suffix}_{name}");
        let weights_key = format!("{prefix}_reduce_{name}_W");
        let tensor = self.named(name)?;
        let collect = archive.indices(&key("collect_ind"), tensor.components)?;
        let shape = if by_element == 1 {
            self.weights.read::<4>(archive, &weights_key)?.0
        } else {
            let ([k, n, tiles], _) = self.weights.read(archive, &weights_key)?;
            [1, k, n, tiles]
        };
        if shape[..3] != [n_types, n_out, tensor.channels] {
            let expected = format!("[{n_types}, {n_out}, {}, …]", tensor.channels);
            return Err(mismatch(archive, &weights_key, format!("of shape {shape:?}"), expected));
        }
        let tiles = archive.exactly_indices(&key("w_l_tile"), collect.len(), shape[3])?;
        let sums = archive.exactly_indices(&key("total_sum_ind"), collect.len(), components)?;
        archive.expect_count(&key("n_in"), tensor.channels)?;
        archive.expect_count(&key("w_shape"), shape[3])?;
        let norm = norm * archive.scalar(&format!("{prefix}_reduce_{name}_norm"))?;
        Ok(ReductionSource {
            name: name.to_owned(),
            tensor,
            collect,
            tiles,
            sums,
            n_tiles: shape[3],
            array: weights_key,
            norm,
        })
    }
}
