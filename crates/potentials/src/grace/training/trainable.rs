//! A model whose weights can be changed.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::{self, BufWriter, Cursor};
use std::ops::Range;
use std::path::Path;
use std::sync::Arc;

use npz::{NpzFile, Writer};

use super::super::description::Architecture;
use super::super::error::{GraceError, unsupported};
use super::super::model::GraceModel;
use super::super::network::{AnyNetwork, Network};
use super::super::potential::Grace;
use super::super::radial::RadialPath;
use super::super::read_options::ReadOptions;
use super::super::readout::SHIFTS;
use super::super::shared_reader::NOTE;
use super::super::tape::TapeOperation;
use super::super::threads::Threads;
use super::super::vector::Double;
use super::super::weight_arrays::WeightArrays;
use super::knot_traces::KnotTraces;
use super::sums::WeightSums;
use super::worker::GradientWorker;

/// A GRACE model of one or two layers whose weights can be changed, in double precision.
#[derive(Clone, Debug)]
pub struct TrainableGrace {
    /// The file that was read.
    file: Arc<[u8]>,
    model: Arc<GraceModel>,
    arrays: WeightArrays,
    groups: Vec<WeightGroup>,
    weights: Vec<f64>,
    /// Of the radial network of each layer.
    traces: Vec<KnotTraces>,
    threads: Threads,
}

/// A trained array of the model file.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct WeightGroup {
    /// Its name in the file.
    pub name: String,
    /// Its shape.
    pub shape: Vec<usize>,
    /// Its numbers among all weights.
    pub range: Range<usize>,
}

impl TrainableGrace {
    /// Reads a `kokkos.npz` file.
    ///
    /// # Errors
    /// As [`GraceModel::load`], and for a model of three layers.
    pub fn load(path: &Path) -> Result<Self, GraceError> {
        let archive = NpzFile::open(path)?;
        let open = |source| npz::Error::Open { path: path.to_owned(), source };
        let file = std::fs::read(path).map_err(open)?;
        let options = ReadOptions { radial: RadialPath::Table, training: true };
        let (model, arrays) = GraceModel::read(&archive, options, AnyNetwork::Double)?;
        if model.description.architecture == Architecture::ThreeLayer {
            return Err(unsupported(&archive, "models of three layers cannot be trained"));
        }
        let (mut groups, mut weights) = (Vec::new(), Vec::new());
        for (name, array) in arrays.iter() {
            let range = weights.len()..weights.len() + array.values.len();
            groups.push(WeightGroup { name: name.to_owned(), shape: array.shape.clone(), range });
            weights.extend_from_slice(&array.values);
        }
        let mut trainable = Self {
            file: file.into(),
            model: Arc::new(model),
            arrays,
            groups,
            weights,
            traces: Vec::new(),
            threads: Threads::default(),
        };
        let network = trainable.network();
        trainable.traces = network.layers.iter().map(|layer| KnotTraces::new(&layer.radial)).collect();
        drop(network);
        let weights = trainable.weights.clone();
        trainable.set_weights(&weights);
        Ok(trainable)
    }

    /// Threads for [`TrainableGrace::set_weights`] and [`TrainableGrace::gradient`]; results do not depend on them.
    pub fn set_threads(&mut self, threads: Threads) {
        self.threads = threads;
    }

    /// The model with the present weights.
    pub fn model(&self) -> &GraceModel {
        &self.model
    }

    /// The trained arrays, by name.
    pub fn groups(&self) -> &[WeightGroup] {
        &self.groups
    }

    /// The weights of all groups, one after another.
    pub fn weights(&self) -> &[f64] {
        &self.weights
    }

    /// Changes all weights. Copies the model if workers still use it.
    ///
    /// # Panics
    /// If there are more or fewer than [`TrainableGrace::weights`].
    pub fn set_weights(&mut self, weights: &[f64]) {
        assert_eq!(weights.len(), self.weights.len(), "a number for each weight");
        self.weights.copy_from_slice(weights);
        let mut rest = weights;
        for values in self.arrays.values_mut() {
            let (here, after) = rest.split_at(values.len());
            values.copy_from_slice(here);
            rest = after;
        }
        let Self { model, arrays, traces, threads, .. } = self;
        let AnyNetwork::Double(network) = &mut Arc::make_mut(model).network else { return };
        update(Arc::make_mut(network), arrays, traces, threads);
    }

    /// Zero sums for [`GradientWorker::accumulate`].
    pub fn sums(&self) -> WeightSums {
        WeightSums::new(&self.network())
    }

    /// A worker for one thread, with the present weights.
    pub fn worker(&self) -> GradientWorker {
        GradientWorker::new(Grace::new(self.model.clone()), self.network())
    }

    /// ∂L/∂w for each of [`TrainableGrace::weights`].
    pub fn gradient(&self, sums: &WeightSums) -> Vec<f64> {
        let mut out = self.arrays.clone();
        out.values_mut().for_each(|values| values.fill(0.0));
        sums.pull_back(&self.network(), &self.arrays, (&self.traces, &self.threads), &mut out);
        out.iter().flat_map(|(_, array)| array.values.iter().copied()).collect()
    }

    /// The note in the file that was read, if a training made it.
    pub fn note(&self) -> Option<String> {
        let archive = NpzFile::from_bytes("the model", &self.file).ok()?;
        archive.contains(NOTE).then(|| archive.strings(NOTE).ok()?.into_iter().next()).flatten()
    }

    /// The file that was read.
    pub fn file_bytes(&self) -> &[u8] {
        &self.file
    }

    /// Writes a model file with the present weights and everything else as in the file that was read, except the mixture of
    /// the grade, which belongs to the earlier weights. `note` goes to the array `calmwalk_note`.
    ///
    /// # Errors
    /// If the file cannot be written.
    pub fn write(&self, path: &Path, note: &str) -> io::Result<()> {
        let mut writer = Writer::new(BufWriter::new(File::create(path)?));
        let aliases = self.arrays.aliases.iter().map(|(alias, original)| (alias, original));
        let names = self.groups.iter().map(|group| (&group.name, &group.name)).chain(aliases);
        let trained: BTreeMap<&str, &WeightGroup> =
            names.filter_map(|(name, original)| Some((name.as_str(), self.group(original)?))).collect();
        let is_stale = |name: &str| name == NOTE || (name.starts_with("uq_") && !is_projection(name));
        writer.copy(Cursor::new(&self.file[..]), |name| is_stale(name) || trained.contains_key(name))?;
        for (name, group) in trained {
            writer.array(name, &group.shape, self.weights[group.range.clone()].iter().copied())?;
        }
        writer.strings(NOTE, &[1], &[note])?;
        writer.finish()?.into_inner().map_err(io::IntoInnerError::into_error)?.sync_all()
    }

    fn group(&self, name: &str) -> Option<&WeightGroup> {
        self.groups.iter().find(|group| group.name == name)
    }

    fn network(&self) -> Arc<Network<Double>> {
        match &self.model.network {
            AnyNetwork::Double(network) => network.clone(),
            AnyNetwork::Mixed(_) => unreachable!("it is read in double precision"),
        }
    }
}

/// Whether an array of the grade belongs to the projection of the features, not to the mixture.
fn is_projection(name: &str) -> bool {
    name.starts_with("uq_rp_")
        || matches!(name, "uq_schema_version" | "uq_feature_dim" | "uq_feature_transform")
}

/// Fills all matrices and tables with the present weights.
fn update(
    network: &mut Network<Double>,
    arrays: &WeightArrays,
    traces: &mut [KnotTraces],
    threads: &Threads,
) {
    for (layer, traces) in network.layers.iter_mut().zip(traces) {
        for step in &mut layer.steps.steps {
            if let TapeOperation::Linear(linear) = &mut step.operation {
                linear.parts.iter_mut().for_each(|part| part.weights = part.map.fill(arrays));
            }
        }
        let message = &mut layer.message;
        for (constants, row) in message.constants.iter_mut().zip(message.factors.rows::<Double>(arrays)) {
            let first = constants.len() - row.len();
            constants[first..].copy_from_slice(&row);
        }
        traces.update(&mut layer.radial, arrays, threads);
    }
    let readout = &mut network.readout;
    for block in &mut readout.blocks {
        block.weights = block.map.fill(arrays);
        if let Some(norm) = &mut block.norm {
            norm.scale.copy_from_slice(&arrays[norm.array.as_str()]);
        }
    }
    readout.layers = readout.maps.iter().map(|map| map.fill(arrays)).collect();
    // Not every file has them.
    if let Some(shifts) = arrays.get(SHIFTS) {
        readout.shifts.copy_from_slice(shifts);
    }
}
