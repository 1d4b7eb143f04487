//! Labels by another program: calculations that outlive the labeller that began them.

use std::collections::BTreeSet;
use std::io;
use std::path::Path;
use std::process::Child;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use atoms::Structure;
use dft::{DftBackend, Failure, FailureClass, Size};
use store::records::Lease;
use store::{Store, StoreError};
use tokio::sync::OnceCell;
use tokio::task::spawn_blocking;

use super::begun::{Begun, Found};
use super::here;
use super::keeper::{Calculation, End, How, WORK};
use super::method::Made;
use super::prepare::{Prepared, prepare, read, write};
use super::scratch::{self, Home};
use super::slurm::{self, Slurm};
use super::{BatchSystem, Closing, KeeperCommand, Once, Running, insist, log, private};

/// How long results may be read at least, also where the calculation has taken all of its time.
const READING: Duration = Duration::from_secs(60);
/// And how long they are read when somebody asks to stop.
const LAST_READING: Duration = Duration::from_secs(5);

/// Another program, and how it is run.
pub struct CodeMethod {
    code: Arc<dyn DftBackend>,
    running: Running,
    keeper: KeeperCommand,
    /// Where the calculations of this campaign are.
    home: OnceCell<Home>,
    in_hand: Mutex<Option<InHand>>,
    slurm: Slurm,
}

/// A calculation that this labeller waits for.
struct InHand {
    begun: Begun,
    /// Its keeper, if this process started it, and so has to take note of its end.
    keeper: Option<Child>,
}

/// A calculation that has ended.
pub(super) struct Ended {
    pub core_seconds: f64,
    /// The end of what the program said.
    pub log: String,
    /// Where it ran, if a batch system had it run.
    node: Option<String>,
    begun: Begun,
}

/// A calculation that only waits for a word.
enum Ready {
    Here(here::Ready),
    Slurm(slurm::Job),
}

impl CodeMethod {
    pub(super) fn new(keeper: KeeperCommand, code: Box<dyn DftBackend>, running: Running) -> Self {
        let (home, in_hand, slurm) =
            (OnceCell::new(), Mutex::default(), Slurm::new(&running.pass_environment));
        Self { code: code.into(), running, keeper, home, in_hand, slurm }
    }

    pub(super) fn size(&self, structure: &Structure) -> Size {
        self.code.size(structure)
    }

    /// Finds the calculation that an earlier attempt began here, or starts one, and waits for its end. None if its results could
    /// not be read within seconds after `closing` asked to stop.
    ///
    /// # Errors
    /// Of the database; and where no calculation can be started here, whatever the structure.
    pub(super) async fn make(
        &self,
        store: &Store,
        lease: &Lease,
        closing: &Closing,
    ) -> Result<Option<Made>, StoreError> {
        let prepared = match self.prepare(lease.structure.clone(), classes(lease)).await {
            Ok(prepared) => prepared,
            Err(failure) => return Ok(Some(Made { result: Err(failure), ended: None })),
        };
        let record = async |begun: &Begun| {
            let identity = begun.identity();
            insist(closing, || store.record_calculation(lease, &identity, &prepared.record)).await
        };
        let begun = match self.find(&lease.earlier_calculations).await? {
            Some((begun, found)) => {
                self.take(begun.clone(), None);
                record(&begun).await?;
                if let (Begun::Slurm(job), Found::Ready) = (&begun, found) {
                    self.slurm.submit(job).await?;
                }
                begun
            }
            None => {
                let directory = self.home(store, closing).await?.make(lease.job, lease.attempt)?;
                let ready = self.ready(&directory, &prepared, &nodes(lease)).await?;
                record(&ready.begun()).await?;
                self.go(ready).await?
            }
        };
        let outcome = self.outcome(lease.structure.clone(), begun, prepared.time_limit, closing).await?;
        let Some(made) = outcome else { return Ok(None) };
        if let Some(failed) = failed_elsewhere(&made) {
            record(&failed).await?;
        }
        Ok(Some(made))
    }

    /// A calculation that no campaign knows of.
    pub(super) async fn once(&self, structure: &Structure) -> Result<Once, StoreError> {
        let none = |result| Once { result, log: String::new(), core_seconds: 0.0 };
        let prepared = match self.prepare(structure.clone(), Vec::new()).await {
            Ok(prepared) => prepared,
            Err(failure) => return Ok(none(Err(failure))),
        };
        let home = private::make(&self.running.scratch(), "calmwalk-once-")?;
        let made = self.once_in(&home, structure, &prepared).await;
        self.abandon().await?;
        scratch::remove_empty(&home);
        let Made { result, ended } = made?;
        Ok(match ended {
            Some(Ended { core_seconds, log, .. }) => Once { result, log, core_seconds },
            None => none(result),
        })
    }

    async fn once_in(
        &self,
        home: &Path,
        structure: &Structure,
        prepared: &Prepared,
    ) -> Result<Made, StoreError> {
        let directory =
            private::make_inside(home, &scratch::name(1, 1)).map_err(|error| file(home, error))?;
        let begun = self.go(self.ready(&directory, prepared, &[]).await?).await?;
        let never = Closing::default();
        let made = self.outcome(structure.clone(), begun, prepared.time_limit, &never).await?;
        Ok(made.expect("nobody asks to stop"))
    }

    /// Everything that is known before anything is started.
    async fn prepare(&self, structure: Structure, failures: Vec<FailureClass>) -> Result<Prepared, Failure> {
        let Some(remedies) = dft::adjustments(&failures) else {
            let class = failures.last().copied().unwrap_or(FailureClass::Crashed);
            return Err(class.with_message("there is nothing left to try"));
        };
        let (code, running) = (Arc::clone(&self.code), self.running.clone());
        blocking(move || prepare(&*code, &running, &structure, &remedies)).await
    }

    /// Where calculations of this campaign are; what killed ones have left there is tidied up first.
    pub(super) async fn home(&self, store: &Store, closing: &Closing) -> Result<&Home, StoreError> {
        let make = async || {
            let campaign = insist(closing, || store.campaign()).await?.id;
            let home = Home::of(&self.running.scratch(), campaign);
            home.prepare()?;
            home.tidy(store, self.running.keep, &self.slurm, closing).await?;
            Ok(home)
        };
        self.home.get_or_try_init(make).await
    }

    /// Leaves no empty directory behind.
    pub(super) fn end(&self) {
        if let Some(home) = self.home.get() {
            home.remove_empty();
        }
    }

    /// The newest of these calculations that goes on, or has ended and can be read. What is left of the others is removed.
    async fn find(&self, earlier: &[String]) -> Result<Option<(Begun, Found)>, StoreError> {
        // One that was taken over is named by each attempt that waited for it.
        let mut named = BTreeSet::new();
        let known = earlier.iter().filter_map(|text| Begun::parse(text));
        let once: Vec<_> = known.filter(|begun| named.insert(begun.directory().to_owned())).collect();
        let mut found = None;
        for begun in once {
            match begun.look(&self.slurm).await? {
                Found::Elsewhere => {}
                Found::Ended(End { how: How::NotStarted(_), .. }) | Found::Gone => {
                    begun.clear(&self.slurm).await?;
                }
                look if found.is_none() => found = Some((begun, look)),
                _ => begun.clear(&self.slurm).await?,
            }
        }
        Ok(found)
    }

    /// A directory with the input in it, and who waits for a word to begin.
    async fn ready(
        &self,
        directory: &Path,
        prepared: &Prepared,
        failed_on: &[String],
    ) -> Result<Ready, StoreError> {
        let Prepared { input, time_limit, memory_limit, avoids_nodes, .. } = prepared;
        let mut environment: Vec<_> = input.environment.clone().into_iter().collect();
        environment.push(("CALMWALK_CORES".to_owned(), self.running.cores.to_string()));
        let calculation = Calculation {
            directory: directory.to_owned(),
            command: input.command.clone(),
            environment,
            pass_environment: self.running.pass_environment.clone(),
            time_limit: *time_limit,
            memory_limit: *memory_limit,
            keeper: self.keeper.clone(),
        };
        let unused = |error| {
            here::remove(directory);
            error
        };
        write(directory, input).map_err(unused)?;
        let ready = match self.running.batch_system {
            None => here::Ready::start(calculation).map(Ready::Here),
            Some(BatchSystem::Slurm) => {
                let (cores, options) = (self.running.cores, self.running.batch_options.as_slice());
                let avoid = if *avoids_nodes { failed_on } else { &[] };
                let wanted = slurm::Wanted { cores, options, avoid };
                let job = self.slurm.job(directory).await?;
                slurm::write(calculation, &wanted).map(|()| Ready::Slurm(job))
            }
        };
        ready.map_err(|error| unused(file(directory, error)))
    }

    /// Has the calculation begin.
    async fn go(&self, ready: Ready) -> Result<Begun, StoreError> {
        let begun = ready.begun();
        match ready {
            Ready::Here(ready) => {
                let keeper = ready.go().map_err(|error| file(begun.directory(), error))?;
                self.take(begun.clone(), Some(keeper));
            }
            Ready::Slurm(job) => {
                self.take(begun.clone(), None);
                self.slurm.submit(&job).await?;
            }
        }
        Ok(begun)
    }

    /// Waits for the end of a calculation of at most `time_limit` s, and reads its numbers; none if that takes too long for
    /// somebody who wants to stop.
    async fn outcome(
        &self,
        structure: Structure,
        begun: Begun,
        time_limit: f64,
        closing: &Closing,
    ) -> Result<Option<Made>, StoreError> {
        let Some(end) = begun.end(&self.slurm).await? else { return self.broken_off(begun).await.map(Some) };
        let left = Duration::try_from_secs_f64(time_limit - end.seconds).unwrap_or_default();
        tokio::select! {
            made = self.read(structure, begun, end, left.max(READING)) => made.map(Some),
            () = async {
                closing.stopped().await;
                tokio::time::sleep(LAST_READING).await;
            } => Ok(None),
        }
    }

    /// Judges a calculation that has ended, and reads its numbers, for so long.
    async fn read(
        &self,
        structure: Structure,
        begun: Begun,
        end: End,
        limit: Duration,
    ) -> Result<Made, StoreError> {
        let (code, directory) = (Arc::clone(&self.code), begun.directory().join(WORK));
        let exit = match end.how {
            How::NotStarted(number) => {
                begun.remove().await?;
                self.reap();
                return Err(file(&end.program, io::Error::from_raw_os_error(number)));
            }
            How::Ended(exit) => exit,
        };
        let reading = blocking(move || (read(&*code, &structure, &directory, exit), log::tail(&directory)));
        let (mut result, log) = tokio::time::timeout(limit, reading).await.unwrap_or_else(|_| {
            let message = format!("its results could not be read within {:.0} s", limit.as_secs_f64());
            (Err(FailureClass::TimeLimit.with_message(message)), String::new())
        });
        if let Err(Failure { class: FailureClass::OtherProgram, message }) = &result {
            // Whatever the structure: no calculation here would be one of the protocol.
            let error = file(&end.program, io::Error::other(message.clone()));
            begun.remove().await?;
            self.reap();
            return Err(error);
        }
        if let (Err(failure), Some(remark)) = (&mut result, &end.remark) {
            failure.message.clone_from(remark);
        }
        let core_seconds = end.seconds * f64::from(self.running.cores);
        Ok(Made { result, ended: Some(Ended { core_seconds, log, node: end.node, begun }) })
    }

    /// Somebody killed the keeper, which says nothing about the job.
    async fn broken_off(&self, begun: Begun) -> Result<Made, StoreError> {
        begun.clear(&self.slurm).await?;
        self.reap();
        let result =
            Err(FailureClass::LostNode.with_message("the process that kept the calculation was killed"));
        Ok(Made { result, ended: None })
    }

    fn take(&self, begun: Begun, keeper: Option<Child>) {
        *self.in_hand() = Some(InHand { begun, keeper });
    }

    /// What is said of the calculation in hand in the store.
    pub(super) fn calculation(&self) -> Option<String> {
        self.in_hand().as_ref().map(|in_hand| in_hand.begun.identity())
    }

    /// It goes on without this labeller.
    pub(super) fn let_go(&self) {
        self.in_hand().take();
    }

    /// Ends it, and removes what is left of it.
    pub(super) async fn abandon(&self) -> Result<(), StoreError> {
        let begun = self.in_hand().as_ref().map(|in_hand| in_hand.begun.clone());
        if let Some(begun) = begun {
            begun.clear(&self.slurm).await?;
            self.reap();
            if let Some(home) = begun.directory().parent() {
                scratch::remove_empty(home);
            }
        }
        Ok(())
    }

    /// Takes note of the end of a keeper, so that nothing is left of it.
    fn reap(&self) {
        let in_hand = self.in_hand().take();
        if let Some(mut keeper) = in_hand.and_then(|in_hand| in_hand.keeper) {
            // It has ended, or is about to.
            let _ = keeper.wait();
        }
    }

    /// The result is where it belongs: the directory is packed into the store, or only removed.
    pub(super) async fn put_away(
        &self,
        store: &Store,
        lease: &Lease,
        closing: &Closing,
        ended: Ended,
        failed: bool,
    ) -> Result<(), StoreError> {
        if self.running.keep.keeps(failed) {
            scratch::pack(store, lease.job, lease.attempt, closing, ended.begun.directory()).await?;
        }
        ended.begun.remove().await?;
        self.reap();
        Ok(())
    }

    fn in_hand(&self) -> MutexGuard<'_, Option<InHand>> {
        self.in_hand.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// The classes of the failures of a job so far.
pub(super) fn classes(lease: &Lease) -> Vec<FailureClass> {
    lease.failures.iter().filter_map(|name| FailureClass::from_name(name)).collect()
}

/// Nodes on which a job failed, where another may help.
fn nodes(lease: &Lease) -> Vec<String> {
    let failed = lease.failed_calculations.iter().filter_map(|text| Begun::parse(text));
    let nodes = failed.filter_map(|begun| match begun {
        Begun::Slurm(job) => job.node,
        Begun::Here(_) => None,
    });
    nodes.collect::<BTreeSet<_>>().into_iter().collect()
}

/// A calculation that failed and may do better on another node, with the node that it had.
fn failed_elsewhere(made: &Made) -> Option<Begun> {
    use FailureClass::{Crashed, LostNode, OutOfMemory};
    let Made { result: Err(failure), ended: Some(Ended { begun: Begun::Slurm(job), node, .. }) } = made
    else {
        return None;
    };
    let may_help = matches!(failure.class, Crashed | LostNode | OutOfMemory) && node.is_some();
    may_help.then(|| Begun::Slurm(slurm::Job { node: node.clone(), ..job.clone() }))
}

impl Ready {
    fn begun(&self) -> Begun {
        match self {
            Self::Here(ready) => Begun::Here(ready.kept.clone()),
            Self::Slurm(job) => Begun::Slurm(job.clone()),
        }
    }
}

/// What takes time, in a thread of its own. If it panics, so does who waits for it.
pub(super) async fn blocking<T: Send + 'static>(work: impl FnOnce() -> T + Send + 'static) -> T {
    spawn_blocking(work).await.unwrap_or_else(|crash| std::panic::resume_unwind(crash.into_panic()))
}

/// What cannot be done here fails the labeller, and not the job: another host may have room for it.
pub(super) fn file(path: &Path, source: io::Error) -> StoreError {
    StoreError::File { path: path.to_owned(), source }
}
