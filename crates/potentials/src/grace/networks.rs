//! Reads the perceptrons of a model: those of the radial functions and of the energy.

use npz::NpzFile;

use super::activation::Activation;
use super::error::{GraceError, mismatch};
use super::matrix::Matrix;
use super::radial_network::RadialNetwork;
use super::readout::{Readout, ReadoutBlock, SHIFTS};
use super::shared_reader::Embedding;
use super::vector::{Double, Vector, to_lanes};
use super::weight_arrays::WeightArrays;
use super::weight_map::{WeightBlock, WeightMap};

/// The network `prefix` for channels × (lmax + 1) radial functions, with channels padded to whole vectors `V`.
pub(super) fn radial_network<V: Vector>(
    archive: &NpzFile,
    prefix: &str,
    lmax: usize,
    channels: usize,
    weights: &mut WeightArrays,
) -> Result<RadialNetwork, GraceError> {
    let basis_size = archive.count("nradbase", 1, 1024)?;
    archive.expect_count(&format!("{prefix}_lmax"), lmax)?;
    let n_layers = archive.count(&format!("{prefix}_n_layers"), 1, 64)?;
    let (mut maps, mut inputs) = (Vec::new(), basis_size);
    for k in 0..n_layers {
        let layer = dense(archive, prefix, k, inputs, weights)?;
        inputs = layer.outputs;
        maps.push(if k + 1 == n_layers {
            radial_columns::<V>(archive, &layer, lmax, channels)?
        } else {
            layer.map()
        });
    }
    let envelope_exponent = archive.count("radial_basis_p", 2, 1024)? as i32;
    Ok(RadialNetwork {
        basis_size,
        envelope_exponent,
        envelope_last: false,
        layers: maps.iter().map(|map| matrix(map, weights)).collect(),
        maps,
        biases: Vec::new(),
        pair_biases: Vec::new(),
    })
}

/// The network of layer `name` in a three-layer model. Its inputs are the polynomials and the embeddings of
/// centre and neighbour; all layers but the last have a bias.
pub(super) fn enveloped_network<V: Vector>(
    archive: &NpzFile,
    name: &str,
    lmax: usize,
    channels: usize,
    embedding: &Embedding,
    weights: &mut WeightArrays,
) -> Result<RadialNetwork, GraceError> {
    let prefix = format!("{name}_mlp");
    let basis_size = archive.count(&format!("{name}_n_rad_basis"), 1, 1024)?;
    let n_layers = archive.count(&format!("{prefix}_n_layers"), 2, 64)?;
    let (mut maps, mut biases, mut pair_biases) = (Vec::new(), Vec::new(), Vec::new());
    let mut inputs = basis_size + 2 * embedding.size();
    for k in 0..n_layers {
        let layer = dense(archive, &prefix, k, inputs, weights)?;
        inputs = layer.outputs;
        if k + 1 == n_layers {
            maps.push(radial_columns::<V>(archive, &layer, lmax, channels)?);
            break;
        }
        let key = format!("{prefix}_b{k}");
        let bias = weights.read_exactly(archive, &key, &[1, layer.outputs])?;
        let bias: Vec<f64> = bias.iter().map(|b| b * layer.norm).collect();
        let mut map = layer.map();
        if k == 0 {
            pair_biases = embedding.pair_biases(&map.numbers(weights)[basis_size * layer.outputs..], &bias);
            map = map.first_inputs(basis_size);
        }
        biases.push(to_lanes(&bias));
        maps.push(map);
    }
    let envelope_exponent = archive.count(&format!("{name}_p"), 2, 1024)? as i32;
    let layers = maps.iter().map(|map| matrix(map, weights)).collect();
    Ok(RadialNetwork {
        basis_size,
        envelope_exponent,
        envelope_last: true,
        layers,
        maps,
        biases,
        pair_biases,
    })
}

/// The layer whose columns are radial functions, \[l\]\[channel\] with channels padded to whole vectors `V`;
/// row-major `[channel, l]` in the file.
fn radial_columns<V: Vector>(
    archive: &NpzFile,
    layer: &Dense,
    lmax: usize,
    channels: usize,
) -> Result<WeightMap, GraceError> {
    let orders = lmax + 1;
    if layer.outputs != channels * orders {
        let expected = format!("{channels} channels × {orders} orders");
        return Err(mismatch(archive, &layer.key, format!("{} columns wide", layer.outputs), expected));
    }
    let width = channels.next_multiple_of(V::LANES);
    let block = |l: usize| WeightBlock {
        array: layer.key.clone(),
        norm: layer.norm,
        factor: 1.0,
        first: l,
        strides: [0, layer.outputs, orders],
        inputs: [0, layer.inputs],
        outputs: [l * width, channels],
    };
    let blocks = (0..orders).map(block).collect();
    Ok(WeightMap { types: 1, inputs: layer.inputs, outputs: orders * width, identity: 0.0, blocks })
}

/// A dense layer of a perceptron: weights `[inputs, outputs]` times a norm.
struct Dense {
    key: String,
    norm: f64,
    inputs: usize,
    outputs: usize,
}

impl Dense {
    fn map(&self) -> WeightMap {
        WeightMap::dense(&self.key, self.norm, [self.inputs, self.outputs])
    }
}

/// Reads the layer `{prefix}_W{k}`.
fn dense(
    archive: &NpzFile,
    prefix: &str,
    k: usize,
    inputs: usize,
    weights: &mut WeightArrays,
) -> Result<Dense, GraceError> {
    let key = format!("{prefix}_W{k}");
    let ([rows, outputs], _) = weights.read(archive, &key)?;
    if rows != inputs {
        return Err(mismatch(archive, &key, format!("{rows} rows high"), format!("{inputs} rows")));
    }
    let norm = archive.scalar(&format!("{prefix}_norm{k}"))?;
    Ok(Dense { key, norm, inputs, outputs })
}

/// The matrix with the current weights.
pub(super) fn matrix(map: &WeightMap, arrays: &WeightArrays) -> Matrix<Double> {
    let numbers = map.numbers(arrays);
    Matrix::from_fn(map.inputs, map.outputs, |i, o| numbers[i * map.outputs + o])
}

/// The readout of the densities of all layers' `blocks`, which must agree in number.
pub(super) fn readout<V: Vector>(
    archive: &NpzFile,
    blocks: Vec<ReadoutBlock<V>>,
    n_densities: usize,
    n_elements: usize,
    weights: &mut WeightArrays,
) -> Result<Readout<V>, GraceError> {
    let n_layers = match archive.contains("energy_mlp_n_layers") || n_densities > 1 {
        true => archive.count("energy_mlp_n_layers", 1, 64)?,
        false => 0,
    };
    let (mut maps, mut inputs) = (Vec::new(), n_densities.saturating_sub(1));
    for k in 0..n_layers {
        let layer = dense(archive, "energy_mlp", k, inputs, weights)?;
        inputs = layer.outputs;
        if k + 1 == n_layers && layer.outputs != 1 {
            let found = format!("{} columns wide", layer.outputs);
            return Err(mismatch(archive, &layer.key, found, "one column"));
        }
        // The first layer reads y unchanged, so y_0 gets zero weights.
        maps.push(layer.map().after_inputs(usize::from(k == 0)));
    }
    let activation = match archive.contains("energy_mlp_activation") {
        true if archive.count("energy_mlp_activation", 0, 1)? == 1 => Activation::Tanh,
        _ => Activation::Silu,
    };
    let shifts = match archive.contains(SHIFTS) {
        true => weights.read_exactly(archive, SHIFTS, &[n_elements])?.to_vec(),
        false => vec![0.0; n_elements],
    };
    let scale = archive.scalar_or("output_scale", 1.0)?;
    let layers = maps.iter().map(|map| map.fill(weights)).collect();
    Ok(Readout { blocks, layers, maps, activation, scale, shifts })
}
