//! Reads GRACE-3L and builds its graph.
//!
//! In layer L = 1, 2, 3 an atom sums A_L over its neighbours; in the second and third layer this is coupled
//! with their message, the normalised eq_(L−1), and reduced. With the result x: x2 = x ∘ x → FC with x, twice →
//! x3 = x2a ∘ x, x4 = x2b ∘ x2b, where ∘ first mixes the channels of its factors, and each product is reduced.
//! eq_L and ρ_L are reductions of all four, with weights of the central element; the energy uses the sum of the
//! normalised ρ.
//!
//! The file does not state the factors, so its lists of names must match this graph.

use npz::NpzFile;

use super::builder::{ModelBuilder, ModelParts};
use super::description::Architecture;
use super::error::{GraceError, mismatch};
use super::graph::Graph;
use super::layer::{LayerDraft, LayerMessage};
use super::networks::enveloped_network;
use super::radial::RadialFunctions;
use super::read_options::ReadOptions;
use super::readout::ReadoutBlock;
use super::shared_reader::{Embedding, elements, reject_unsupported_variants};
use super::tape::Tensor;
use super::two_layers::{expect_list, invariant_norm};
use super::vector::{Number, Vector};
use super::weight_arrays::WeightArrays;

pub(super) fn read<V: Vector>(archive: &NpzFile, options: ReadOptions) -> Result<ModelParts<V>, GraceError> {
    let elements = elements(archive)?;
    reject_unsupported_variants(
        archive,
        &[
            ("nn_dtype", 0, "an arithmetic other than double precision"),
            ("has_bond_specific_cutoff", 0, "cutoffs for pairs of elements in a three-layer model"),
        ],
    )?;
    // Those of the layers apply instead.
    ["nradbase", "rcut", "radial_basis_p"].iter().for_each(|key| archive.ignore(key));
    expect_lists(archive)?;
    let n_densities = archive.count("rho1_n_out", 1, 4096)?;
    archive.expect_count("energy_mlp_origin_n_out", n_densities)?;
    archive.expect_count("energy_mlp_n_origins", 3)?;
    let mut weights = WeightArrays::default();
    let embedding = Embedding::read(archive, elements.len(), &mut weights)?;
    let mut reader =
        ThreeLayerReader { archive, options, n_elements: elements.len(), n_densities, embedding, weights };
    let (mut layers, mut message) = (Vec::new(), None);
    for number in 1..=3 {
        let (layer, sent) = reader.layer(number, message)?;
        layers.push(layer);
        message = sent;
    }
    let architecture = Architecture::ThreeLayer;
    let block_order = vec![0, 1, 2];
    ModelBuilder {
        archive,
        architecture,
        elements,
        layers,
        block_order,
        n_densities,
        weights: reader.weights,
    }
    .finish(options.training)
}

struct ThreeLayerReader<'a> {
    archive: &'a NpzFile,
    options: ReadOptions,
    n_elements: usize,
    n_densities: usize,
    embedding: Embedding,
    weights: WeightArrays,
}

impl<'a> ThreeLayerReader<'a> {
    /// A layer, from the message of the preceding layer, with its own message.
    fn layer<V: Vector>(
        &mut self,
        number: usize,
        indicator: Option<Tensor>,
    ) -> Result<(LayerDraft<'a, V>, Option<Tensor>), GraceError> {
        let archive = self.archive;
        let name = format!("A{number}");
        let lmax = archive.count(&format!("{name}_lmax"), 0, 12)?;
        archive.ignore(&format!("{name}_Lmax"));
        archive.expect_count(&format!("{name}_equivariant"), usize::from(indicator.is_some()))?;
        let channels = archive.count(&format!("{name}_n_rad_max"), 1, 4096)?;
        let radial = self.radial(&name, lmax, channels)?;
        let message = match indicator {
            None => self.scalar_message(&name, channels)?,
            Some(indicator) => self.message(&name, channels, indicator)?,
        };
        let functions = (lmax + 1) * (lmax + 1);
        let neighbours = if indicator.is_some() { "the messages" } else { "A1" };
        let mut graph = Graph::new(archive, neighbours, message.components * functions, channels)?;
        let mut base = graph.density();
        if indicator.is_some() {
            self.coupled_messages(&mut graph, &name, functions)?;
            base = graph.reduce(&format!("{name}_red"), self.n_elements)?;
        }
        powers(&mut graph, &name, base, self.n_elements)?;
        let norm =
            Some(invariant_norm(archive, &format!("rho{number}_norm"), self.n_densities, &mut self.weights)?);
        archive.expect_count(&format!("rho{number}_n_out"), self.n_densities)?;
        let (weights, map) = graph.invariants(&format!("rho{number}"), self.n_elements)?;
        let block = ReadoutBlock { weights, map, norm };
        let sent = match number {
            3 => None,
            _ => {
                let equivariant = graph.reduce(&format!("eq{number}"), self.n_elements)?;
                Some(graph.equivariant_norm(&format!("eq{number}_norm"), equivariant)?)
            }
        };
        Ok((LayerDraft { graph, radial, lmax, message, block }, sent))
    }

    fn radial<V: Vector>(
        &mut self,
        name: &str,
        lmax: usize,
        channels: usize,
    ) -> Result<RadialFunctions<V>, GraceError> {
        let archive = self.archive;
        let tiles = archive.integers(&format!("{name}_l_tile"))?.data;
        let orders = (0..=lmax).flat_map(|l| vec![l as i64; 2 * l + 1]);
        if !orders.eq(tiles.iter().copied()) {
            let expected = "each l as often as there are m";
            return Err(mismatch(archive, &format!("{name}_l_tile"), format!("{tiles:?}"), expected));
        }
        let cutoff = archive.scalar(&format!("{name}_rcut"))?;
        if !(0.1..=100.0).contains(&cutoff) {
            let expected = "a cutoff from 0.1 to 100 Å";
            return Err(mismatch(archive, &format!("{name}_rcut"), format!("{cutoff} Å"), expected));
        }
        let network =
            enveloped_network::<V>(archive, name, lmax, channels, &self.embedding, &mut self.weights)?;
        let cutoffs = vec![cutoff; self.n_elements * self.n_elements];
        Ok(RadialFunctions::new(network, self.n_elements, cutoffs, self.options.table_error::<V>()))
    }

    fn scalar_message<V: Vector>(
        &mut self,
        name: &str,
        channels: usize,
    ) -> Result<LayerMessage<V>, GraceError> {
        let scale = self.archive.scalar(&format!("{name}_inv_avg_n_neigh"))?;
        let prefix = format!("{name}_lin_transform");
        let factors =
            self.embedding.transformed(self.archive, &prefix, channels, scale, &mut self.weights)?;
        let constants = factors.rows(&self.weights);
        Ok(LayerMessage { from: None, components: 1, constants, factors })
    }

    /// The indicator of the preceding layer, plus the contribution of the neighbour's element to its invariant
    /// components.
    fn message<V: Vector>(
        &mut self,
        name: &str,
        channels: usize,
        indicator: Tensor,
    ) -> Result<LayerMessage<V>, GraceError> {
        let archive = self.archive;
        if indicator.channels != channels {
            let found = format!("{channels}, where the message has {} channels", indicator.channels);
            return Err(mismatch(archive, &format!("{name}_n_rad_max"), found, "as many as the message"));
        }
        let components = indicator.components;
        archive.expect_count(&format!("{name}_n_lm_ind"), components)?;
        let mask = archive.floats(&format!("{name}_chem_l0_mask"), &[components])?;
        let prefix = format!("{name}_chem_linear");
        let factors = self.embedding.transformed(archive, &prefix, channels, 1.0, &mut self.weights)?;
        let rows = factors.rows(&self.weights);
        let constants = |row: &Vec<V>| -> Vec<V> {
            mask.iter().flat_map(|m| row.iter().map(|x| x.scaled(V::Number::round(*m)))).collect()
        };
        Ok(LayerMessage {
            from: Some(indicator),
            components,
            constants: rows.iter().map(constants).collect(),
            factors,
        })
    }

    /// A_f = Σ W_(y,q),f T_y,q, with 1/(mean number of neighbours).
    fn coupled_messages<V: Vector>(
        &self,
        graph: &mut Graph<V>,
        name: &str,
        functions: usize,
    ) -> Result<(), GraceError> {
        let (archive, t) = (self.archive, graph.density());
        let of_message = t.components / functions;
        let components = archive.count(&format!("{name}_nfunc"), 1, 1 << 16)?;
        let coupling = archive.floats(&format!("{name}_cg_W"), &[t.components, components])?;
        let scale = archive.scalar(&format!("{name}_inv_avg_n_neigh"))?;
        let places = coupling.iter().enumerate().filter(|(_, w)| **w != 0.0);
        let terms: Vec<(usize, usize, f64)> = places
            .map(|(place, w)| {
                let (pair, f) = (place / components, place % components);
                (f, pair % of_message * functions + pair / of_message, scale * w)
            })
            .collect();
        graph.combination(name, t, components, &terms)?;
        Ok(())
    }
}

/// The powers of x up to the fourth order, each reduced.
fn powers<V: Vector>(
    graph: &mut Graph<V>,
    name: &str,
    x: Tensor,
    n_elements: usize,
) -> Result<(), GraceError> {
    graph.mixed_product(&format!("{name}_2"), x, x)?;
    let x2 = graph.reduce(&format!("{name}_2_red"), n_elements)?;
    let x2a = graph.linear(&format!("{name}_2a"), x2, x)?;
    graph.mixed_product(&format!("{name}_3"), x2a, x)?;
    graph.reduce(&format!("{name}_3_red"), n_elements)?;
    let x2b = graph.linear(&format!("{name}_2b"), x2, x)?;
    graph.mixed_product(&format!("{name}_4"), x2b, x2b)?;
    graph.reduce(&format!("{name}_4_red"), n_elements)?;
    Ok(())
}

/// Checks that the file lists exactly the operations of this graph.
fn expect_lists(archive: &NpzFile) -> Result<(), GraceError> {
    let of_layers = |names: &[&str]| -> Vec<String> {
        (1..=3)
            .flat_map(|layer| names.iter().map(move |name| name.replace('L', &layer.to_string())))
            .collect()
    };
    let mut reductions = of_layers(&["AL_red", "AL_2_red", "AL_3_red", "AL_4_red", "eqL", "rhoL"]);
    reductions.retain(|name| name != "A1_red" && name != "eq3");
    let mut norms = of_layers(&["eqL_norm"]);
    norms.truncate(2);
    for (key, expected) in [
        ("spbf_names", of_layers(&["AL"])),
        ("prod_names", of_layers(&["AL_2", "AL_3", "AL_4"])),
        ("reduce_names", reductions),
        ("fc_names", of_layers(&["AL_2a", "AL_2b"])),
        ("eqnorm_names", norms),
        ("rmsnorm_names", of_layers(&["rhoL_norm"])),
        ("out1_origins", of_layers(&["rhoL_norm"])),
    ] {
        expect_list(archive, key, expected)?;
    }
    for number in 1..=3 {
        let base = if number == 1 { "A1".to_owned() } else { format!("A{number}_red") };
        let mut powers = vec![base];
        powers.extend((2..=4).map(|order| format!("A{number}_{order}_red")));
        for reduction in [format!("eq{number}"), format!("rho{number}")] {
            if reduction != "eq3" {
                expect_list(archive, &format!("{reduction}_instruction_names"), powers.clone())?;
            }
        }
    }
    Ok(())
}
