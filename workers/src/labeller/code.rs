//! Labels made by another program: calculations that outlive the labeller that started them.

use std::collections::BTreeSet;
use std::io;
use std::path::Path;
use std::process::Child;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use atoms::Structure;
use dft::{CalculationSize, DftBackend, Failure, FailureClass};
use store::records::Lease;
use store::{Store, StoreError};
use tokio::sync::OnceCell;
use tokio_util::sync::CancellationToken;

use super::batch_access::BatchAccess;
use super::blocking::blocking;
use super::calculation_handle::CalculationHandle;
use super::calculation_request::{CalculationNote, CalculationRequest};
use super::calculation_runner::{Calculation, CalculationEnd, EndReason, WORK};
use super::calculation_state::{CalculationState, EarlierStep};
use super::custom_jobs::CustomJob;
use super::failure_classes::failure_classes;
use super::file_error::file_error;
use super::label_attempt::{EndedCalculation, LabelAttempt, SingleLabel};
use super::local;
use super::prepare::{PreparedInput, prepare, read, write};
use super::retry_decision::next_adjustments;
use super::scratch::{self, ScratchRoot};
use super::slurm;
use super::{BatchSystem, ExecutionSettings, RunnerCommand, log, private_directory, retry_until_written};

/// Minimum time allowed for reading results, even if the calculation used up its time limit.
const MIN_READ_TIME: Duration = Duration::from_secs(60);
/// Time allowed for reading results after a stop request.
const READ_GRACE: Duration = Duration::from_secs(5);

/// Labels by another program, and how to run it.
pub struct CodeMethod {
    code: Arc<dyn DftBackend>,
    execution: ExecutionSettings,
    runner: RunnerCommand,
    /// Where the calculations of this campaign are.
    root: OnceCell<ScratchRoot>,
    current: Mutex<Option<CurrentCalculation>>,
    batch: BatchAccess,
}

/// A calculation that this labeller waits for.
struct CurrentCalculation {
    handle: CalculationHandle,
    /// Its runner, if this process started it and must reap it.
    runner: Option<Child>,
}

/// A calculation that is ready to start.
enum PreparedCalculation {
    Local(local::PreparedRunner),
    Slurm(slurm::CalculationJob),
    Custom(CustomJob),
}

impl CodeMethod {
    pub(super) fn new(
        runner: RunnerCommand,
        code: Box<dyn DftBackend>,
        execution: ExecutionSettings,
    ) -> Self {
        let (root, current, batch) = (OnceCell::new(), Mutex::default(), BatchAccess::new(&execution));
        Self { code: code.into(), execution, runner, root, current, batch }
    }

    pub(super) fn size(&self, structure: &Structure) -> CalculationSize {
        self.code.size(structure)
    }

    /// Finds the calculation that an earlier attempt started here, or starts one, and waits for its end. `None` if
    /// its results could not be read within seconds after a stop request.
    ///
    /// # Errors
    /// Errors of the database, and if no calculation can be started on this host, whatever the structure.
    pub(super) async fn make(
        &self,
        store: &Store,
        lease: &Lease,
        stop: &CancellationToken,
    ) -> Result<Option<LabelAttempt>, StoreError> {
        let request = CalculationRequest {
            structure: &lease.structure,
            job: lease.job,
            attempt: lease.attempt,
            failures: failure_classes(&lease.failures),
            earlier: &lease.earlier_calculations,
            failed: &lease.failed_calculations,
            record: CalculationNote::Lease(lease),
        };
        self.calculate(store, request, stop).await
    }

    /// The same for a calculation of the queue or outside it.
    pub(super) async fn calculate(
        &self,
        store: &Store,
        request: CalculationRequest<'_>,
        stop: &CancellationToken,
    ) -> Result<Option<LabelAttempt>, StoreError> {
        let CalculationRequest { structure, job, attempt, failures, earlier, failed, record } = request;
        let prepared = match self.prepare(structure.clone(), failures).await {
            Ok(prepared) => prepared,
            Err(failure) => return Ok(Some(LabelAttempt { result: Err(failure), ended: None })),
        };
        let record = async |handle: &CalculationHandle| {
            let identity = handle.identity();
            match record {
                CalculationNote::Lease(lease) => {
                    retry_until_written(stop, || store.record_calculation(lease, &identity, &prepared.record))
                        .await
                }
                CalculationNote::Progress(key, progress) => {
                    progress.record_calculation(store, key, identity, stop).await
                }
            }
        };
        let handle = match self.find(earlier).await? {
            Some((handle, found)) => {
                self.take(handle.clone(), None);
                record(&handle).await?;
                if found == CalculationState::Ready {
                    handle.submit(&self.batch).await?;
                }
                handle
            }
            None => {
                let directory = self.scratch_root(store, stop).await?.make(job, attempt)?;
                let ready = self.prepare_directory(&directory, &prepared, &failed_nodes(failed)).await?;
                record(&ready.handle()).await?;
                self.start(ready).await?
            }
        };
        let outcome = self.outcome(structure.clone(), handle, prepared.time_limit, stop).await?;
        let Some(attempt) = outcome else { return Ok(None) };
        if let Some(failed) = failed_on_node(&attempt) {
            record(&failed).await?;
        }
        Ok(Some(attempt))
    }

    /// A calculation outside a campaign.
    pub(super) async fn single_label(&self, structure: &Structure) -> Result<SingleLabel, StoreError> {
        let none = |result| SingleLabel { result, log: String::new(), core_seconds: 0.0 };
        let prepared = match self.prepare(structure.clone(), Vec::new()).await {
            Ok(prepared) => prepared,
            Err(failure) => return Ok(none(Err(failure))),
        };
        let root = private_directory::make(&self.execution.scratch(), "calmwalk-once-")?;
        let attempt = self.single_label_in(&root, structure, &prepared).await;
        self.cancel().await?;
        scratch::remove_empty(&root);
        let LabelAttempt { result, ended } = attempt?;
        Ok(match ended {
            Some(EndedCalculation { core_seconds, log, .. }) => SingleLabel { result, log, core_seconds },
            None => none(result),
        })
    }

    async fn single_label_in(
        &self,
        root: &Path,
        structure: &Structure,
        prepared: &PreparedInput,
    ) -> Result<LabelAttempt, StoreError> {
        let directory = private_directory::make_inside(root, &scratch::name(1, 1))
            .map_err(|error| file_error(root, error))?;
        let handle = self.start(self.prepare_directory(&directory, prepared, &[]).await?).await?;
        let never = CancellationToken::new();
        let attempt = self.outcome(structure.clone(), handle, prepared.time_limit, &never).await?;
        Ok(attempt.expect("no stop is requested"))
    }

    /// Everything that is needed before anything is started.
    async fn prepare(
        &self,
        structure: Structure,
        failures: Vec<FailureClass>,
    ) -> Result<PreparedInput, Failure> {
        let remedies = next_adjustments(&failures)?;
        let (code, execution) = (Arc::clone(&self.code), self.execution.clone());
        blocking(move || prepare(&*code, &execution, &structure, &remedies)).await
    }

    /// The directory of this campaign's calculations, after removing what killed labellers left there.
    pub(super) async fn scratch_root(
        &self,
        store: &Store,
        stop: &CancellationToken,
    ) -> Result<&ScratchRoot, StoreError> {
        let make = async || {
            let campaign = retry_until_written(stop, || store.campaign()).await?.id;
            let root = ScratchRoot::for_campaign(&self.execution.scratch(), campaign);
            root.prepare()?;
            root.cleanup(store, self.execution.keep, &self.batch, stop).await?;
            Ok(root)
        };
        self.root.get_or_try_init(make).await
    }

    /// Removes empty directories.
    pub(super) fn end(&self) {
        if let Some(root) = self.root.get() {
            root.remove_empty();
        }
    }

    /// The newest of these calculations that is running, or has ended and can be read. Removes what is left of the
    /// others.
    async fn find(
        &self,
        earlier: &[String],
    ) -> Result<Option<(CalculationHandle, CalculationState)>, StoreError> {
        // A calculation that was taken over is recorded by each attempt that waited for it.
        let mut named = BTreeSet::new();
        let known = earlier.iter().filter_map(|text| CalculationHandle::parse(text));
        let once: Vec<_> = known.filter(|handle| named.insert(handle.directory().to_owned())).collect();
        let mut found = None;
        for handle in once {
            let state = handle.inspect(&self.batch).await?;
            match state.of_earlier(found.is_some()) {
                EarlierStep::Leave => {}
                EarlierStep::Clear => handle.clear(&self.batch).await?,
                EarlierStep::Take => found = Some((handle, state)),
            }
        }
        Ok(found)
    }

    /// Writes the input into a directory and prepares the runner or job.
    async fn prepare_directory(
        &self,
        directory: &Path,
        prepared: &PreparedInput,
        failed_on: &[String],
    ) -> Result<PreparedCalculation, StoreError> {
        let PreparedInput { input, time_limit, memory_limit, avoids_nodes, .. } = prepared;
        let mut environment: Vec<_> = input.environment.clone().into_iter().collect();
        let (cores, gpus) = (self.execution.cores, self.execution.gpus);
        environment.push(("CALMWALK_CORES".to_owned(), cores.to_string()));
        environment.extend((gpus > 0).then(|| ("CALMWALK_GPUS".to_owned(), gpus.to_string())));
        let calculation = Calculation {
            directory: directory.to_owned(),
            command: input.command.clone(),
            environment,
            pass_environment: self.execution.pass_environment.clone(),
            time_limit: *time_limit,
            memory_limit: *memory_limit,
            runner: self.runner.clone(),
        };
        let unused = |error| {
            local::remove(directory);
            error
        };
        write(directory, input).map_err(unused)?;
        let ready = match self.execution.batch_system {
            None => local::PreparedRunner::spawn(calculation).map(PreparedCalculation::Local),
            Some(BatchSystem::Slurm) => {
                let options = self.execution.batch_options.as_slice();
                let avoid = if *avoids_nodes { failed_on } else { &[] };
                let requirements = slurm::JobRequirements { cores, gpus, options, avoid };
                let job = self.batch.slurm.job(directory).await?;
                slurm::write(calculation, &requirements).map(|()| PreparedCalculation::Slurm(job))
            }
            Some(BatchSystem::Custom) => match &self.batch.custom {
                Some(custom) => custom.prepare(calculation, cores, gpus).map(PreparedCalculation::Custom),
                None => {
                    Err(io::Error::other("label.batch_system is \"custom\", but there is no launch.custom"))
                }
            },
        };
        ready.map_err(|error| unused(file_error(directory, error)))
    }

    /// Starts the calculation.
    async fn start(&self, ready: PreparedCalculation) -> Result<CalculationHandle, StoreError> {
        let handle = ready.handle();
        match ready {
            PreparedCalculation::Local(ready) => {
                let runner = ready.start().map_err(|error| file_error(handle.directory(), error))?;
                self.take(handle.clone(), Some(runner));
            }
            PreparedCalculation::Slurm(_) | PreparedCalculation::Custom(_) => {
                self.take(handle.clone(), None);
                handle.submit(&self.batch).await?;
            }
        }
        Ok(handle)
    }

    /// Waits for the end of a calculation of at most `time_limit` s and reads its results; `None` if that takes too
    /// long after a stop request.
    async fn outcome(
        &self,
        structure: Structure,
        handle: CalculationHandle,
        time_limit: f64,
        stop: &CancellationToken,
    ) -> Result<Option<LabelAttempt>, StoreError> {
        let Some(end) = handle.wait(&self.batch).await? else {
            return self.lost_calculation(handle).await.map(Some);
        };
        let left = Duration::try_from_secs_f64(time_limit - end.seconds).unwrap_or_default();
        tokio::select! {
            attempt = self.read(structure, handle, end, left.max(MIN_READ_TIME)) => attempt.map(Some),
            () = async {
                stop.cancelled().await;
                tokio::time::sleep(READ_GRACE).await;
            } => Ok(None),
        }
    }

    /// Reads and validates the results of a calculation that has ended, within a time limit.
    async fn read(
        &self,
        structure: Structure,
        handle: CalculationHandle,
        end: CalculationEnd,
        limit: Duration,
    ) -> Result<LabelAttempt, StoreError> {
        let (code, directory) = (Arc::clone(&self.code), handle.directory().join(WORK));
        let exit = match end.how {
            EndReason::NotStarted(number) => {
                handle.remove().await?;
                self.reap();
                return Err(file_error(&end.program, io::Error::from_raw_os_error(number)));
            }
            EndReason::Ended(exit) => exit,
        };
        let reading = blocking(move || (read(&*code, &structure, &directory, exit), log::tail(&directory)));
        let (mut result, log) = tokio::time::timeout(limit, reading).await.unwrap_or_else(|_| {
            let message = format!("its results could not be read within {:.0} s", limit.as_secs_f64());
            (Err(FailureClass::TimeLimit.with_message(message)), String::new())
        });
        if let Err(Failure { class: FailureClass::OtherProgram, message }) = &result {
            // Whatever the structure: calculations on this host would not follow the protocol.
            let error = file_error(&end.program, io::Error::other(message.clone()));
            handle.remove().await?;
            self.reap();
            return Err(error);
        }
        if let (Err(failure), Some(remark)) = (&mut result, &end.remark) {
            failure.message.clone_from(remark);
        }
        let core_seconds = end.seconds * f64::from(self.execution.cores);
        Ok(LabelAttempt {
            result,
            ended: Some(EndedCalculation { core_seconds, log, node: end.node, handle }),
        })
    }

    /// The runner was killed, which says nothing about the job.
    async fn lost_calculation(&self, handle: CalculationHandle) -> Result<LabelAttempt, StoreError> {
        handle.clear(&self.batch).await?;
        self.reap();
        let result =
            Err(FailureClass::NodeFailure.with_message("the process that kept the calculation was killed"));
        Ok(LabelAttempt { result, ended: None })
    }

    fn take(&self, handle: CalculationHandle, runner: Option<Child>) {
        *self.current() = Some(CurrentCalculation { handle, runner });
    }

    /// The handle of the current calculation, in the form of the store.
    pub(super) fn calculation(&self) -> Option<String> {
        self.current().as_ref().map(|current| current.handle.identity())
    }

    /// Leaves the current calculation running without this labeller.
    pub(super) fn detach(&self) {
        self.current().take();
    }

    /// Ends a calculation that was recorded in this form, and removes what is left of it.
    pub(super) async fn give_up(&self, calculation: &str) -> Result<(), StoreError> {
        match CalculationHandle::parse(calculation) {
            Some(handle) => handle.clear(&self.batch).await,
            None => Ok(()),
        }
    }

    /// Ends the current calculation and removes what is left of it.
    pub(super) async fn cancel(&self) -> Result<(), StoreError> {
        let handle = self.current().as_ref().map(|current| current.handle.clone());
        if let Some(handle) = handle {
            handle.clear(&self.batch).await?;
            self.reap();
            if let Some(root) = handle.directory().parent() {
                scratch::remove_empty(root);
            }
        }
        Ok(())
    }

    /// Reaps the runner of the current calculation.
    fn reap(&self) {
        let current = self.current().take();
        if let Some(mut runner) = current.and_then(|current| current.runner) {
            // It has ended, or is about to.
            let _ = runner.wait();
        }
    }

    /// After the result is stored: packs the directory into the store if it is to be kept, and removes it.
    pub(super) async fn archive(
        &self,
        store: &Store,
        lease: &Lease,
        stop: &CancellationToken,
        ended: EndedCalculation,
        failed: bool,
    ) -> Result<(), StoreError> {
        if self.execution.keep.keeps(failed) {
            scratch::pack(store, lease.job, lease.attempt, stop, ended.handle.directory()).await?;
        }
        self.discard(ended).await
    }

    /// Removes the directory of a calculation whose result is stored.
    pub(super) async fn discard(&self, ended: EndedCalculation) -> Result<(), StoreError> {
        ended.handle.remove().await?;
        self.reap();
        Ok(())
    }

    fn current(&self) -> MutexGuard<'_, Option<CurrentCalculation>> {
        self.current.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// Nodes where these calculations failed and another node may help.
fn failed_nodes(failed: &[String]) -> Vec<String> {
    let failed = failed.iter().filter_map(|text| CalculationHandle::parse(text));
    let nodes = failed.filter_map(|handle| match handle {
        CalculationHandle::Slurm(job) => job.node,
        CalculationHandle::Local(_) | CalculationHandle::Custom(_) => None,
    });
    nodes.collect::<BTreeSet<_>>().into_iter().collect()
}

/// The handle of a calculation that failed and may succeed on another node, with its node.
fn failed_on_node(attempt: &LabelAttempt) -> Option<CalculationHandle> {
    use FailureClass::{Crashed, NodeFailure, OutOfMemory};
    let LabelAttempt {
        result: Err(failure),
        ended: Some(EndedCalculation { handle: CalculationHandle::Slurm(job), node, .. }),
    } = attempt
    else {
        return None;
    };
    let may_help = matches!(failure.class, Crashed | NodeFailure | OutOfMemory) && node.is_some();
    may_help.then(|| CalculationHandle::Slurm(slurm::CalculationJob { node: node.clone(), ..job.clone() }))
}

impl PreparedCalculation {
    fn handle(&self) -> CalculationHandle {
        match self {
            Self::Local(ready) => CalculationHandle::Local(ready.handle.clone()),
            Self::Slurm(job) => CalculationHandle::Slurm(job.clone()),
            Self::Custom(job) => CalculationHandle::Custom(job.clone()),
        }
    }
}
