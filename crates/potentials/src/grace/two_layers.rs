//! Reads GRACE-2L and builds its graph.
//!
//! The first layer is that of GRACE-1L, except that AAA = AA1 × A. It reduces A, AA, AAA, AAAA to I1 with
//! weights of the central element, and I1 to the message I. The second layer sums B0 over neighbours, like A,
//! and T_y,q = Σ_j R1 Y_y I_q(j), couples YI_f = Σ C T_y,q, reduces B = (YI, B0), and continues with B as the
//! first layer does with A. The invariants of both layers are normalised and summed.

use npz::NpzFile;

use super::block_aliases::{BlockAliases, ignore_aliases};
use super::builder::{ModelBuilder, ModelParts};
use super::description::Architecture;
use super::element_factors::ElementFactors;
use super::error::{GraceError, mismatch, unsupported};
use super::graph::Graph;
use super::invariant_norm::InvariantNorm;
use super::layer::{LayerDraft, LayerMessage};
use super::networks::radial_network;
use super::radial::RadialFunctions;
use super::read_options::ReadOptions;
use super::readout::ReadoutBlock;
use super::shared_reader::{Embedding, Powers, cutoffs, elements, reject_unsupported_radial_variants};
use super::tape::Tensor;
use super::vector::Vector;
use super::weight_arrays::WeightArrays;

const FIRST: Powers = Powers { letter: "A", third_with_mixed: false, taken_by: &["I1", "rho"] };
const SECOND: Powers = Powers { letter: "B", third_with_mixed: false, taken_by: &["I2"] };

pub(super) fn read<V: Vector>(archive: &NpzFile, options: ReadOptions) -> Result<ModelParts<V>, GraceError> {
    let elements = elements(archive)?;
    let names = BlockAliases::read(archive)?;
    let mut weights = WeightArrays::default();
    let embedding = Embedding::read(archive, elements.len(), &mut weights)?;
    let mut reader = TwoLayerReader {
        archive,
        options,
        lmax: archive.count("lmax", 0, 12)?,
        n_elements: elements.len(),
        cutoffs: cutoffs(archive, elements.len())?,
        embedding,
        weights,
    };
    let n_densities = archive.count("rho_n_out", 1, 4096)?;
    archive.expect_count("I2_n_out", n_densities)?;
    let (first, message, first_order) = reader.first_layer(n_densities)?;
    let (second, second_order) = reader.second_layer(message, n_densities)?;
    expect_lists(archive, [first_order, second_order])?;
    reader.weights.aliases = ignore_aliases(archive, &names)?;
    ModelBuilder {
        archive,
        architecture: Architecture::TwoLayer,
        elements,
        layers: vec![first, second],
        block_order: names.order(),
        n_densities,
        weights: reader.weights,
    }
    .finish(options.training)
}

struct TwoLayerReader<'a> {
    archive: &'a NpzFile,
    options: ReadOptions,
    lmax: usize,
    n_elements: usize,
    cutoffs: Vec<f64>,
    embedding: Embedding,
    weights: WeightArrays,
}

impl<'a> TwoLayerReader<'a> {
    /// The layer, its message and the order of its products.
    fn first_layer<V: Vector>(
        &mut self,
        n_densities: usize,
    ) -> Result<(LayerDraft<'a, V>, Tensor, usize), GraceError> {
        let (archive, lmax) = (self.archive, self.lmax);
        let (channels, radial) = self.radial("R", "A")?;
        let factors = self.scalar_message("A", channels)?;
        let mut graph = Graph::new(archive, "A", (lmax + 1) * (lmax + 1), channels)?;
        let a = graph.density();
        let order = FIRST.make(&mut graph, a)?;
        graph.reduce("I1", self.n_elements)?;
        let indicator = graph.reduce("I", self.n_elements)?;
        let (weights, map) = graph.invariants("rho", self.n_elements)?;
        let norm = Some(invariant_norm(archive, "I_nl_LN", n_densities, &mut self.weights)?);
        let block = ReadoutBlock { weights, map, norm };
        let constants = factors.rows(&self.weights);
        let message = LayerMessage { from: None, components: 1, constants, factors };
        Ok((LayerDraft { graph, radial, lmax, message, block }, indicator, order))
    }

    fn second_layer<V: Vector>(
        &mut self,
        indicator: Tensor,
        n_densities: usize,
    ) -> Result<(LayerDraft<'a, V>, usize), GraceError> {
        let (archive, lmax) = (self.archive, self.lmax);
        let (channels, radial) = self.radial("R1", "B0")?;
        if indicator.channels != channels {
            let found = format!("{} channels of the message", indicator.channels);
            return Err(mismatch(archive, "I_n_out", found, format!("{channels}, as its radial functions")));
        }
        // The last component of a message is the factor of B0.
        let factors = self.scalar_message("B0", channels)?;
        let mut constants = vec![vec![V::ZERO; indicator.components * indicator.width]; self.n_elements];
        for (constants, scalar) in constants.iter_mut().zip(factors.rows::<V>(&self.weights)) {
            constants.extend(scalar);
        }
        let components = indicator.components + 1;
        let message = LayerMessage { from: Some(indicator), components, constants, factors };

        let functions = (lmax + 1) * (lmax + 1);
        let mut graph = Graph::new(archive, "the messages", components * functions, channels)?;
        let t = graph.density();
        let b0 = Tensor { start: t.row(indicator.components * functions), components: functions, ..t };
        graph.name("B0", b0);
        self.coupled_messages(&mut graph, indicator.components)?;
        let b = graph.reduce("B", self.n_elements)?;
        let order = SECOND.make(&mut graph, b)?;
        let (weights, map) = graph.invariants("I2", self.n_elements)?;
        let norm = Some(invariant_norm(archive, "I_0_LN", n_densities, &mut self.weights)?);
        let block = ReadoutBlock { weights, map, norm };
        Ok((LayerDraft { graph, radial, lmax, message, block }, order))
    }

    /// Number of channels and radial functions of one layer.
    fn radial<V: Vector>(
        &mut self,
        name: &str,
        density: &str,
    ) -> Result<(usize, RadialFunctions<V>), GraceError> {
        let (archive, prefix) = (self.archive, format!("mlp_rad_{name}"));
        reject_unsupported_radial_variants(archive, &prefix, density)?;
        let channels = archive.count(&format!("{prefix}_n_rad_max"), 1, 4096)?;
        let network = radial_network::<V>(archive, &prefix, self.lmax, channels, &mut self.weights)?;
        Ok((
            channels,
            RadialFunctions::new(
                network,
                self.n_elements,
                self.cutoffs.clone(),
                self.options.table_error::<V>(),
            ),
        ))
    }

    fn scalar_message(&mut self, name: &str, channels: usize) -> Result<ElementFactors, GraceError> {
        let scale = self.archive.scalar(&format!("{name}_inv_avg_n_neigh"))?;
        let prefix = format!("{name}_lin_transform");
        self.embedding.transformed(self.archive, &prefix, channels, scale, &mut self.weights)
    }

    /// YI_f = Σ_c C_c T_y(c),q(c), with 1/(mean number of neighbours).
    fn coupled_messages<V: Vector>(&self, graph: &mut Graph<V>, of_message: usize) -> Result<(), GraceError> {
        let (archive, t) = (self.archive, graph.density());
        let functions = (self.lmax + 1) * (self.lmax + 1);
        let coefficients = archive.numbers("YI_cg_coeff")?.finite()?.data;
        let pairs =
            archive.exactly_indices("YI_lr_inds", 2 * coefficients.len(), functions.max(of_message))?;
        let components = archive.count("YI_n_output_funcs", 1, 1 << 16)?;
        let sums = archive.exactly_indices("YI_m_sum_ind", coefficients.len(), components)?;
        archive.expect_count("YI_n_cg_terms", coefficients.len())?;
        archive.expect_count("YI_n_rad_max", t.channels)?;
        archive.ignore("YI_Lmax");
        let scale = archive.scalar("YI_inv_avg_n_neigh")?;
        let mut terms = Vec::new();
        for ((pair, sum), coefficient) in pairs.as_chunks::<2>().0.iter().zip(sums).zip(coefficients) {
            let [y, q] = *pair;
            if y >= functions || q >= of_message {
                let expected = format!("pairs below [{functions}, {of_message}]");
                return Err(mismatch(archive, "YI_lr_inds", format!("a list with {pair:?}"), expected));
            }
            terms.push((sum, q * functions + y, scale * coefficient));
        }
        graph.combination("YI", t, components, &terms)?;
        Ok(())
    }
}

/// The norm `name` of this many densities.
pub(super) fn invariant_norm(
    archive: &NpzFile,
    name: &str,
    n_densities: usize,
    weights: &mut WeightArrays,
) -> Result<InvariantNorm, GraceError> {
    let key = |suffix: &str| format!("{name}_{suffix}");
    archive.expect_count(&key("n_out"), n_densities)?;
    let linear = match archive.count(&key("type"), 0, 2)? {
        0 => None,
        1 => Some(1.0),
        _ => Some(archive.scalar(&key("lin_scale"))?),
    };
    let normalised = n_densities - usize::from(linear.is_some());
    let scale = weights.read_exactly(archive, &key("scale"), &[normalised])?.to_vec();
    Ok(InvariantNorm { linear, scale, array: key("scale") })
}

/// Checks that the file lists exactly the operations of the graph.
fn expect_lists(archive: &NpzFile, orders: [usize; 2]) -> Result<(), GraceError> {
    let [(mut maps, mut products), (more_maps, more_products)] =
        [FIRST.lists(orders[0]), SECOND.lists(orders[1])];
    maps.extend(more_maps);
    products.extend(more_products);
    let owned = |names: &[&str]| names.iter().map(|name| (*name).to_owned()).collect();
    for (key, expected) in [
        ("mlp_rad_names", owned(&["R", "R1"])),
        ("spb_names", owned(&["A", "B0"])),
        ("fc_names", maps),
        ("prod_names", products),
    ] {
        expect_list(archive, key, expected)?;
    }
    match archive.strings("rms_names")?.len() {
        2 => Ok(()),
        n => Err(mismatch(archive, "rms_names", format!("a list of {n}"), "one norm for each layer")),
    }
}

/// Checks that the list `key` has the expected names, in any order.
pub(super) fn expect_list(archive: &NpzFile, key: &str, mut expected: Vec<String>) -> Result<(), GraceError> {
    let mut found = archive.strings(key)?;
    found.sort();
    expected.sort();
    if found == expected {
        return Ok(());
    }
    Err(unsupported(
        archive,
        format!(
            "'{key}' lists {}, but supported models of this depth have {}",
            found.join(", "),
            expected.join(", ")
        ),
    ))
}
