//! Reads the perceptrons of a model: those of the radial functions and of the energy.

use npz::NpzFile;

use super::error::{GraceError, mismatch};
use super::matrix::Matrix;
use super::radial::column_by_order;
use super::radial_network::RadialNetwork;
use super::readout::{Activation, Readout, ReadoutBlock};
use super::shared_reader::Embedding;
use super::vector::{Double, Vector, to_lanes};
use super::weights::with_transpose;

/// The network `prefix` for channels × (lmax + 1) radial functions, with channels padded to whole vectors `V`.
pub(super) fn radial_network<V: Vector>(
    archive: &NpzFile,
    prefix: &str,
    lmax: usize,
    channels: usize,
    weights: &mut usize,
) -> Result<RadialNetwork, GraceError> {
    let basis_size = archive.count("nradbase", 1, 1024)?;
    archive.expect_count(&format!("{prefix}_lmax"), lmax)?;
    let n_layers = archive.count(&format!("{prefix}_n_layers"), 1, 64)?;
    let (mut layers, mut inputs) = (Vec::new(), basis_size);
    for k in 0..n_layers {
        let (outputs, layer) = dense(archive, prefix, k, inputs)?;
        *weights += layer.len();
        layers.push(if k + 1 == n_layers {
            last_radial_layer::<V>(
                archive,
                &format!("{prefix}_W{k}"),
                [inputs, outputs],
                lmax,
                channels,
                &layer,
            )?
        } else {
            Matrix::from_fn(inputs, outputs, |i, o| layer[i * outputs + o])
        });
        inputs = outputs;
    }
    let envelope_exponent = archive.count("radial_basis_p", 2, 1024)? as i32;
    Ok(RadialNetwork {
        basis_size,
        envelope_exponent,
        envelope_last: false,
        layers,
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
    weights: &mut usize,
) -> Result<RadialNetwork, GraceError> {
    let prefix = format!("{name}_mlp");
    let basis_size = archive.count(&format!("{name}_n_rad_basis"), 1, 1024)?;
    let n_layers = archive.count(&format!("{prefix}_n_layers"), 2, 64)?;
    let (mut layers, mut biases, mut pair_biases) = (Vec::new(), Vec::new(), Vec::new());
    let mut inputs = basis_size + 2 * embedding.size();
    for k in 0..n_layers {
        let (outputs, layer) = dense(archive, &prefix, k, inputs)?;
        *weights += layer.len();
        if k + 1 == n_layers {
            let key = format!("{prefix}_W{k}");
            layers.push(last_radial_layer::<V>(archive, &key, [inputs, outputs], lmax, channels, &layer)?);
            break;
        }
        let norm = archive.scalar(&format!("{prefix}_norm{k}"))?;
        let bias: Vec<f64> =
            archive.floats(&format!("{prefix}_b{k}"), &[1, outputs])?.iter().map(|b| b * norm).collect();
        *weights += bias.len();
        if k == 0 {
            pair_biases = embedding.pair_biases(&layer[basis_size * outputs..], &bias);
        }
        biases.push(to_lanes(&bias));
        let rows = if k == 0 { basis_size } else { inputs };
        layers.push(Matrix::from_fn(rows, outputs, |i, o| layer[i * outputs + o]));
        inputs = outputs;
    }
    let envelope_exponent = archive.count(&format!("{name}_p"), 2, 1024)? as i32;
    Ok(RadialNetwork { basis_size, envelope_exponent, envelope_last: true, layers, biases, pair_biases })
}

/// The layer whose columns are radial functions, padded to whole vectors `V`; row-major `[channel, l]` in the
/// file.
fn last_radial_layer<V: Vector>(
    archive: &NpzFile,
    key: &str,
    [inputs, outputs]: [usize; 2],
    lmax: usize,
    channels: usize,
    weights: &[f64],
) -> Result<Matrix<Double>, GraceError> {
    if outputs != channels * (lmax + 1) {
        let expected = format!("{channels} channels × {} orders", lmax + 1);
        return Err(mismatch(archive, key, format!("{outputs} columns wide"), expected));
    }
    let places = (lmax + 1) * channels.next_multiple_of(V::LANES);
    Ok(Matrix::from_fn(inputs, places, |i, place| {
        column_by_order::<V>(channels, lmax + 1, place).map_or(0.0, |o| weights[i * outputs + o])
    }))
}

/// Number of outputs of a dense layer, and its weights times their norm, row-major `[inputs, outputs]`.
fn dense(archive: &NpzFile, prefix: &str, k: usize, inputs: usize) -> Result<(usize, Vec<f64>), GraceError> {
    let key = format!("{prefix}_W{k}");
    let ([rows, outputs], mut weights) = archive.tensor::<2>(&key)?;
    if rows != inputs {
        return Err(mismatch(archive, &key, format!("{rows} rows high"), format!("{inputs} rows")));
    }
    let norm = archive.scalar(&format!("{prefix}_norm{k}"))?;
    weights.iter_mut().for_each(|w| *w *= norm);
    Ok((outputs, weights))
}

/// The readout of the densities of all layers' `blocks`, which must agree in number.
pub(super) fn readout<V: Vector>(
    archive: &NpzFile,
    blocks: Vec<ReadoutBlock<V>>,
    n_densities: usize,
    n_elements: usize,
    weights: &mut usize,
) -> Result<Readout<V>, GraceError> {
    let n_layers = match archive.contains("energy_mlp_n_layers") || n_densities > 1 {
        true => archive.count("energy_mlp_n_layers", 1, 64)?,
        false => 0,
    };
    let (mut layers, mut inputs) = (Vec::new(), n_densities.saturating_sub(1));
    for k in 0..n_layers {
        let (outputs, layer) = dense(archive, "energy_mlp", k, inputs)?;
        *weights += layer.len();
        if k + 1 == n_layers && outputs != 1 {
            let found = format!("{outputs} columns wide");
            return Err(mismatch(archive, &format!("energy_mlp_W{k}"), found, "one column"));
        }
        // The first layer reads y unchanged, so y_0 gets zero weights.
        let skipped = usize::from(k == 0);
        layers.push(with_transpose(inputs + skipped, outputs, |i, o| {
            i.checked_sub(skipped).map_or(0.0, |i| layer[i * outputs + o])
        }));
        inputs = outputs;
    }
    let activation = match archive.contains("energy_mlp_activation") {
        true if archive.count("energy_mlp_activation", 0, 1)? == 1 => Activation::Tanh,
        _ => Activation::Silu,
    };
    let shifts = match archive.contains("shift_values") {
        true => archive.floats("shift_values", &[n_elements])?,
        false => vec![0.0; n_elements],
    };
    Ok(Readout { blocks, layers, activation, scale: archive.scalar_or("output_scale", 1.0)?, shifts })
}
