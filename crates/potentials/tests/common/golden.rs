//! Reference values from the framework that made the models.

use std::path::{Path, PathBuf};

use atoms::{Cell, Matrix3, Species, Structure};
use npyz::npz::NpzArchive;

/// A model in this repository.
pub fn committed(model: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../../configs/data").join(model)
}

/// A large model that only some machines have.
pub fn peer(model: &str) -> Option<PathBuf> {
    let Some(data) = std::env::var_os("CALMWALK_PEER_DATA") else {
        eprintln!("skipped: CALMWALK_PEER_DATA is not set");
        return None;
    };
    Some(Path::new(&data).join("grace").join(model))
}

/// An npz file with known arrays.
pub struct Npz(NpzArchive<std::io::BufReader<std::fs::File>>);

impl Npz {
    pub fn open(path: PathBuf) -> Self {
        Self(NpzArchive::open(&path).unwrap_or_else(|error| panic!("{}: {error}", path.display())))
    }

    pub fn read<T: npyz::Deserialize>(&mut self, key: &str) -> Option<Vec<T>> {
        Some(self.0.by_name(key).unwrap()?.into_vec().unwrap())
    }

    pub fn floats(&mut self, key: &str) -> Vec<f64> {
        self.read(key).unwrap_or_else(|| panic!("no {key}"))
    }

    /// Rows of three numbers.
    pub fn rows(&mut self, key: &str) -> Vec<[f64; 3]> {
        self.floats(key).as_chunks::<3>().0.to_vec()
    }

    /// The structure whose arrays have names that begin with `prefix`, if there is one.
    pub fn structure(&mut self, prefix: &str) -> Option<Structure> {
        let key = |quantity: &str| format!("{prefix}{quantity}");
        let numbers = self.read::<i64>(&key("numbers"))?;
        let cell: Matrix3 = self.rows(&key("cell")).try_into().unwrap();
        let periodic: Vec<bool> = self.read(&key("pbc")).unwrap();
        Some(Structure {
            species: numbers.iter().map(|z| Species::from_atomic_number(*z as u8).unwrap()).collect(),
            positions: self.rows(&key("positions")),
            cell: if periodic == [false; 3] { Cell::orthorhombic(1.0, 1.0, 1.0) } else { Cell(cell) },
            periodic: periodic.try_into().unwrap(),
        })
    }
}

/// One structure of golden.npz. The virials are xx, yy, zz, xy, xz, yz.
pub struct Golden {
    pub structure: Structure,
    pub energy: f64,
    pub atomic_energies: Option<Vec<f64>>,
    pub forces: Vec<f64>,
    pub virial: Option<Vec<f64>>,
    pub features: Option<Vec<f64>>,
    pub sigma: Vec<f64>,
    pub gamma: Vec<f64>,
    pub gamma_gradient: Vec<f64>,
    pub gamma_virial: Vec<f64>,
}

/// All structures of a model.
pub fn golden(model: &Path) -> Vec<Golden> {
    let mut file = Npz::open(model.join("golden.npz"));
    let mut all = Vec::new();
    for k in 0.. {
        let key = |quantity: &str| format!("s{k:02}_{quantity}");
        let Some(structure) = file.structure(&key("")) else { break };
        let virial = file.read(&key("virial")).or_else(|| {
            let s = file.read::<f64>(&key("stress"))?;
            let volume = structure.cell.volume();
            Some([s[0], s[1], s[2], s[5], s[4], s[3]].map(|s| -s * volume).to_vec())
        });
        all.push(Golden {
            energy: file.floats(&key("energy"))[0],
            atomic_energies: file.read(&key("atomic_energy")),
            forces: file.floats(&key("forces")),
            virial,
            features: file.read(&key("features")),
            sigma: file.floats(&key("sigma")),
            gamma: file.floats(&key("gamma")),
            gamma_gradient: file.floats(&key("dsigma_dr")),
            gamma_virial: file.floats(&key("virial_sigma")),
            structure,
        });
    }
    all
}

/// xx, yy, zz, xy, xz, yz of a symmetric tensor.
pub fn six(tensor: &Matrix3) -> [f64; 6] {
    [tensor[0][0], tensor[1][1], tensor[2][2], tensor[0][1], tensor[0][2], tensor[1][2]]
}

/// The part of a model's mixture that a gradient of Σγ needs.
pub struct Mixture {
    pub components: usize,
    pub dimension: usize,
    centroids: Vec<f32>,
    inverse_covariances: Vec<f32>,
    thresholds: Vec<f32>,
}

impl Mixture {
    pub fn read(model: &Path) -> Self {
        let mut file = Npz::open(model.join("kokkos.npz"));
        let count = |x: Vec<i64>| x[0] as usize;
        Self {
            components: count(file.read("uq_max_clusters").unwrap()),
            dimension: count(file.read("uq_feature_dim").unwrap()),
            centroids: file.read("uq_centroids").unwrap(),
            inverse_covariances: file.read("uq_inv_cov").unwrap(),
            thresholds: file.read("uq_interp_thresholds").unwrap(),
        }
    }

    /// σ, γ and ∂γ/∂z of one atom with the component of the nearest centroid held fixed:
    /// σ = √(δᵀSδ + 10⁻⁸), γ = σ / max(θ, 10⁻¹⁰).
    pub fn grade(&self, element: usize, z: &[f64]) -> (f64, f64, Vec<f64>) {
        let d = self.dimension;
        let delta = |k: usize| -> Vec<f64> {
            let slot = element * self.components + k;
            let centroid = &self.centroids[slot * d..(slot + 1) * d];
            z.iter().zip(centroid).map(|(z, c)| z - f64::from(*c)).collect()
        };
        let square = |delta: &[f64]| delta.iter().map(|x| x * x).sum::<f64>();
        let distances: Vec<f64> = (0..self.components).map(|k| square(&delta(k))).collect();
        let nearest = (0..self.components).min_by(|a, b| distances[*a].total_cmp(&distances[*b]));
        let (delta, slot) = (delta(nearest.unwrap()), element * self.components + nearest.unwrap());
        let s = |i: usize, j: usize| f64::from(self.inverse_covariances[(slot * d + i) * d + j]);
        let both = |i: usize| (0..d).map(|j| (s(i, j) + s(j, i)) * delta[j]).sum::<f64>();
        let both: Vec<f64> = (0..d).map(both).collect();
        let quadratic: f64 = both.iter().zip(&delta).map(|(b, x)| 0.5 * b * x).sum();
        let sigma = (quadratic + 1e-8).sqrt();
        let threshold = f64::from(self.thresholds[slot]).max(1e-10);
        (sigma, sigma / threshold, both.iter().map(|b| b / (2.0 * sigma * threshold)).collect())
    }
}
