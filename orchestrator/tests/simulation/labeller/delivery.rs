//! Results that a labeller delivers.

use store::records::{Label, Lease};
use store::{CompleteOutcome, FailOutcome};
use workers::labeller::decisions::{attempt_limit, counts_as_attempt};

use super::super::calculation::CalculationResult;
use super::super::fault::ClientKind;
use super::super::planted::PlantedBug;
use super::super::world::World;
use super::Phase;
use crate::common::ATOMS;

impl World {
    pub(super) fn labeller_delivers(
        &mut self,
        id: u32,
        lease: Box<Lease>,
        result: CalculationResult,
        calculation: Option<String>,
    ) {
        let (now, wall, client) = (self.now, self.wall_clock(), ClientKind::Labeller);
        let delivered = match result {
            CalculationResult::Label(energy) => {
                let forces = vec![[0.1, 0.2, 0.3]; ATOMS];
                let label = Label { energy, forces, stress: None, details: Default::default() };
                let outcome = self
                    .store
                    .write(now, client, "a label", async |store| store.complete(&lease, &label, wall).await);
                outcome.map(|outcome| match outcome {
                    CompleteOutcome::Label => "labelled".to_owned(),
                    CompleteOutcome::KeptAsCheck => "kept as a check".to_owned(),
                })
            }
            CalculationResult::Failure(class) => {
                let limit = attempt_limit(&lease.failures, class, self.attempts());
                let counts = counts_as_attempt(class) || self.bug == Some(PlantedBug::NodeFailuresCounted);
                let outcome = self.store.write(now, client, "a failure", async |store| match counts {
                    true => store.fail(&lease, class.name(), "log", limit, wall).await,
                    false => store.release_lost(&lease, class.name(), "log", wall).await,
                });
                if let Ok(FailOutcome::Failed) = outcome {
                    self.check_failed_job(lease.job);
                }
                outcome.map(|outcome| format!("{class}, {outcome:?}"))
            }
        };
        match delivered {
            Ok(what) => {
                self.tell(format!("labeller process {id} delivers job {}: {what}", lease.job));
                match calculation {
                    Some(calculation) => {
                        self.slurm.is_delivered(&calculation);
                        self.labeller_continues(id, Phase::Removes { calculation }, 200);
                    }
                    None => self.labeller_continues(id, Phase::Idle, 0),
                }
            }
            Err(error) => {
                self.labeller_retries(id, Phase::Delivers { lease, result, calculation }, &error);
            }
        }
    }
}
