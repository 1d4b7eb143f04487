//! Leases of a labeller: how it gets, renews and releases them.

use store::records::Lease;
use store::{LeaseStatus, StoreError};

use super::super::fault::ClientKind;
use super::super::planted::PlantedBug;
use super::super::world::World;
use super::{
    LEASE, Labeller, POLL_INTERVAL, PROTOCOL, Phase, RENEWAL_INTERVAL, REPLACED_AFTER, RETRY_INTERVAL,
};

impl World {
    /// Says which leases a labeller knows of. The database's reply to a commit may have been lost.
    pub(super) fn state_leases(&mut self, id: u32, held: &[&Lease]) -> Result<usize, StoreError> {
        if self.bug == Some(PlantedBug::LostLeaseForgotten) {
            return Ok(0);
        }
        let (holder, wall) = (self.labellers[&id].record.id.clone(), self.wall_clock());
        // Usually nothing is written.
        self.store.write(self.now, ClientKind::Labeller, "leases are stated", async |store| {
            store.state_leases(&holder, held, wall).await
        })
    }

    pub(super) fn labeller_polls(&mut self, id: u32) {
        let (now, wall) = (self.now, self.wall_clock());
        let labeller = &self.labellers[&id];
        if labeller.stop {
            return self.labeller_continues(id, Phase::Leaves, 0);
        }
        let (holder, no_more_jobs, number) =
            (labeller.record.id.clone(), labeller.no_more_jobs, labeller.number);
        let polled = self.state_leases(id, &[]).and_then(|_| {
            if !self.store.read(now, async |store| store.has_pending_labels(wall).await)? {
                return Ok((None, no_more_jobs));
            }
            let lease = self.store.write(now, ClientKind::Labeller, "a lease", async |store| {
                store.lease(PROTOCOL, &holder, wall, LEASE).await
            })?;
            Ok((lease, false))
        });
        match polled {
            Ok((None, true)) => self.labeller_continues(id, Phase::Leaves, 0),
            Ok((None, false)) => self.labeller_continues(id, Phase::Idle, POLL_INTERVAL),
            Ok((Some(lease), _)) => {
                let (job, attempt) = (lease.job, lease.attempt);
                self.tell(format!("labeller {number} (process {id}) leases job {job}, attempt {attempt}"));
                self.check_not_replaced(id);
                self.labeller_begins_job(id, Box::new(lease));
            }
            Err(error) => self.labeller_retries(id, Phase::Idle, &error),
        }
    }

    /// A labeller that was replaced, and could know it, leases nothing.
    fn check_not_replaced(&mut self, id: u32) {
        let Labeller { number, stopped_until, .. } = self.labellers[&id];
        let newer = self.labellers.range(id + 1..).filter(|(_, other)| other.number == number);
        let since = newer.filter_map(|(_, other)| Some(other.registered?.max(stopped_until))).min();
        let reachable = self.store.away_until.max(self.store.full_until);
        if since.is_some_and(|since| self.now > since.max(reachable) + REPLACED_AFTER) {
            self.fail(format!("labeller process {id} leases a job although it was replaced"));
        }
    }

    /// Renews a lease. If it was lost, finds out whether the result is still needed.
    pub(super) fn labeller_renews(
        &mut self,
        id: u32,
        lease: Box<Lease>,
        calculation: Option<String>,
        mut held: bool,
    ) {
        let (now, wall) = (self.now, self.wall_clock());
        let stop = self.labellers[&id].stop;
        if let Some(calculation) = calculation.as_ref().filter(|_| stop) {
            self.tell(format!("labeller process {id} leaves calculation {calculation} running"));
            self.slurm.drop_task(id);
            return self.labeller_continues(id, Phase::Releases, 0);
        }
        if held {
            let renewed = self.store.write(now, ClientKind::Labeller, "a lease is renewed", async |store| {
                store.renew(&lease, wall, LEASE).await
            });
            held = match renewed {
                Err(error) if !error.is_transient() => return self.fail(format!("renewal: {error}")),
                renewed => renewed.unwrap_or(true),
            };
            if self.bug == Some(PlantedBug::LeaseGivenTwice) {
                let requeue = sqlx::query(
                    "UPDATE job SET state = 'queued', holder = NULL, expires = NULL WHERE number = $1",
                );
                self.store.runtime.block_on(requeue.bind(lease.job).execute(&mut self.direct)).unwrap();
            }
        }
        let _ = self.state_leases(id, &[&lease]);
        if let Some(own) = calculation.as_ref().filter(|_| !held) {
            match self.store.read(now, async |store| store.lease_status(&lease).await) {
                Ok(LeaseStatus::Over) => {
                    self.tell(format!("labeller process {id} stops: the result is no longer needed"));
                    return self.labeller_stops_calculation(id, own.clone());
                }
                Ok(LeaseStatus::LeasedAgain { calculation: Some(other) }) if other == *own => {
                    self.slurm.drop_task(id);
                    return self.labeller_continues(id, Phase::Idle, 0);
                }
                _ => {}
            }
        }
        // It leaves as soon as it has a calculation.
        let pause = if stop { RETRY_INTERVAL } else { RENEWAL_INTERVAL };
        self.labeller_continues(id, Phase::Works { lease, calculation, held }, pause);
    }

    pub(super) fn labeller_releases(&mut self, id: u32) {
        let (holder, wall) = (self.labellers[&id].record.id.clone(), self.wall_clock());
        let released =
            self.store.write(self.now, ClientKind::Labeller, "leases are released", async |store| {
                store.release_all(&holder, wall).await
            });
        match released {
            Ok(_) => self.labeller_continues(id, Phase::Leaves, 0),
            Err(error) => self.labeller_retries(id, Phase::Releases, &error),
        }
    }
}
