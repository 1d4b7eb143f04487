//! The calculation of a labeller's job: found or started, recorded, waited for, and ended when it is not needed.

use dft::FailureClass;
use store::CalculationRecord;
use store::records::Lease;

use super::super::calculation::{CalculationResult, CalculationState};
use super::super::fault::ClientKind;
use super::super::planted::PlantedBug;
use super::super::world::World;
use super::{Labeller, Phase, RENEWAL_INTERVAL};

impl World {
    /// Finds an earlier calculation of the job, or prepares a new one.
    pub(super) fn labeller_begins_job(&mut self, id: u32, lease: Box<Lease>) {
        let adjustments = match self.adjustments_of(&lease) {
            Ok(adjustments) => adjustments,
            Err(class) => {
                let result = CalculationResult::Failure(class);
                return self.labeller_continues(id, Phase::Delivers { lease, result, calculation: None }, 0);
            }
        };
        if self.scenario.slurm {
            let phase = Phase::Works { lease: lease.clone(), calculation: None, held: true };
            self.labeller_continues(id, phase, RENEWAL_INTERVAL);
            let has_cleaned = self.labellers.get_mut(&id).map(|labeller| &mut labeller.has_cleaned);
            let cleans = has_cleaned.is_some_and(|cleaned| !std::mem::replace(cleaned, true));
            return self.begin_slurm_label(id, lease, adjustments, cleans);
        }
        let is_useful = |calculation: &&String| {
            let state = self.calculations.get(*calculation).map(|found| found.state);
            !lease.failed_calculations.contains(calculation)
                && matches!(state, Some(CalculationState::Running | CalculationState::Ended))
        };
        let looks = self.bug != Some(PlantedBug::CalculationNotLookedUp);
        let earlier = lease.earlier_calculations.iter().find(is_useful).filter(|_| looks).cloned();
        let is_new = earlier.is_none();
        let calculation = earlier.unwrap_or_else(|| format!("{}.{}", lease.job, lease.attempt));
        if is_new && self.bug == Some(PlantedBug::CalculationRecordedLate) {
            self.start_calculation(&calculation, lease.job);
            let delay = self.random.between(1_000, 3_000);
            return self.labeller_continues(id, Phase::Records { lease, calculation, is_new: false }, delay);
        }
        let delay = self.random.between(10, 500);
        self.labeller_continues(id, Phase::Records { lease, calculation, is_new }, delay);
    }

    /// Records the calculation, and starts it then.
    pub(super) fn labeller_records(&mut self, id: u32, lease: Box<Lease>, calculation: String, is_new: bool) {
        let made = CalculationRecord { cores: Some(1), ..CalculationRecord::default() };
        let name = calculation.as_str();
        let written =
            self.store.write(self.now, ClientKind::Labeller, "a calculation is recorded", async |store| {
                store.record_calculation(&lease, name, &made).await
            });
        if let Err(error) = written {
            return self.labeller_retries(id, Phase::Records { lease, calculation, is_new }, &error);
        }
        if is_new {
            self.start_calculation(&calculation, lease.job);
        }
        let is_over = self.calculations[&calculation].state != CalculationState::Running;
        let phase = Phase::Works { lease, calculation: Some(calculation.clone()), held: true };
        self.labeller_continues(id, phase, RENEWAL_INTERVAL);
        if is_over {
            self.wake_labellers_of(&calculation);
        }
    }

    /// Ends a calculation that is no longer needed.
    pub(super) fn labeller_stops_calculation(&mut self, id: u32, calculation: String) {
        if !self.scenario.slurm {
            self.remove_calculation(&calculation);
            return self.labeller_continues(id, Phase::Idle, 0);
        }
        self.labeller_continues(id, Phase::Stops, 0);
        self.begin_slurm_stop(id, calculation);
    }

    /// The lease on which a labeller works.
    pub fn lease_of(&self, id: u32) -> Option<Box<Lease>> {
        match &self.labellers.get(&id)?.phase {
            Phase::Works { lease, .. } => Some(lease.clone()),
            _ => None,
        }
    }

    /// A labeller has found or prepared the calculation for which it waits.
    pub fn labeller_takes(&mut self, id: u32, taken: String) {
        if let Some(Labeller { phase: Phase::Works { calculation, .. }, .. }) = self.labellers.get_mut(&id) {
            *calculation = Some(taken);
        }
    }

    /// A labeller has the result of its job.
    pub fn labeller_has_result(&mut self, id: u32, result: CalculationResult, calculation: Option<String>) {
        let Some(lease) = self.lease_of(id) else { return };
        let delay = self.random.between(5, 500);
        self.labeller_continues(id, Phase::Delivers { lease, result, calculation }, delay);
    }

    /// A calculation has ended: who waits for it delivers its result.
    pub fn wake_labellers_of(&mut self, ended: &str) {
        let waits = |labeller: &Labeller| match &labeller.phase {
            Phase::Works { lease, calculation: Some(own), .. } if own == ended => Some(lease.clone()),
            _ => None,
        };
        let waiting: Vec<_> =
            self.labellers.iter().filter_map(|(id, labeller)| Some((*id, waits(labeller)?))).collect();
        let calculation = &self.calculations[ended];
        let result = match calculation.state {
            CalculationState::Gone => CalculationResult::Failure(FailureClass::NodeFailure),
            _ => calculation.result,
        };
        for (id, lease) in waiting {
            let delay = self.random.between(5, 500);
            self.labeller_continues(id, Phase::Delivers { lease, result, calculation: None }, delay);
        }
    }
}
