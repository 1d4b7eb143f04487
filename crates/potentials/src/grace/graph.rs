//! Builds the operations of one layer from the index lists of a model file.

use std::collections::BTreeMap;

use npz::NpzFile;

use super::error::{GraceError, mismatch, unsupported};
use super::linear::{Linear, LinearPart};
use super::product::{Combination, Combined, Coupled, Product, Term};
use super::register_allocation::allocate;
use super::schedule::depth_first;
use super::tape::{TapeOperation, Tensor};
use super::tape_program::TapeProgram;
use super::vector::{Number, Vector, lanes_for};
use super::weight_arrays::WeightArrays;
use super::weight_map::{WeightBlock, WeightMap};

/// A longer tape indicates a corrupt file (64 MiB per atom).
const MAX_TAPE_LANES: usize = 1 << 20;

/// A graph under construction.
pub(super) struct Graph<'a, V: Vector> {
    pub(super) archive: &'a NpzFile,
    /// All tensors, in their order on the tape.
    tensors: Vec<Tensor>,
    /// Tensors that reductions may refer to by name.
    named: Vec<(String, Tensor)>,
    end: usize,
    pub(super) operations: Vec<TapeOperation<V>>,
    /// First lane and number of lanes of each row of the basis B.
    pub(super) basis: Vec<(usize, usize)>,
    /// Components and channels of each source of the basis.
    pub(super) sources: Vec<(usize, usize)>,
    pub(super) source_names: Vec<String>,
    /// The trained arrays that were read so far.
    pub weights: WeightArrays,
}

impl<'a, V: Vector> Graph<'a, V> {
    /// A graph with only the sum over neighbours; errors call it `name`.
    pub fn new(
        archive: &'a NpzFile,
        name: &str,
        components: usize,
        channels: usize,
    ) -> Result<Self, GraceError> {
        let mut graph = Self {
            archive,
            tensors: Vec::new(),
            named: Vec::new(),
            end: 0,
            operations: Vec::new(),
            basis: Vec::new(),
            sources: Vec::new(),
            source_names: Vec::new(),
            weights: WeightArrays::default(),
        };
        graph.push(name, components, channels)?;
        Ok(graph)
    }

    /// The sum over neighbours.
    pub fn density(&self) -> Tensor {
        self.named[0].1
    }

    pub(super) fn push(
        &mut self,
        name: &str,
        components: usize,
        channels: usize,
    ) -> Result<Tensor, GraceError> {
        let tensor = Tensor { start: self.end, components, channels, width: lanes_for::<V>(channels) };
        if components.saturating_mul(tensor.width) > MAX_TAPE_LANES - self.end {
            return Err(unsupported(
                self.archive,
                format!("'{name}' has {components} components of {channels}"),
            ));
        }
        self.tensors.push(tensor);
        self.named.push((name.to_owned(), tensor));
        self.end = tensor.end();
        Ok(tensor)
    }

    /// FC: out_k,w = f_w (Σ_n W^left_kn x^left_n,w + Σ_c:to(c)=w Σ_n W^right_kn x^right_n,from(c)); the tile
    /// lists select the weights of each component.
    pub fn linear(&mut self, name: &str, left: Tensor, right: Tensor) -> Result<Tensor, GraceError> {
        let (archive, key) = (self.archive, |suffix: &str| format!("fc_{name}_{suffix}"));
        let channels = archive.count(&key("n_out"), 1, 1 << 16)?;
        let out = self.push(name, left.components, channels)?;
        let factors = archive.numbers(&key("norm_out_factor"))?.finite()?.data;
        if factors.len() != out.components {
            let found = format!("a list of {}", factors.len());
            return Err(mismatch(archive, &key("norm_out_factor"), found, out.components.to_string()));
        }
        let mut rows = LinearRows { out, factors, groups: BTreeMap::new() };
        let left_weights = self.left_weights(name, left, channels, &mut rows)?;
        let right_weights = self.right_weights(name, [left, right], channels, &mut rows)?;
        let part = |((is_right, tile, factor), rows): ((bool, usize, u64), Vec<(u32, u32)>)| {
            let weights = if is_right { &right_weights } else { &left_weights };
            let map = weights.map(channels, tile, f64::from_bits(factor));
            LinearPart::new(map, &self.weights, rows.into_iter().unzip())
        };
        let parts = merged(rows.groups.into_iter().map(part).collect());
        self.operations.push(TapeOperation::Linear(Linear { parts }));
        Ok(out)
    }

    /// W^left, the identity if the file has none, and the rows of the left input.
    fn left_weights(
        &mut self,
        name: &str,
        left: Tensor,
        channels: usize,
        rows: &mut LinearRows,
    ) -> Result<ChannelWeights, GraceError> {
        let (archive, key) = (self.archive, |suffix: &str| format!("fc_{name}_{suffix}"));
        if archive.count(&key("left_coefs"), 0, 1)? == 1 {
            let norm = archive.scalar(&key("norm_left"))?;
            let weights = self.channel_weights(&key("w_left"), norm, channels, left.channels)?;
            let tiles = archive.exactly_indices(&key("w_tile_left"), left.components, weights.tiles)?;
            tiles.iter().enumerate().for_each(|(w, tile)| rows.add(false, *tile, left.row(w), w));
            return Ok(weights);
        }
        archive.ignore(&key("w_tile_left"));
        (0..left.components).for_each(|w| rows.add(false, 0, left.row(w), w));
        if left.channels != channels {
            let found = format!("{channels} but its left input keeps {} channels", left.channels);
            return Err(mismatch(archive, &key("n_out"), found, left.channels.to_string()));
        }
        Ok(ChannelWeights::identity(channels))
    }

    /// W^right, and the rows of the right input.
    fn right_weights(
        &mut self,
        name: &str,
        [left, right]: [Tensor; 2],
        channels: usize,
        rows: &mut LinearRows,
    ) -> Result<ChannelWeights, GraceError> {
        let (archive, key) = (self.archive, |suffix: &str| format!("fc_{name}_{suffix}"));
        let norm = archive.scalar(&key("norm_right"))?;
        let weights = self.channel_weights(&key("w_right"), norm, channels, right.channels)?;
        let to = archive.indices(&key("collect_to"), left.components)?;
        let from = archive.exactly_indices(&key("collect_from"), to.len(), right.components)?;
        let tiles = archive.exactly_indices(&key("w_tile_right"), to.len(), weights.tiles)?;
        for ((to, from), tile) in to.iter().zip(&from).zip(&tiles) {
            rows.add(true, *tile, right.row(*from), *to);
        }
        Ok(weights)
    }

    fn channel_weights(
        &mut self,
        key: &str,
        norm: f64,
        outputs: usize,
        inputs: usize,
    ) -> Result<ChannelWeights, GraceError> {
        let ([k, n, tiles], _) = self.weights.read(self.archive, key)?;
        if [k, n] != [outputs, inputs] {
            let found = format!("of shape {:?}", [k, n, tiles]);
            return Err(mismatch(self.archive, key, found, format!("shape [{outputs}, {inputs}, …]")));
        }
        Ok(ChannelWeights { inputs, tiles, norm, array: Some(key.to_owned()) })
    }

    /// The product left × right, coupled by Clebsch–Gordan coefficients per channel.
    pub fn product(&mut self, name: &str, left: Tensor, right: Tensor) -> Result<Tensor, GraceError> {
        let (archive, key) = (self.archive, |suffix: &str| format!("prod_{name}_{suffix}"));
        if left.channels != right.channels {
            return Err(unsupported(
                archive,
                format!(
                    "the factors of '{name}' have {} and {} channels, a product needs equal numbers",
                    left.channels, right.channels
                ),
            ));
        }
        let out = self.coupled(name, &format!("prod_{name}"), "cg_coeff", [left, right])?;
        archive.expect_count(&key("n_output_funcs"), out.components)?;
        archive.expect_count(&key("n_cg_terms"), archive.integers(&key("left_ind"))?.data.len())?;
        ["lmax", "Lmax"].iter().for_each(|suffix| archive.ignore(&key(suffix)));
        Ok(out)
    }

    /// The tensor `name` from factors with equal numbers of channels, by the lists with the prefix `prefix`.
    pub(super) fn coupled(
        &mut self,
        name: &str,
        prefix: &str,
        coefficients: &str,
        [left, right]: [Tensor; 2],
    ) -> Result<Tensor, GraceError> {
        let (archive, key) = (self.archive, |suffix: &str| format!("{prefix}_{suffix}"));
        let lefts = archive.indices(&key("left_ind"), left.components)?;
        let rights = archive.exactly_indices(&key("right_ind"), lefts.len(), right.components)?;
        let sums = archive.exactly_indices(&key("m_sum_ind"), lefts.len(), MAX_TAPE_LANES)?;
        let coefficients = archive.floats(&key(coefficients), &[lefts.len()])?;
        let components = sums.iter().max().map_or(0, |last| last + 1);

        let out = self.push(name, components, left.channels)?;
        let mut outputs: Vec<Coupled<V>> =
            (0..components).map(|f| Coupled { row: out.row(f), terms: Vec::new() }).collect();
        for (((l, r), sum), coefficient) in lefts.iter().zip(&rights).zip(&sums).zip(coefficients) {
            let (left, right) = (left.row(*l) as u32, right.row(*r) as u32);
            let coefficient = V::Number::round(coefficient);
            outputs[*sum].terms.push(Term { left, right, coefficient });
        }
        let product = Product { width: out.width, channels: out.channels, outputs, inputs: Vec::new() };
        self.operations.push(TapeOperation::Product(product));
        Ok(out)
    }

    /// Combines rows of `tensor` by a list of (row of the result, row of the tensor, factor).
    pub fn combination(
        &mut self,
        name: &str,
        tensor: Tensor,
        components: usize,
        terms: &[(usize, usize, f64)],
    ) -> Result<Tensor, GraceError> {
        let out = self.push(name, components, tensor.channels)?;
        let mut outputs: Vec<Combined<V>> = out.rows().map(|row| (row as u32, Vec::new())).collect();
        for (to, from, factor) in terms {
            outputs[*to].1.push((tensor.row(*from) as u32, V::Number::round(*factor)));
        }
        let combination = Combination::new(out.width, out.channels, outputs);
        self.operations.push(TapeOperation::Combination(combination));
        Ok(out)
    }

    /// Makes a tensor available to reductions under this name.
    pub fn name(&mut self, name: &str, tensor: Tensor) {
        self.named.push((name.to_owned(), tensor));
    }

    pub(super) fn named(&self, name: &str) -> Result<Tensor, GraceError> {
        let found = self.named.iter().find(|(known, _)| known == name);
        found.map(|(_, tensor)| *tensor).ok_or_else(|| {
            unsupported(self.archive, format!("the energy uses '{name}', which the graph does not produce"))
        })
    }

    /// Removes operations whose results neither the basis nor `message` needs, and allocates lanes on the
    /// tapes, also for `message`.
    pub fn finish(mut self, message: Option<&mut Tensor>, training: bool) -> TapeProgram<V> {
        let mut needed = vec![false; self.end];
        self.basis.iter().for_each(|(row, _)| needed[*row] = true);
        let mut fixed = vec![self.density()];
        fixed.extend(message.as_deref());
        fixed.iter().flat_map(Tensor::rows).for_each(|row| needed[row] = true);
        self.operations.iter_mut().rev().for_each(|operation| operation.keep(&mut needed));
        let mut widths = vec![0; self.end];
        for tensor in &self.tensors {
            tensor.rows().for_each(|row| widths[row] = tensor.width);
        }
        allocate(depth_first(self.operations), &widths, fixed, &self.basis, message, training)
    }
}

/// The rows of a linear operation, grouped by what multiplies them.
struct LinearRows {
    out: Tensor,
    /// f of each component of the result.
    factors: Vec<f64>,
    /// Lanes at which rows are read and to which they are added; by side (whether right), tile and bits of f.
    groups: BTreeMap<(bool, usize, u64), Vec<(u32, u32)>>,
}

impl LinearRows {
    fn add(&mut self, is_right: bool, tile: usize, from: usize, component: usize) {
        let group = self.groups.entry((is_right, tile, self.factors[component].to_bits())).or_default();
        group.push((from as u32, self.out.row(component) as u32));
    }
}

/// Merges parts that map the same rows to the same rows.
fn merged<V: Vector>(parts: Vec<LinearPart<V>>) -> Vec<LinearPart<V>> {
    let mut found: Vec<LinearPart<V>> = Vec::new();
    for part in parts {
        match found.iter_mut().find(|other| other.tape == part.tape) {
            Some(other) => other.add(part),
            None => found.push(part),
        }
    }
    found
}

/// Weights `[k, n, tile]` that mix channels, times their norm.
struct ChannelWeights {
    inputs: usize,
    tiles: usize,
    norm: f64,
    /// `None` for the identity.
    array: Option<String>,
}

impl ChannelWeights {
    fn identity(channels: usize) -> Self {
        Self { inputs: channels, tiles: 1, norm: 1.0, array: None }
    }

    /// The matrix of one tile, times a factor.
    fn map(&self, outputs: usize, tile: usize, factor: f64) -> WeightMap {
        let (inputs, tiles) = (self.inputs, self.tiles);
        let block = |array: &String| WeightBlock {
            array: array.clone(),
            norm: self.norm,
            factor,
            first: tile,
            strides: [0, tiles, inputs * tiles],
            inputs: [0, inputs],
            outputs: [0, outputs],
        };
        let identity = if self.array.is_none() { factor } else { 0.0 };
        WeightMap { types: 1, inputs, outputs, identity, blocks: self.array.iter().map(block).collect() }
    }
}
