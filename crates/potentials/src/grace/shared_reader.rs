//! Reads what models of all depths share: elements, switches, cutoffs, embeddings, and the order of products.

use atoms::Species;
use npz::NpzFile;

use super::element_factors::{EMBEDDING, ElementFactors};
use super::error::{GraceError, mismatch, unsupported};
use super::graph::Graph;
use super::tape::Tensor;
use super::vector::{Double, Vector, to_lanes};
use super::weight_arrays::WeightArrays;

pub(super) fn elements(archive: &NpzFile) -> Result<Vec<Species>, GraceError> {
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

/// Rejects a file in which one of these switches is present with an unsupported value.
pub(super) fn reject_unsupported_variants(
    archive: &NpzFile,
    switches: &[(&str, usize, &str)],
) -> Result<(), GraceError> {
    for (key, supported, meaning) in switches {
        if archive.contains(key) && archive.count(key, 0, usize::MAX)? != *supported {
            return Err(unsupported(archive, format!("'{key}' selects {meaning}, which is not supported")));
        }
    }
    Ok(())
}

/// Checks the switches of one radial network, one sum over neighbours and the whole file.
pub(super) fn reject_unsupported_radial_variants(
    archive: &NpzFile,
    network: &str,
    density: &str,
) -> Result<(), GraceError> {
    reject_unsupported_variants(
        archive,
        &[
            ("nn_dtype", 0, "an arithmetic other than double precision"),
            (&format!("{network}_has_chem_emb"), 0, "a chemical embedding in the radial network"),
            (&format!("{network}_embed_i"), 0, "an embedding of the central element in the radial network"),
            (
                &format!("{network}_embed_j"),
                0,
                "an embedding of the neighbour's element in the radial network",
            ),
            (&format!("{density}_indicator_l_depend"), 0, "an indicator that depends on l"),
            (&format!("{density}_sum_neighbors"), 1, "a basis that is not summed over neighbours"),
        ],
    )
}

/// The array of a model file in which a training says how it made the model.
pub const NOTE: &str = "calmwalk_note";

/// Rejects a file with unread arrays other than those of the mixture and the note.
pub(super) fn reject_unread_arrays(archive: &NpzFile, depth: &str) -> Result<(), GraceError> {
    let mut left_over = archive.unread();
    left_over.retain(|name| !name.starts_with("uq_") && *name != NOTE);
    if left_over.is_empty() {
        return Ok(());
    }
    Err(unsupported(
        archive,
        format!(
            "arrays that are unknown for a {depth}-layer model and may change its energy: {}",
            left_over.join(", ")
        ),
    ))
}

/// r_c for centre and neighbour element, `[n_elements²]`, Å.
pub(super) fn cutoffs(archive: &NpzFile, n_elements: usize) -> Result<Vec<f64>, GraceError> {
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

/// The embedding Z of the elements, `[element, size]`.
pub(super) struct Embedding {
    size: usize,
    values: Vec<f64>,
}

impl Embedding {
    pub fn read(
        archive: &NpzFile,
        n_elements: usize,
        weights: &mut WeightArrays,
    ) -> Result<Self, GraceError> {
        let ([rows, size], values) = weights.read(archive, EMBEDDING)?;
        if rows != n_elements {
            let expected = format!("{n_elements} elements");
            return Err(mismatch(archive, EMBEDDING, format!("{rows} rows"), expected));
        }
        for key in ["embedding_size", "chem_embedding_size"].into_iter().filter(|key| archive.contains(key)) {
            archive.expect_count(key, size)?;
        }
        Ok(Self { size, values: values.to_vec() })
    }

    /// Numbers per element.
    pub fn size(&self) -> usize {
        self.size
    }

    fn rows(&self) -> impl Iterator<Item = &[f64]> {
        self.values.chunks_exact(self.size)
    }

    /// Z_i W + Z_j W′ + b for centre i and neighbour j, `[element²][outputs]`; W and W′, row-major `[size,
    /// outputs]`, follow one another.
    pub fn pair_biases(&self, weights: &[f64], bias: &[f64]) -> Vec<Vec<Double>> {
        let outputs = bias.len();
        let pairs = self.rows().flat_map(|i| self.rows().map(move |j| (i, j)));
        let sum = |(i, j): (&[f64], &[f64]), o: usize| -> f64 {
            let inputs = i.iter().chain(j).enumerate();
            inputs.map(|(k, z)| z * weights[k * outputs + o]).sum::<f64>() + bias[o]
        };
        pairs.map(|pair| to_lanes(&(0..outputs).map(|o| sum(pair, o)).collect::<Vec<_>>())).collect()
    }

    /// The factors Z W with the weights `{prefix}_W` `[size, channels]` times `{prefix}_norm` times `scale`.
    pub fn transformed(
        &self,
        archive: &NpzFile,
        prefix: &str,
        channels: usize,
        scale: f64,
        weights: &mut WeightArrays,
    ) -> Result<ElementFactors, GraceError> {
        let transform = format!("{prefix}_W");
        weights.read_exactly(archive, &transform, &[self.size, channels])?;
        let scale = archive.scalar(&format!("{prefix}_norm"))? * scale;
        Ok(ElementFactors { transform, channels, scale })
    }
}

/// The powers of a tensor x that reductions may use: x → x1 = FC(x, x) → xx = x1 × x1 → xx1 = FC(xx, x) → xxx =
/// xx1 × x1 (or x); xx2 = FC(xx, x) → xxxx = xx2 × xx2. The file names them by repeating the letter of x.
pub(super) struct Powers<'a> {
    pub letter: &'a str,
    /// Whether xxx is xx1 × x1.
    pub third_with_mixed: bool,
    /// The reductions that use them.
    pub taken_by: &'a [&'a str],
}

impl Powers<'_> {
    /// x, xx, xxx, xxxx
    fn names(&self) -> [String; 4] {
        std::array::from_fn(|k| self.letter.repeat(k + 1))
    }

    /// Builds as many powers as the reductions use and returns their number.
    pub fn make<V: Vector>(&self, graph: &mut Graph<V>, x: Tensor) -> Result<usize, GraceError> {
        let [one, two, three, four] = &self.names();
        let order = self.highest_order(graph.archive)?;
        if order >= 2 {
            let x1 = graph.linear(&format!("{one}1"), x, x)?;
            let xx = graph.product(two, x1, x1)?;
            if order >= 3 {
                let xx1 = graph.linear(&format!("{two}1"), xx, x)?;
                graph.product(three, xx1, if self.third_with_mixed { x1 } else { x })?;
            }
            if order >= 4 {
                let xx2 = graph.linear(&format!("{two}2"), xx, x)?;
                graph.product(four, xx2, xx2)?;
            }
        }
        Ok(order)
    }

    /// 1 for x … 4 for xxxx.
    fn highest_order(&self, archive: &NpzFile) -> Result<usize, GraceError> {
        let (known, mut highest) = (self.names(), 0);
        for reduction in self.taken_by {
            let key = format!("{reduction}_instruction_names");
            let names = archive.strings(&key)?;
            let orders: Option<Vec<usize>> =
                names.iter().map(|name| known.iter().position(|known| known == name)).collect();
            let Some(last) = orders.and_then(|orders| orders.into_iter().max()) else {
                let expected = format!("some of {}, each once", known.join(", "));
                return Err(mismatch(archive, &key, format!("{names:?}"), expected));
            };
            highest = highest.max(last + 1);
        }
        Ok(highest)
    }

    /// Names of the linear maps and of the products of an order, as the file lists them.
    pub fn lists(&self, order: usize) -> (Vec<String>, Vec<String>) {
        let [one, two, three, four] = self.names();
        let maps = [format!("{one}1"), format!("{two}1"), format!("{two}2")];
        (maps.into_iter().take(order - 1).collect(), [two, three, four].into_iter().take(order - 1).collect())
    }
}
