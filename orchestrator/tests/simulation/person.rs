//! What persons do: with label jobs, and with walks.

use store::RelabelRequest;

use super::event::Event;
use super::fault::ClientKind;
use super::labeller::PROTOCOL;
use super::world::World;

impl World {
    pub fn drop_job(&mut self) {
        let jobs = self.store.runtime.block_on(self.store.store.queue_list(None, 100, 0)).unwrap();
        let open: Vec<_> =
            jobs.iter().filter(|job| ["queued", "leased"].contains(&job.state.name())).collect();
        if open.is_empty() {
            return;
        }
        let job = open[self.random.below(open.len() as u64) as usize];
        self.handled.insert(job.job);
        let (name, now) = (job.candidate.clone(), self.wall_clock());
        let dropped = self.store.write(self.now, ClientKind::Labeller, "a job is dropped", async |store| {
            store.drop_job(&name, now).await
        });
        self.tell(format!("job {} is dropped: {}", job.job, dropped.is_ok()));
    }

    pub fn retry_job(&mut self) {
        let jobs = self.store.runtime.block_on(self.store.store.queue_list(None, 100, 0)).unwrap();
        let open = jobs.iter().find(|job| ["failed", "dropped"].contains(&job.state.name()));
        let Some(job) = open else { return };
        self.handled.insert(job.job);
        let (name, now) = (job.candidate.clone(), self.wall_clock());
        let retried = self.store.write(self.now, ClientKind::Labeller, "a job is requeued", async |store| {
            store.retry_job(&name, now).await
        });
        self.tell(format!("job {} is requeued: {}", job.job, retried.is_ok()));
    }

    pub fn relabel(&mut self) {
        let now = self.wall_clock();
        self.slurm.ladders.forget();
        let relabelled =
            self.store.write(self.now, ClientKind::Labeller, "new labels are requested", async |store| {
                let labelled = store.relabellable(PROTOCOL).await?;
                let structures: Vec<_> = labelled.iter().map(|found| found.content).collect();
                let request = RelabelRequest {
                    structures: &structures,
                    include_current: true,
                    reason: "doubtful",
                    protocol: None,
                };
                store.relabel(&request, now).await?;
                Ok(structures.len())
            });
        self.tell(format!("new labels are requested: {relabelled:?}"));
    }

    /// A person tries again until it is done.
    pub fn pause_walks(&mut self, pause: bool) {
        let now = self.wall_clock();
        let result = self.store.write(self.now, ClientKind::Labeller, "walks are paused", async |store| {
            let walks = match pause {
                true => store.active_walks().await?,
                false => store.paused_walks().await?.into_iter().collect(),
            };
            if walks.is_empty() { Ok(walks) } else { store.pause_walks(&walks, pause, now).await }
        });
        if result.is_err() && !pause {
            self.after(1_000, Event::Resume);
        }
    }
}
