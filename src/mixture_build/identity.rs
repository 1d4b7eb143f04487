//! What identifies a build: the command that continues it must have the same.

use atoms::Species;
use calm::Projection;
use calm::build::BuildSettings;
use serde::{Deserialize, Serialize};

use crate::campaign::instructions;
use crate::structure_files::{StructureFile, StructureFiles};

/// Changes when the state of an older program cannot be continued.
const FORMAT: u32 = 3;

/// Others round matrix products differently.
const INSTRUCTIONS: &str = "the list of the instruction sets of its processors";

const PROJECTION: &str = "the BLAKE3 hash of its projection";

/// Model, settings, names and weights of the data files, and how they are read. Their contents are compared when they are read, shard by shard.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Identity {
    format: u32,
    /// The instruction sets of the processor, on which the last digits of matrix products depend.
    instructions: String,
    /// BLAKE3 of the model's file.
    model: String,
    /// BLAKE3 of the projection of the features, which a model without one gets from the random seed.
    projection: String,
    pub settings: BuildSettings,
    files: Vec<DataFileIdentity>,
    /// `--where`
    filter: Option<String>,
    dump_elements: Vec<Species>,
}

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
struct DataFileIdentity {
    /// As given.
    path: String,
    weight: f64,
}

impl Identity {
    pub fn new(
        model: String,
        projection: &Projection,
        settings: BuildSettings,
        data: &StructureFiles,
    ) -> Self {
        let named = |file: &StructureFile| DataFileIdentity {
            path: file.path.display().to_string(),
            weight: file.weight,
        };
        Self {
            format: FORMAT,
            instructions: instructions(),
            model,
            projection: hash(projection),
            settings,
            files: data.files.iter().map(named).collect(),
            filter: data.filter.as_ref().map(ToString::to_string),
            dump_elements: data.dump_elements.clone(),
        }
    }

    /// Whether this processor can continue the build, whose model's file has this BLAKE3 hash.
    pub fn check_model(&self, hash: &str) -> Result<(), String> {
        same("the format of its state", self.format, FORMAT)?;
        same(INSTRUCTIONS, &self.instructions, &instructions())?;
        same("the BLAKE3 hash of its model", self.model.as_str(), hash)
    }

    /// Whether features have this projection.
    pub fn check_projection(&self, projection: &Projection) -> Result<(), String> {
        same(PROJECTION, self.projection.as_str(), &hash(projection))
    }

    /// Compares this build with the one that a state `began` with. An error names the first difference.
    pub fn check_same(&self, began: &Self) -> Result<(), String> {
        same("the format of its state", began.format, self.format)?;
        same(INSTRUCTIONS, &began.instructions, &self.instructions)?;
        same("the BLAKE3 hash of its model", &began.model, &self.model)?;
        let (old, new) = (&began.settings, &self.settings);
        same("its number of features", old.dimension, new.dimension)?;
        same("its --rng-seed", old.seed, new.seed)?;
        same(PROJECTION, &began.projection, &self.projection)?;
        same("its --candidates", list(&old.candidates), list(&new.candidates))?;
        same("its --shard-size", old.shard_size, new.shard_size)?;
        let names = |files: &[DataFileIdentity]| -> String {
            files.iter().map(|file| file.path.as_str()).collect::<Vec<_>>().join(" ")
        };
        same("its list of data files", names(&began.files), names(&self.files))?;
        for (old, new) in began.files.iter().zip(&self.files) {
            same(&format!("the --weight of {}", old.path), old.weight, new.weight)?;
        }
        let text = |filter: &Option<String>| filter.clone().unwrap_or_else(|| "absent".to_owned());
        same("its --where", text(&began.filter), text(&self.filter))?;
        let symbols =
            |species: &[Species]| species.iter().map(|one| one.symbol()).collect::<Vec<_>>().join(",");
        same("its --dump-elements", symbols(&began.dump_elements), symbols(&self.dump_elements))
    }
}

fn hash(projection: &Projection) -> String {
    blake3::hash(&projection.to_bytes()).to_string()
}

fn same<T: PartialEq + std::fmt::Display>(what: &str, began: T, now: T) -> Result<(), String> {
    if began == now { Ok(()) } else { Err(format!("{what} is {began}, now it is {now}")) }
}

fn list(candidates: &[usize]) -> String {
    candidates.iter().map(usize::to_string).collect::<Vec<_>>().join(",")
}

#[cfg(test)]
mod tests {
    use super::*;

    type Change = fn(&mut Identity);

    #[test]
    fn every_difference_is_named() {
        let settings = BuildSettings { dimension: 3, seed: 42, candidates: vec![1, 2], shard_size: 10 };
        let file = DataFileIdentity { path: "a.xyz".into(), weight: 1.0 };
        let began = Identity {
            format: FORMAT,
            instructions: "x86_64 avx2".into(),
            model: "abc".into(),
            projection: "def".into(),
            settings,
            files: vec![file],
            filter: None,
            dump_elements: Vec::new(),
        };
        assert_eq!(began.check_same(&began), Ok(()));
        let changes: [(Change, &str); 11] = [
            (|other| other.format = 0, "format"),
            (|other| other.instructions += " fma", "processors is x86_64 avx2, now it is x86_64 avx2 fma"),
            (|other| other.model = "x".into(), "model is abc, now it is x"),
            (|other| other.projection = "y".into(), "projection is def, now it is y"),
            (|other| other.settings.dimension = 4, "features"),
            (|other| other.settings.seed = 1, "--rng-seed is 42, now it is 1"),
            (|other| other.settings.candidates = vec![1], "--candidates is 1,2, now it is 1"),
            (|other| other.settings.shard_size = 1, "--shard-size"),
            (|other| other.files[0].weight = 0.5, "--weight of a.xyz is 1, now it is 0.5"),
            (|other| other.filter = Some("atoms < 9".into()), "--where is absent, now it is atoms < 9"),
            (|other| other.dump_elements = vec!["Al".parse().unwrap()], "--dump-elements is , now it is Al"),
        ];
        for (change, what) in changes {
            let mut other = began.clone();
            change(&mut other);
            let message = other.check_same(&began).unwrap_err();
            assert!(message.contains(what), "{message}");
        }
        let mut other = began.clone();
        other.files.clear();
        assert!(other.check_same(&began).unwrap_err().contains("list of data files"));
    }
}
