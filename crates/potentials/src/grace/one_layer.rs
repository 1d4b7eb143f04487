//! Reads GRACE-1L and lays out its graph:
//!
//! A → A1 = FC(A, A) → AA = A1 × A1 → AA1 = FC(AA, A) → AAA = AA1 × A1; AA2 = FC(AA, A) → AAAA = AA2 × AA2,
//! of which the energy takes the invariants of as many as the model's maximum order says.

use atoms::Species;
use npz::Archive;

use super::error::{GraceError, mismatch, unsupported};
use super::graph::Graph;
use super::harmonics::Harmonics;
use super::matrix::{LANES, Lanes, Matrix, to_lanes};
use super::model::{Architecture, GraceDescription, GraceModel};
use super::projection::{Projection, ProjectionMaps, rows_of_projection};
use super::radial::{RadialFunctions, RadialNetwork, RadialPath, column_by_order};
use super::readout::{Activation, Readout, with_transpose};

/// Sources of the energy, in the order they are made.
const BASIS_FUNCTIONS: [&str; 4] = ["A", "AA", "AAA", "AAAA"];

pub(super) fn read(archive: &Archive, path: RadialPath) -> Result<GraceModel, GraceError> {
    let elements = elements(archive)?;
    refuse_other_variants(archive)?;
    let lmax = archive.count("lmax", 0, 12)?;
    let channels = archive.count("mlp_rad_n_rad_max", 1, 4096)?;
    let cutoffs = cutoffs(archive, elements.len())?;
    let mut graph = Graph::new(archive, (lmax + 1) * (lmax + 1), channels);
    let network = radial_network(archive, lmax, channels, &mut graph)?;
    let embedding = embedding(archive, elements.len(), channels, &mut graph)?;
    let names = archive.strings("rho_instruction_names")?;
    let order = highest_order(archive, &names)?;
    let a = graph.density();
    if order >= 2 {
        let a1 = graph.linear("A1", a, a)?;
        let aa = graph.product("AA", a1, a1)?;
        if order >= 3 {
            let aa1 = graph.linear("AA1", aa, a)?;
            graph.product("AAA", aa1, a1)?;
        }
        if order >= 4 {
            let aa2 = graph.linear("AA2", aa, a)?;
            graph.product("AAAA", aa2, aa2)?;
        }
    }
    let densities = graph.invariants("rho", &names, elements.len())?;
    let readout = readout(archive, densities, &mut graph)?;
    let projection = projection(archive, &graph)?;
    let mut left_over = archive.not_asked();
    left_over.retain(|name| !name.starts_with("uq_"));
    if !left_over.is_empty() {
        return Err(unsupported(
            archive,
            format!(
                "arrays that a one-layer model is not known to have, and that may change its energy: {}",
                left_over.join(", ")
            ),
        ));
    }

    let radial_basis_size = network.basis_size;
    let radial = RadialFunctions::new(network, elements.len(), cutoffs, path);
    let description = GraceDescription {
        architecture: Architecture::OneLayer,
        elements: elements.clone(),
        cutoff: radial.largest_cutoff(),
        pair_cutoffs: archive.count("has_bond_specific_cutoff", 0, 1)? == 1,
        lmax,
        radial_basis_size,
        channels,
        basis_functions: names,
        basis_dimension: graph.basis_dimension(),
        feature_dimension: projection.as_ref().map_or(0, Projection::feature_dimension),
        weights: graph.weights,
        radial_tables: radial.tables().iter().map(|table| (table.intervals(), table.errors())).collect(),
    };
    let (tape_lanes, operations, basis) = graph.finish();
    Ok(GraceModel {
        elements,
        radial,
        harmonics: Harmonics::new(lmax),
        embedding,
        tape_lanes,
        density: a,
        operations,
        basis,
        readout,
        projection,
        description,
    })
}

fn elements(archive: &Archive) -> Result<Vec<Species>, GraceError> {
    let names = archive.strings("element_names")?;
    archive.count("n_elements", 1, 118)?;
    archive.expect_count("n_elements", names.len())?;
    let mut elements: Vec<Species> = Vec::new();
    for name in &names {
        match name.parse() {
            Ok(element) if !elements.contains(&element) => elements.push(element),
            _ => return Err(mismatch(archive, "element_names", format!("{names:?}"), "distinct symbols")),
        }
    }
    Ok(elements)
}

/// Switches of the format whose other position no known one-layer model uses.
fn refuse_other_variants(archive: &Archive) -> Result<(), GraceError> {
    for (key, supported, meaning) in [
        ("nn_dtype", 0, "another arithmetic than double precision"),
        ("mlp_rad_has_chem_emb", 0, "a chemical embedding in the radial network"),
        ("mlp_rad_embed_i", 0, "an embedding of the central element in the radial network"),
        ("mlp_rad_embed_j", 0, "an embedding of the neighbour's element in the radial network"),
        ("A_indicator_l_depend", 0, "an indicator that depends on l"),
        ("A_sum_neighbors", 1, "a basis that is not summed over neighbours"),
    ] {
        if archive.contains(key) && archive.count(key, 0, usize::MAX)? != supported {
            return Err(unsupported(archive, format!("'{key}' asks for {meaning}, which is not supported")));
        }
    }
    Ok(())
}

fn radial_network(
    archive: &Archive,
    lmax: usize,
    channels: usize,
    graph: &mut Graph,
) -> Result<RadialNetwork, GraceError> {
    let basis_size = archive.count("nradbase", 1, 1024)?;
    archive.expect_count("mlp_rad_lmax", lmax)?;
    if archive.contains("nradmax") {
        archive.expect_count("nradmax", channels)?;
    }
    let n_layers = archive.count("mlp_rad_n_layers", 1, 64)?;
    let (mut layers, mut inputs) = (Vec::new(), basis_size);
    for k in 0..n_layers {
        let (outputs, weights) = dense(archive, "mlp_rad", k, inputs)?;
        graph.weights += weights.len();
        let last = k + 1 == n_layers;
        if last && outputs != channels * (lmax + 1) {
            return Err(mismatch(
                archive,
                &format!("mlp_rad_W{k}"),
                format!("{outputs} columns wide"),
                format!("{channels} channels × {} orders", lmax + 1),
            ));
        }
        layers.push(if last {
            let places = (lmax + 1) * channels.next_multiple_of(LANES);
            Matrix::from_fn(inputs, places, |i, place| {
                column_by_order(channels, lmax + 1, place).map_or(0.0, |o| weights[i * outputs + o])
            })
        } else {
            Matrix::from_fn(inputs, outputs, |i, o| weights[i * outputs + o])
        });
        inputs = outputs;
    }
    let envelope_exponent = archive.count("radial_basis_p", 2, 1024)? as i32;
    Ok(RadialNetwork { basis_size, envelope_exponent, layers })
}

/// Number of outputs of a dense layer and its weights times their norm, row-major [inputs, outputs].
fn dense(archive: &Archive, prefix: &str, k: usize, inputs: usize) -> Result<(usize, Vec<f64>), GraceError> {
    let key = format!("{prefix}_W{k}");
    let ([rows, outputs], mut weights) = archive.tensor::<2>(&key)?;
    if rows != inputs {
        return Err(mismatch(archive, &key, format!("{rows} rows high"), format!("{inputs} rows")));
    }
    let norm = archive.scalar(&format!("{prefix}_norm{k}"))?;
    weights.iter_mut().for_each(|w| *w *= norm);
    Ok((outputs, weights))
}

/// r_c for centre and neighbour element, [n_elements²], Å.
fn cutoffs(archive: &Archive, n_elements: usize) -> Result<Vec<f64>, GraceError> {
    let rcut = archive.scalar("rcut")?;
    let (key, cutoffs) = if archive.count("has_bond_specific_cutoff", 0, 1)? == 1 {
        ("bond_cutoff_map", archive.floats("bond_cutoff_map", &[n_elements, n_elements])?)
    } else {
        ("rcut", vec![rcut; n_elements * n_elements])
    };
    match cutoffs.iter().find(|cutoff| !(0.1..=100.0).contains(*cutoff)) {
        Some(cutoff) => Err(mismatch(archive, key, format!("{cutoff} Å"), "a cutoff from 0.1 to 100 Å")),
        None => Ok(cutoffs),
    }
}

/// The neighbour's factor of each channel, with 1/(mean number of neighbours).
fn embedding(
    archive: &Archive,
    n_elements: usize,
    channels: usize,
    graph: &mut Graph,
) -> Result<Vec<Vec<Lanes>>, GraceError> {
    let ([rows, size], embedding) = archive.tensor::<2>("chem_embedding")?;
    if rows != n_elements {
        return Err(mismatch(
            archive,
            "chem_embedding",
            format!("{rows} rows"),
            format!("{n_elements} elements"),
        ));
    }
    for key in ["embedding_size", "chem_embedding_size"].into_iter().filter(|key| archive.contains(key)) {
        archive.expect_count(key, size)?;
    }
    let transform = archive.floats("A_lin_transform_W", &[size, channels])?;
    let scale = archive.scalar("A_lin_transform_norm")? * archive.scalar("A_inv_avg_n_neigh")?;
    graph.weights += embedding.len() + transform.len();
    let channel = |element: usize, n: usize| -> f64 {
        (0..size).map(|k| embedding[element * size + k] * transform[k * channels + n]).sum::<f64>() * scale
    };
    Ok((0..n_elements)
        .map(|element| to_lanes(&(0..channels).map(|n| channel(element, n)).collect::<Vec<_>>()))
        .collect())
}

/// 1 for A … 4 for AAAA.
fn highest_order(archive: &Archive, names: &[String]) -> Result<usize, GraceError> {
    let mut orders = Vec::new();
    for name in names {
        match BASIS_FUNCTIONS.iter().position(|known| known == name) {
            Some(order) if !orders.contains(&order) => orders.push(order),
            _ => {
                return Err(mismatch(
                    archive,
                    "rho_instruction_names",
                    format!("{names:?}"),
                    "some of A, AA, AAA, AAAA, each once",
                ));
            }
        }
    }
    orders.iter().max().map(|order| order + 1).ok_or_else(|| {
        mismatch(archive, "rho_instruction_names", "empty", "at least one of A, AA, AAA, AAAA")
    })
}

fn readout(
    archive: &Archive,
    densities: Vec<(Matrix, Matrix)>,
    graph: &mut Graph,
) -> Result<Readout, GraceError> {
    let n_elements = archive.count("n_elements", 1, 118)?;
    let n_densities = archive.count("rho_n_out", 1, 4096)?;
    let n_layers = match archive.contains("energy_mlp_n_layers") {
        true => archive.count("energy_mlp_n_layers", 1, 64)?,
        false if n_densities == 1 => 0,
        false => archive.count("energy_mlp_n_layers", 1, 64)?,
    };
    let (mut layers, mut inputs) = (Vec::new(), n_densities.saturating_sub(1));
    for k in 0..n_layers {
        let (outputs, weights) = dense(archive, "energy_mlp", k, inputs)?;
        graph.weights += weights.len();
        if k + 1 == n_layers && outputs != 1 {
            return Err(mismatch(
                archive,
                &format!("energy_mlp_W{k}"),
                format!("{outputs} columns wide"),
                "one column",
            ));
        }
        // The first layer reads y as it stands, so y_0 gets weights of zero.
        let skipped = usize::from(k == 0);
        layers.push(with_transpose(inputs + skipped, outputs, |i, o| {
            i.checked_sub(skipped).map_or(0.0, |i| weights[i * outputs + o])
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
    Ok(Readout { densities, layers, activation, scale: archive.scalar_or("output_scale", 1.0)?, shifts })
}

fn projection(archive: &Archive, graph: &Graph) -> Result<Option<Projection>, GraceError> {
    if !archive.contains("uq_schema_version") {
        return Ok(None);
    }
    let version = archive.count("uq_schema_version", 0, usize::MAX)?;
    let dimension = archive.count("uq_rp_dim", 1, 1 << 16)?;
    let matrix = archive.singles("uq_rp_matrix")?.finite()?.shaped(&[graph.basis_dimension(), dimension])?;
    let normalize = archive.flag_or("uq_rp_normalize", false)?;
    let density_channels = archive.flag_or("uq_rp_add_density_channel", false)?;
    let asinh = archive.flag_or("uq_feature_transform", false)?;
    let expected = match (normalize || density_channels, asinh) {
        (true, _) => 6,
        (false, true) => 4,
        (false, false) => 3,
    };
    if version != expected {
        return Err(mismatch(
            archive,
            "uq_schema_version",
            version.to_string(),
            format!("{expected}, which its flags mean"),
        ));
    }
    let maps = ProjectionMaps::new(&matrix, dimension, &rows_of_projection(graph.basis_sources()));
    let density_scale = archive.scalar_or("uq_rp_density_scale", 1.0)? as f32;
    let projection =
        Projection { matrix, dimension, normalize, density_channels, density_scale, asinh, maps };
    archive.expect_count("uq_feature_dim", projection.feature_dimension())?;
    Ok(Some(projection))
}
