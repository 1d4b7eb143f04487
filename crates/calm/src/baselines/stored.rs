//! The arrays of baselines in their file. Those of baseline number n begin with `n_`.

use std::io::{self, Read, Seek, Write};

use npz::{Error, NpzFile, Writer};

use super::distances::{ElementSample, Euclidean, KNearest};
use super::groups::AtomGroups;
use super::likelihood::{Gaussian, Likelihood};
use super::max_vol::ActiveSet;
use super::settings::BaselineSettings;
use super::{Baseline, BaselineKind, DOptimality, FeatureOrigin, Llpr};

pub(super) fn write_settings<W: Write + Seek>(
    file: &mut Writer<W>,
    settings: &BaselineSettings,
) -> io::Result<()> {
    file.scalar("tolerance", settings.tolerance)?;
    file.scalar("max_sweeps", settings.max_sweeps as i64)?;
    file.scalar("rank_tolerance", settings.rank_tolerance)?;
    file.scalar("regularisation", settings.regularisation)?;
    file.scalar("force_weight", settings.force_weight)?;
    file.scalar("neighbours", settings.neighbours as i64)?;
    file.scalar("sample", settings.sample as i64)?;
    // The archive reads integers as signed.
    file.strings("seed", &[], &[&settings.seed.to_string()])
}

pub(super) fn read_settings<R: Read + Seek>(file: &NpzFile<R>) -> Result<BaselineSettings, Error> {
    let seed = file.strings("seed")?.concat();
    let settings = BaselineSettings {
        tolerance: file.scalar("tolerance")?,
        max_sweeps: file.count("max_sweeps", 1, usize::MAX)?,
        rank_tolerance: file.scalar("rank_tolerance")?,
        regularisation: file.scalar("regularisation")?,
        force_weight: file.scalar("force_weight")?,
        neighbours: file.count("neighbours", 1, usize::MAX)?,
        sample: file.count("sample", 1, usize::MAX)?,
        seed: seed.parse().map_err(|_| file.invalid("seed", format!("'{seed}'"), "a whole number"))?,
    };
    match settings.check() {
        Ok(()) => Ok(settings),
        Err(error) => {
            Err(file.invalid("tolerance", format!("settings with an error ({error})"), "valid settings"))
        }
    }
}

pub(super) fn write<W: Write + Seek>(
    file: &mut Writer<W>,
    number: usize,
    baseline: &Baseline,
) -> io::Result<()> {
    let mut out = Arrays { file, number, dimension: baseline.dimension() };
    match baseline {
        Baseline::DOptimality(found) => {
            out.file.scalar(&out.key("converged"), i64::from(found.converged))?;
            out.groups(&found.groups)?;
            out.counts("ranks", found.sets.iter().map(ActiveSet::rank))?;
            out.rows("rows", found.sets.iter().flat_map(|set| set.rows().iter().copied()))?;
            out.rows("coefficients", found.sets.iter().flat_map(|set| set.coefficients().iter().copied()))
        }
        Baseline::Llpr(found) => {
            let gram = out.key("gram");
            out.file.array(&gram, &[found.dimension; 2], found.gram.iter().copied())?;
            out.file.scalar(&out.key("regularisation"), found.regularisation)
        }
        Baseline::Euclidean(found) => out.groups(&found.groups),
        Baseline::KNearest(found) => {
            out.file.scalar(&out.key("neighbours"), found.neighbours as i64)?;
            out.counts("counts", found.elements.iter().map(ElementSample::count))?;
            out.rows("means", found.elements.iter().flat_map(|sample| sample.mean().iter().copied()))?;
            out.rows("features", found.elements.iter().flat_map(|sample| sample.rows().iter().copied()))
        }
        Baseline::Likelihood(found) => {
            let all = || found.elements.iter().flatten();
            out.counts("counts", found.elements.iter().map(Vec::len))?;
            out.rows("centroids", all().flat_map(|gaussian| gaussian.centroid.iter().copied()))?;
            let (key, shape) = (out.key("inverses"), [all().count(), found.dimension, found.dimension]);
            out.file.array(&key, &shape, all().flat_map(|gaussian| gaussian.inverse.iter().copied()))?;
            let (key, shape) = (out.key("constants"), [all().count()]);
            out.file.array(&key, &shape, all().map(|gaussian| gaussian.constant))
        }
    }
}

/// Writes the arrays of one baseline.
struct Arrays<'a, W: Write + Seek> {
    file: &'a mut Writer<W>,
    number: usize,
    dimension: usize,
}

impl<W: Write + Seek> Arrays<'_, W> {
    fn key(&self, name: &str) -> String {
        format!("{}_{name}", self.number)
    }

    fn counts(&mut self, name: &str, counts: impl Iterator<Item = usize>) -> io::Result<()> {
        let counts: Vec<i64> = counts.map(|count| count as i64).collect();
        self.file.array(&self.key(name), &[counts.len()], counts)
    }

    /// `[n × D]`
    fn rows(&mut self, name: &str, numbers: impl Iterator<Item = f64>) -> io::Result<()> {
        let numbers: Vec<f64> = numbers.collect();
        self.file.array(&self.key(name), &[numbers.len() / self.dimension, self.dimension], numbers)
    }

    fn groups(&mut self, groups: &AtomGroups) -> io::Result<()> {
        let dimension = self.dimension;
        self.counts("centroid_counts", groups.centroids().iter().map(|found| found.len() / dimension))?;
        self.rows("centroids", groups.centroids().iter().flatten().copied())
    }
}

pub(super) fn read<R: Read + Seek>(
    file: &NpzFile<R>,
    number: usize,
    kind: BaselineKind,
    origin: &FeatureOrigin,
) -> Result<Baseline, Error> {
    let found = Stored { file, number, dimension: origin.dimension, elements: origin.symbols.len() };
    Ok(match kind {
        BaselineKind::DOptimalityElement
        | BaselineKind::DOptimalityCentred
        | BaselineKind::DOptimalityComponent => Baseline::DOptimality(found.d_optimality(kind)?),
        BaselineKind::Llpr | BaselineKind::LlprSum | BaselineKind::LlprForces => {
            Baseline::Llpr(found.llpr(kind)?)
        }
        BaselineKind::Euclidean => Baseline::Euclidean(Euclidean { groups: found.groups(true)? }),
        BaselineKind::KNearest => Baseline::KNearest(found.k_nearest()?),
        BaselineKind::Likelihood => Baseline::Likelihood(found.likelihood()?),
    })
}

/// Reads the arrays of one baseline.
struct Stored<'a, R: Read + Seek> {
    file: &'a NpzFile<R>,
    number: usize,
    dimension: usize,
    elements: usize,
}

impl<R: Read + Seek> Stored<'_, R> {
    fn key(&self, name: &str) -> String {
        format!("{}_{name}", self.number)
    }

    /// `length` counts, each at most `most`, and their sum.
    fn counts(&self, name: &str, length: usize, most: usize) -> Result<(Vec<usize>, usize), Error> {
        let key = self.key(name);
        let counts = self.file.exactly_indices(&key, length, most.saturating_add(1))?;
        let sum = counts.iter().try_fold(0_usize, |sum, count| sum.checked_add(*count));
        match sum {
            Some(sum) => Ok((counts, sum)),
            None => Err(self.file.invalid(&key, "a sum beyond 64 bits", "counts of rows")),
        }
    }

    /// Rows of D finite numbers whose squares are finite, divided as the counts say.
    fn rows(&self, name: &str, counts: &[usize], sum: usize) -> Result<Vec<Vec<f64>>, Error> {
        let key = self.key(name);
        let numbers = self.file.floats(&key, &[sum, self.dimension])?;
        if let Some(large) = numbers.iter().find(|x| x.abs() > LARGEST) {
            return Err(self.file.invalid(&key, large, format!("numbers up to {LARGEST:e}")));
        }
        let mut rest = &numbers[..];
        Ok(counts
            .iter()
            .map(|count| {
                let (own, others) = rest.split_at(count * self.dimension);
                rest = others;
                own.to_vec()
            })
            .collect())
    }

    /// An element without training atoms has no centroid in either case.
    fn groups(&self, of_components: bool) -> Result<AtomGroups, Error> {
        let (counts, sum) = self.counts("centroid_counts", self.elements, MOST_COMPONENTS)?;
        if sum > 0 && !of_components {
            let key = self.key("centroid_counts");
            return Err(self.file.invalid(&key, format!("{counts:?}"), "no centroids"));
        }
        Ok(AtomGroups::of_centroids(self.dimension, self.rows("centroids", &counts, sum)?))
    }

    fn d_optimality(&self, kind: BaselineKind) -> Result<DOptimality, Error> {
        let groups = self.groups(kind.needs_mixture())?;
        let (ranks, sum) = self.counts("ranks", groups.count(), self.dimension)?;
        let rows = self.rows("rows", &ranks, sum)?.into_iter();
        let sets = rows.zip(self.rows("coefficients", &ranks, sum)?);
        let sets = sets.map(|(rows, coefficients)| ActiveSet::from_parts(self.dimension, rows, coefficients));
        let converged = self.file.count(&self.key("converged"), 0, 1)? == 1;
        Ok(DOptimality { kind, groups, sets: sets.collect(), converged })
    }

    fn llpr(&self, kind: BaselineKind) -> Result<Llpr, Error> {
        let (gram, dimension) = (self.key("gram"), self.dimension);
        let numbers = self.file.floats(&gram, &[dimension, dimension])?;
        let regularisation = self.file.scalar(&self.key("regularisation"))?;
        if !(regularisation > 0.0 && regularisation <= LARGEST) {
            return Err(self.file.invalid(&self.key("regularisation"), regularisation, "a number above 0"));
        }
        let trace: f64 = numbers.iter().step_by(dimension + 1).sum();
        let symmetric =
            (0..dimension).all(|i| (0..i).all(|j| numbers[i * dimension + j] == numbers[j * dimension + i]));
        let small = numbers.iter().all(|x| x.abs() <= LARGEST);
        if !(symmetric && small && trace > 0.0) {
            return Err(self.file.invalid(&gram, "another matrix", "a symmetric matrix of positive trace"));
        }
        Llpr::new(kind, dimension, numbers, regularisation)
            .map_err(|error| self.file.invalid(&gram, error, "a matrix with eigenvalues"))
    }

    fn k_nearest(&self) -> Result<KNearest, Error> {
        let (counts, sum) = self.counts("counts", self.elements, usize::MAX - 1)?;
        let means = self.rows("means", &vec![1; self.elements], self.elements)?;
        let rows = self.rows("features", &counts, sum)?;
        let neighbours = self.file.count(&self.key("neighbours"), 1, usize::MAX)?;
        let samples = means.into_iter().zip(rows);
        let elements = samples.map(|(mean, rows)| ElementSample::from_parts(mean, rows)).collect();
        Ok(KNearest { dimension: self.dimension, neighbours, elements })
    }

    fn likelihood(&self) -> Result<Likelihood, Error> {
        let (counts, sum) = self.counts("counts", self.elements, MOST_COMPONENTS)?;
        let constants = self.file.floats(&self.key("constants"), &[sum])?;
        let inverses = self.file.floats(&self.key("inverses"), &[sum, self.dimension, self.dimension])?;
        let inverses = inverses.chunks_exact(self.dimension * self.dimension).map(<[f64]>::to_vec);
        let centroids = self.rows("centroids", &vec![1; sum], sum)?.into_iter();
        let mut gaussians = centroids
            .zip(inverses)
            .zip(constants)
            .map(|((centroid, inverse), constant)| Gaussian { centroid, inverse, constant });
        let elements = counts.iter().map(|count| gaussians.by_ref().take(*count).collect()).collect();
        Ok(Likelihood { dimension: self.dimension, elements })
    }
}

/// Larger numbers are no features; their squares could overflow.
const LARGEST: f64 = 1e140;

/// Components of one element.
const MOST_COMPONENTS: usize = 1 << 20;
