//! Builds the tape of an atom from the index lists of a model file.

use std::collections::BTreeMap;

use npz::Archive;

use super::error::{GraceError, mismatch, unsupported};
use super::matrix::{LANES, Matrix, lanes_for};
use super::readout::with_transpose;
use super::tape::{Gather, Linear, LinearPart, Operation, Product, ProductOutput, Tensor, Term};

/// A longer tape than this is taken for damage (64 MiB an atom).
const LONGEST_TAPE: usize = 1 << 20;

/// A graph under construction.
pub(super) struct Graph<'a> {
    archive: &'a Archive,
    /// Tensors that a reduction may name.
    named: Vec<(String, Tensor)>,
    end: usize,
    operations: Vec<Operation>,
    basis: Gather,
    /// Components and channels of each source of the basis.
    sources: Vec<(usize, usize)>,
    /// Number of trained weights so far.
    pub weights: usize,
}

impl<'a> Graph<'a> {
    /// A graph that holds the atomic density A alone.
    pub fn new(archive: &'a Archive, components: usize, channels: usize) -> Self {
        let density = Tensor { start: 0, components, channels, width: lanes_for(channels) };
        Self {
            archive,
            named: vec![("A".to_owned(), density)],
            end: density.end(),
            operations: Vec::new(),
            basis: Gather::default(),
            sources: Vec::new(),
            weights: 0,
        }
    }

    /// A
    pub fn density(&self) -> Tensor {
        self.named[0].1
    }

    fn push(&mut self, name: &str, components: usize, channels: usize) -> Result<Tensor, GraceError> {
        let tensor = Tensor { start: self.end, components, channels, width: lanes_for(channels) };
        if components.saturating_mul(tensor.width) > LONGEST_TAPE - self.end {
            return Err(unsupported(
                self.archive,
                format!("'{name}' has {components} components of {channels}"),
            ));
        }
        self.named.push((name.to_owned(), tensor));
        self.end = tensor.end();
        Ok(tensor)
    }

    /// FC: out_k,w = f_w (Σ_n W^left_kn x^left_n,w + Σ_c:to(c)=w Σ_n W^right_kn x^right_n,from(c)), the weights
    /// of each component chosen by the tile lists.
    pub fn linear(&mut self, name: &str, left: Tensor, right: Tensor) -> Result<Tensor, GraceError> {
        let (archive, key) = (self.archive, |suffix: &str| format!("fc_{name}_{suffix}"));
        let channels = archive.count(&key("n_out"), 1, 1 << 16)?;
        let out = self.push(name, left.components, channels)?;
        let factors = archive.numbers(&key("norm_out_factor"))?.finite()?.data;
        if factors.len() != out.components {
            let found = format!("a list of {}", factors.len());
            return Err(mismatch(archive, &key("norm_out_factor"), found, out.components.to_string()));
        }
        let mut rows: BTreeMap<(bool, usize, u64), Vec<(u32, u32)>> = BTreeMap::new();
        let mut add = |is_right: bool, tile: usize, from: usize, component: usize| {
            let group = rows.entry((is_right, tile, factors[component].to_bits())).or_default();
            group.push((from as u32, (component * out.width) as u32));
        };

        let left_weights = if archive.count(&key("left_coefs"), 0, 1)? == 1 {
            let weights = self.channel_weights(&key("w_left"), channels, left.channels)?;
            let tiles = archive.exactly_indices(&key("w_tile_left"), left.components, weights.tiles)?;
            tiles.iter().enumerate().for_each(|(w, tile)| add(false, *tile, left.row(w), w));
            weights.scaled(archive.scalar(&key("norm_left"))?)
        } else {
            (0..left.components).for_each(|w| add(false, 0, left.row(w), w));
            if left.channels != channels {
                let found = format!("{channels} but its left input keeps {} channels", left.channels);
                return Err(mismatch(archive, &key("n_out"), found, left.channels.to_string()));
            }
            ChannelWeights::identity(channels)
        };
        let right_weights = self.channel_weights(&key("w_right"), channels, right.channels)?;
        let to = archive.indices(&key("collect_to"), left.components)?;
        let from = archive.exactly_indices(&key("collect_from"), to.len(), right.components)?;
        let tiles = archive.exactly_indices(&key("w_tile_right"), to.len(), right_weights.tiles)?;
        for ((to, from), tile) in to.iter().zip(&from).zip(&tiles) {
            add(true, *tile, right.row(*from), *to);
        }
        let right_weights = right_weights.scaled(archive.scalar(&key("norm_right"))?);

        let part = |((is_right, tile, factor), rows): ((bool, usize, u64), Vec<(u32, u32)>)| {
            let weights = if is_right { &right_weights } else { &left_weights };
            let factor = f64::from_bits(factor);
            let (weights, transposed) =
                with_transpose(weights.inputs, channels, |n, k| factor * weights.at(k, n, tile));
            let (from, to) = rows.into_iter().unzip();
            LinearPart { weights, transposed, from, to }
        };
        let parts = rows.into_iter().map(part).collect();
        self.operations.push(Operation::Linear(Linear { start: out.start, parts }));
        Ok(out)
    }

    fn channel_weights(
        &mut self,
        key: &str,
        outputs: usize,
        inputs: usize,
    ) -> Result<ChannelWeights, GraceError> {
        let ([k, n, tiles], weights) = self.archive.tensor::<3>(key)?;
        if [k, n] != [outputs, inputs] {
            let found = format!("of shape {:?}", [k, n, tiles]);
            return Err(mismatch(self.archive, key, found, format!("shape [{outputs}, {inputs}, …]")));
        }
        self.weights += weights.len();
        Ok(ChannelWeights { inputs, tiles, weights })
    }

    /// The product left × right, coupled by Clebsch–Gordan coefficients channel by channel.
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
        let lefts = archive.indices(&key("left_ind"), left.components)?;
        let rights = archive.exactly_indices(&key("right_ind"), lefts.len(), right.components)?;
        let sums = archive.exactly_indices(&key("m_sum_ind"), lefts.len(), LONGEST_TAPE)?;
        let coefficients = archive.floats(&key("cg_coeff"), &[lefts.len()])?;
        let components = sums.iter().max().map_or(0, |last| last + 1);
        archive.expect_count(&key("n_output_funcs"), components)?;
        archive.expect_count(&key("n_cg_terms"), lefts.len())?;
        ["lmax", "Lmax"].iter().for_each(|suffix| archive.ignore(&key(suffix)));

        let out = self.push(name, components, left.channels)?;
        let mut outputs: Vec<ProductOutput> =
            (0..components).map(|f| ProductOutput { row: out.row(f), terms: Vec::new() }).collect();
        for (((l, r), sum), coefficient) in lefts.iter().zip(&rights).zip(&sums).zip(coefficients) {
            let (left, right) = (left.row(*l) as u32, right.row(*r) as u32);
            outputs[*sum].terms.push(Term { left, right, coefficient });
        }
        self.operations.push(Operation::Product(Product { start: out.start, width: out.width, outputs }));
        Ok(out)
    }

    /// The invariant reduction `prefix`: gathers the basis B of its sources and returns the weights W
    /// with transpose (for each element of the central atom, if they differ) of y_k = Σ_b W_kb B_b.
    pub fn invariants(
        &mut self,
        prefix: &str,
        names: &[String],
        n_elements: usize,
    ) -> Result<Vec<(Matrix, Matrix)>, GraceError> {
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
        // Weights of each place of the padded basis, [place][type][k]; none for padding.
        let mut places: Vec<Vec<f64>> = Vec::new();
        for name in names {
            let key = |suffix: &str| format!("{prefix}_{suffix}_{name}");
            let weights_key = format!("{prefix}_reduce_{name}_W");
            let source = self.named(name)?;
            let collect = archive.indices(&key("collect_ind"), source.components)?;
            let (shape, weights) = if by_element {
                archive.tensor::<4>(&weights_key)?
            } else {
                let ([k, n, tiles], weights) = archive.tensor::<3>(&weights_key)?;
                ([1, k, n, tiles], weights)
            };
            if shape[..3] != [n_types, n_out, source.channels] {
                let expected = format!("[{n_types}, {n_out}, {}, …]", source.channels);
                return Err(mismatch(archive, &weights_key, format!("of shape {shape:?}"), expected));
            }
            let tiles = archive.exactly_indices(&key("w_l_tile"), collect.len(), shape[3])?;
            let norm = archive.scalar(&format!("{prefix}_reduce_{name}_norm"))?;
            archive.expect_count(&key("n_in"), source.channels)?;
            archive.expect_count(&key("w_shape"), shape[3])?;
            archive.ignore(&key("total_sum_ind"));
            self.weights += weights.len();
            for (component, tile) in collect.iter().zip(&tiles) {
                self.basis.rows.push((source.row(*component), source.width));
                for n in 0..source.width * LANES {
                    let weight = |tk: usize| norm * weights[(tk * shape[2] + n) * shape[3] + tile];
                    let filled = if n < source.channels { n_types * n_out } else { 0 };
                    places.push((0..filled).map(weight).collect());
                }
            }
            self.sources.push((collect.len(), source.channels));
        }
        let element = |element: usize| {
            with_transpose(places.len(), n_out, |place, k| {
                places[place].get(element * n_out + k).copied().unwrap_or(0.0)
            })
        };
        Ok((0..n_types).map(element).collect())
    }

    fn named(&self, name: &str) -> Result<Tensor, GraceError> {
        let found = self.named.iter().find(|(known, _)| known == name);
        found.map(|(_, tensor)| *tensor).ok_or_else(|| {
            unsupported(self.archive, format!("the energy takes '{name}', which the graph does not make"))
        })
    }

    /// Components and channels of each source of the basis, in the file's order.
    pub fn basis_sources(&self) -> &[(usize, usize)] {
        &self.sources
    }

    /// D_basis
    pub fn basis_dimension(&self) -> usize {
        self.sources.iter().map(|(components, channels)| components * channels).sum()
    }

    /// Length of the tape, the operations without results that nobody needs, and the basis.
    pub fn finish(mut self) -> (usize, Vec<Operation>, Gather) {
        let mut needed = vec![false; self.end];
        self.basis.rows.iter().for_each(|(row, _)| needed[*row] = true);
        self.operations.iter_mut().rev().for_each(|operation| operation.keep(&mut needed));
        (self.end, self.operations, self.basis)
    }
}

/// Weights [k, n, tile] that mix channels.
struct ChannelWeights {
    inputs: usize,
    tiles: usize,
    weights: Vec<f64>,
}

impl ChannelWeights {
    fn identity(channels: usize) -> Self {
        let element = |kn: usize| f64::from(u8::from(kn / channels == kn % channels));
        Self { inputs: channels, tiles: 1, weights: (0..channels * channels).map(element).collect() }
    }

    fn at(&self, k: usize, n: usize, tile: usize) -> f64 {
        self.weights[(k * self.inputs + n) * self.tiles + tile]
    }

    fn scaled(mut self, norm: f64) -> Self {
        self.weights.iter_mut().for_each(|w| *w *= norm);
        self
    }
}
