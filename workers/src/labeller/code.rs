//! Labels by another program: calculations that outlive the labeller that began them.

use std::collections::BTreeSet;
use std::fs;
use std::io;
use std::path::{Path, PathBuf};
use std::process::Child;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use atoms::Structure;
use dft::{Code, Failure, FailureClass, Size};
use store::records::Lease;
use store::{Store, StoreError};
use tokio::sync::OnceCell;
use tokio::task::spawn_blocking;

use super::here::{Found, Kept, Ready};
use super::keeper::{Calculation, End, How, WORK};
use super::method::Made;
use super::prepare::{Prepared, prepare, read, write};
use super::{Closing, KeeperCommand, Once, Running, insist, log, scratch};

/// Another program, and how it is run.
pub struct CodeMethod {
    code: Arc<dyn Code>,
    running: Running,
    keeper: KeeperCommand,
    /// Where the calculations of this campaign are.
    home: OnceCell<PathBuf>,
    in_hand: Mutex<Option<InHand>>,
}

/// A calculation that this labeller waits for.
struct InHand {
    kept: Kept,
    /// Its keeper, if this process started it, and so has to take note of its end.
    keeper: Option<Child>,
}

/// A calculation that has ended.
pub(super) struct Ended {
    pub core_seconds: f64,
    /// The end of what the program said.
    pub log: String,
    kept: Kept,
}

impl CodeMethod {
    pub(super) fn new(keeper: KeeperCommand, code: Box<dyn Code>, running: Running) -> Self {
        Self { code: code.into(), running, keeper, home: OnceCell::new(), in_hand: Mutex::default() }
    }

    pub(super) fn size(&self, structure: &Structure) -> Size {
        self.code.size(structure)
    }

    /// Finds the calculation that an earlier attempt began here, or starts one, and waits for its end.
    ///
    /// # Errors
    /// Of the database; and where no calculation can be started here, whatever the structure.
    pub(super) async fn make(
        &self,
        store: &Store,
        lease: &Lease,
        closing: &Closing,
    ) -> Result<Made, StoreError> {
        let prepared = match self.prepare(lease.structure.clone(), classes(lease)).await {
            Ok(prepared) => prepared,
            Err(failure) => return Ok(Made { result: Err(failure), ended: None }),
        };
        let record = async |kept: &Kept| {
            let identity = identity(kept);
            insist(closing, || store.record_calculation(lease, &identity, &prepared.record)).await
        };
        let home = self.home(store, closing).await?;
        let kept = match self.find(&lease.earlier_calculations).await? {
            Some(kept) => {
                self.take(kept.clone(), None);
                record(&kept).await?;
                kept
            }
            None => {
                let directory = home.join(scratch::name(lease.job, lease.attempt));
                let ready = self.ready(&directory, &prepared)?;
                record(&ready.kept).await?;
                self.go(ready)?
            }
        };
        match kept.end().await {
            Some(end) => self.read(lease.structure.clone(), kept, end).await,
            None => self.broken_off(kept).await,
        }
    }

    /// A calculation that no campaign knows of.
    pub(super) async fn once(&self, structure: &Structure) -> Result<Once, StoreError> {
        let none = |result| Once { result, log: String::new(), core_seconds: 0.0 };
        let prepared = match self.prepare(structure.clone(), Vec::new()).await {
            Ok(prepared) => prepared,
            Err(failure) => return Ok(none(Err(failure))),
        };
        let name = format!("calmwalk-once-{}", scratch::name(std::process::id().into(), 1));
        let kept = self.go(self.ready(&self.running.scratch().join(name), &prepared)?)?;
        let made = match kept.end().await {
            Some(end) => self.read(structure.clone(), kept, end).await,
            None => self.broken_off(kept).await,
        };
        self.abandon().await?;
        let Made { result, ended } = made?;
        Ok(match ended {
            Some(Ended { core_seconds, log, .. }) => Once { result, log, core_seconds },
            None => none(result),
        })
    }

    /// Everything that is known before anything is started.
    async fn prepare(&self, structure: Structure, failures: Vec<FailureClass>) -> Result<Prepared, Failure> {
        let Some(remedies) = dft::remedies(&failures) else {
            let class = failures.last().copied().unwrap_or(FailureClass::Crashed);
            return Err(class.because("there is nothing left to try"));
        };
        let (code, running) = (Arc::clone(&self.code), self.running.clone());
        blocking(move || prepare(&*code, &running, &structure, &remedies)).await
    }

    /// Where calculations of this campaign are; what killed ones have left there is tidied up first.
    pub(super) async fn home(&self, store: &Store, closing: &Closing) -> Result<&Path, StoreError> {
        let make = async || {
            let campaign = insist(closing, || store.campaign()).await?.id;
            let home = self.running.scratch().join(format!("calmwalk-{campaign}"));
            fs::create_dir_all(&home).map_err(|error| file(&home, error))?;
            scratch::tidy(store, &home, self.running.keep, closing).await?;
            Ok(home)
        };
        self.home.get_or_try_init(make).await.map(PathBuf::as_path)
    }

    /// The newest of these calculations that goes on here, or has ended and can be read. What is left of the others here
    /// is removed.
    async fn find(&self, earlier: &[String]) -> Result<Option<Kept>, StoreError> {
        // One that was taken over is named by each attempt that waited for it.
        let mut named = BTreeSet::new();
        let once = earlier.iter().filter(|text| named.insert(*text));
        let known: Vec<Kept> = once.filter_map(|text| serde_json::from_str(text).ok()).collect();
        let mut found = None;
        for kept in known {
            match kept.look() {
                Found::Elsewhere => {}
                Found::Ended(End { how: How::NotStarted(_), .. }) => clear(kept).await?,
                Found::Ended(_) | Found::Running if found.is_none() => found = Some(kept),
                _ => clear(kept).await?,
            }
        }
        Ok(found)
    }

    /// A directory with the input in it, and a keeper that waits.
    fn ready(&self, directory: &Path, prepared: &Prepared) -> Result<Ready, StoreError> {
        let Prepared { input, time_limit, memory_limit, .. } = prepared;
        let mut environment: Vec<_> = input.environment.clone().into_iter().collect();
        environment.push(("CALMWALK_CORES".to_owned(), self.running.cores.to_string()));
        let calculation = Calculation {
            directory: directory.to_owned(),
            command: input.command.clone(),
            environment,
            time_limit: *time_limit,
            memory_limit: *memory_limit,
            keeper: self.keeper.clone(),
        };
        let ready = write(directory, input).and_then(|()| Ready::start(calculation));
        ready.map_err(|error| file(directory, error))
    }

    /// Has the calculation begin.
    fn go(&self, ready: Ready) -> Result<Kept, StoreError> {
        let kept = ready.kept.clone();
        let keeper = ready.go().map_err(|error| file(&kept.directory, error))?;
        self.take(kept.clone(), Some(keeper));
        Ok(kept)
    }

    /// Judges a calculation that has ended, and reads its numbers.
    async fn read(&self, structure: Structure, kept: Kept, end: End) -> Result<Made, StoreError> {
        let (code, work) = (Arc::clone(&self.code), kept.directory.join(WORK));
        let directory = work.clone();
        let exit = match end.how {
            How::NotStarted(number) => {
                clear(kept).await?;
                self.reap();
                return Err(file(&end.program, io::Error::from_raw_os_error(number)));
            }
            How::Ended(exit) => exit,
        };
        let result = blocking(move || read(&*code, &structure, &directory, exit)).await;
        let core_seconds = end.seconds * f64::from(self.running.cores);
        Ok(Made { result, ended: Some(Ended { core_seconds, log: log::tail(&work), kept }) })
    }

    /// Somebody killed the keeper, which says nothing about the job.
    async fn broken_off(&self, kept: Kept) -> Result<Made, StoreError> {
        clear(kept).await?;
        self.reap();
        let result = Err(FailureClass::LostNode.because("the process that kept the calculation was killed"));
        Ok(Made { result, ended: None })
    }

    fn take(&self, kept: Kept, keeper: Option<Child>) {
        *self.in_hand() = Some(InHand { kept, keeper });
    }

    /// What is said of the calculation in hand in the store.
    pub(super) fn calculation(&self) -> Option<String> {
        self.in_hand().as_ref().map(|in_hand| identity(&in_hand.kept))
    }

    /// It goes on without this labeller.
    pub(super) fn let_go(&self) {
        self.in_hand().take();
    }

    /// Ends it, and removes what is left of it.
    pub(super) async fn abandon(&self) -> Result<(), StoreError> {
        let kept = self.in_hand().as_ref().map(|in_hand| in_hand.kept.clone());
        if let Some(kept) = kept {
            clear(kept).await?;
            self.reap();
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
            scratch::pack(store, lease.job, lease.attempt, closing, &ended.kept.directory).await?;
        }
        clear(ended.kept).await?;
        self.reap();
        Ok(())
    }

    fn in_hand(&self) -> MutexGuard<'_, Option<InHand>> {
        self.in_hand.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// The classes of the failures of a job so far.
pub(super) fn classes(lease: &Lease) -> Vec<FailureClass> {
    lease.failures.iter().filter_map(|name| FailureClass::named(name)).collect()
}

fn identity(kept: &Kept) -> String {
    serde_json::to_string(kept).expect("plain data becomes JSON")
}

/// Ends what is left of a calculation, and removes its directory.
async fn clear(kept: Kept) -> Result<(), StoreError> {
    let directory = kept.directory.clone();
    blocking(move || kept.clear()).await.map_err(|error| file(&directory, error))
}

/// What takes time, in a thread of its own. If it panics, so does who waits for it.
pub(super) async fn blocking<T: Send + 'static>(work: impl FnOnce() -> T + Send + 'static) -> T {
    spawn_blocking(work).await.unwrap_or_else(|crash| std::panic::resume_unwind(crash.into_panic()))
}

/// What cannot be done here fails the labeller, and not the job: another host may have room for it.
pub(super) fn file(path: &Path, source: io::Error) -> StoreError {
    StoreError::File { path: path.to_owned(), source }
}
