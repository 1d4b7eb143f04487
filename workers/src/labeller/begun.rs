//! A calculation that was begun, wherever it runs.

use std::path::Path;

use serde::{Deserialize, Serialize};
use store::StoreError;

use super::code::{blocking, file};
use super::here::{self, Kept};
use super::keeper::End;
use super::slurm::{Job, Slurm};

/// What finds a calculation again.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(untagged)]
pub(super) enum Begun {
    /// A process of a host.
    Here(Kept),
    /// A job of a cluster.
    Slurm(Job),
}

/// What is found of one.
#[derive(Debug, PartialEq)]
pub(super) enum Found {
    /// It has ended, and waits to be read.
    Ended(End),
    Running,
    /// Everything is there for it to begin.
    Ready,
    /// It was broken off, or is cleared away.
    Gone,
    /// Nobody can know from here.
    Elsewhere,
}

impl Begun {
    /// From what the store has; none for what nobody understands.
    pub fn parse(text: &str) -> Option<Self> {
        serde_json::from_str(text).ok()
    }

    /// As the store keeps it.
    pub fn identity(&self) -> String {
        serde_json::to_string(self).expect("plain data becomes JSON")
    }

    pub fn directory(&self) -> &Path {
        match self {
            Self::Here(kept) => &kept.directory,
            Self::Slurm(job) => &job.directory,
        }
    }

    pub async fn look(&self, slurm: &Slurm) -> Result<Found, StoreError> {
        match self {
            Self::Here(kept) => Ok(kept.look()),
            Self::Slurm(job) => slurm.look(job).await,
        }
    }

    /// Waits for the end; `None` if it was broken off.
    pub async fn end(&self, slurm: &Slurm) -> Result<Option<End>, StoreError> {
        match self {
            Self::Here(kept) => Ok(kept.end().await),
            Self::Slurm(job) => slurm.end(job).await,
        }
    }

    /// Ends whatever is left of it, and removes its directory.
    pub async fn clear(&self, slurm: &Slurm) -> Result<(), StoreError> {
        if let Self::Slurm(job) = self {
            slurm.cancel(job).await?;
        }
        self.clone().remove().await
    }

    /// Removes the directory of one that has ended.
    pub async fn remove(self) -> Result<(), StoreError> {
        let directory = self.directory().to_owned();
        let removed = blocking(move || match self {
            Self::Here(kept) => kept.clear(),
            // What a node has not let go of yet is cleared away later.
            Self::Slurm(job) => {
                here::remove(&job.directory);
                Ok(())
            }
        });
        removed.await.map_err(|error| file(&directory, error))
    }
}
