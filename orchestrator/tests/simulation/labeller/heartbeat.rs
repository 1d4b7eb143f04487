//! Heartbeats of labellers.

use monitor::end_reason::is_refit_due;
use store::ProcessRecord;

use super::super::event::Event;
use super::super::fault::ClientKind;
use super::super::planted::PlantedBug;
use super::super::world::World;
use super::HEARTBEAT_INTERVAL;

impl World {
    /// Says that a labeller lives, and finds out whether it is still needed.
    pub fn labeller_heartbeat(&mut self, id: u32) {
        if !self.is_labeller_active(id, Event::LabellerHeartbeat(id)) {
            return;
        }
        let (now, wall) = (self.now, self.wall_clock());
        let continues = self.bug == Some(PlantedBug::ReplacedLabellerContinues);
        let labeller = self.labellers.get_mut(&id).unwrap();
        let sent = (|| {
            let others = self.store.read(now, async |store| store.processes(None).await)?;
            if !continues && others.iter().any(|other| other.replaces(&labeller.record)) {
                labeller.stop = true;
            }
            let led = others.iter().any(ProcessRecord::is_leading);
            labeller.no_more_jobs = match led {
                true => false,
                false => self.store.read(now, async |store| {
                    Ok(store.all_walks_ended().await? && !is_refit_due(store).await?)
                })?,
            };
            if !led {
                self.store.write(now, ClientKind::Labeller, "leases of dead processes", async |store| {
                    store.release_leases_of_dead_processes(wall).await
                })?;
            }
            labeller.record.last_seen = wall;
            if labeller.stop {
                labeller.record.state = "stopping".to_owned();
            }
            let record = labeller.record.clone();
            self.store.write(now, ClientKind::Labeller, "a heartbeat", async |store| {
                store.upsert_process(&record).await
            })
        })();
        match sent {
            Err(error) if !error.is_transient() => self.fail(format!("heartbeat: {error}")),
            _ => self.after(HEARTBEAT_INTERVAL, Event::LabellerHeartbeat(id)),
        }
    }
}
