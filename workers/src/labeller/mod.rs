//! A labeller leases a job, has its method work on it, judges what comes of it and delivers.

pub mod reference;

use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use store::records::{Label, Lease, Protocol};
use store::{Store, StoreError};

pub use reference::{LabelFailure, ReferenceMethod};

/// How long a job is leased, seconds: longer than any reference label takes. What a dead process held is taken back
/// when the next one starts.
const LEASE_SECONDS: u32 = 86_400;
/// How long a labeller without work waits before it looks again.
const IDLE: Duration = Duration::from_millis(50);

/// What a labeller needs to know.
#[derive(Clone, Debug)]
pub struct LabellerSettings {
    /// Whose leases these are.
    pub holder: String,
    /// Under which settings labels are made.
    pub protocol: Protocol,
    /// Attempts before a label counts as failed.
    pub attempts: u32,
    /// Largest force that is believed, eV/Å.
    pub largest_force: f64,
}

/// When a labeller may go home.
#[derive(Debug, Default)]
pub struct Closing {
    /// No more jobs will be queued: go home once there are none.
    pub no_more_jobs: AtomicBool,
    /// Go home after the label in hand.
    pub stopping: AtomicBool,
}

/// Labels until there is nothing more to do.
pub async fn run(
    store: Store,
    mut method: ReferenceMethod,
    settings: LabellerSettings,
    closing: &Closing,
    now: impl Fn() -> i64,
) -> Result<(), StoreError> {
    while !closing.stopping.load(Ordering::Relaxed) {
        let last_look = closing.no_more_jobs.load(Ordering::Relaxed);
        let unfinished = store.unfinished_jobs().await?;
        if unfinished == 0 && last_look {
            break;
        }
        let protocol = settings.protocol.hash;
        let lease = match unfinished {
            0 => None,
            _ => store.lease(protocol, &settings.holder, now(), LEASE_SECONDS, settings.attempts).await?,
        };
        let Some(lease) = lease else {
            tokio::time::sleep(IDLE).await;
            continue;
        };
        let made = tokio::task::block_in_place(|| method.label(&lease.structure));
        let judged = made.and_then(|label| judge(label, &lease, settings.largest_force));
        deliver(&store, &lease, judged, &settings, now()).await?;
    }
    Ok(())
}

async fn deliver(
    store: &Store,
    lease: &Lease,
    judged: Result<Label, LabelFailure>,
    settings: &LabellerSettings,
    now: i64,
) -> Result<(), StoreError> {
    match judged {
        Ok(label) => store.complete(lease, &label, now).await.map(|_| ()),
        Err(failure) => {
            store.fail(lease, failure.class(), &failure.to_string(), settings.attempts, now).await.map(|_| ())
        }
    }
}

/// A label is believed only if its numbers are finite, belong to the atoms asked for and are not absurd.
fn judge(label: Label, lease: &Lease, largest_force: f64) -> Result<Label, LabelFailure> {
    let (found, expected) = (label.forces.len(), lease.structure.len());
    if found != expected {
        return Err(LabelFailure::Implausible(format!("{found} forces for {expected} atoms")));
    }
    let stress = label.stress.iter().flatten().flatten();
    if !label.forces.iter().flatten().chain(stress).chain([&label.energy]).all(|x| x.is_finite()) {
        return Err(LabelFailure::Implausible("numbers that are not finite".to_owned()));
    }
    let largest = label.forces.iter().map(|f| atoms::cell::norm(*f)).fold(0.0, f64::max);
    if largest > largest_force {
        let message = format!("a force of {largest:.1} eV/Å, above the allowed {largest_force:.1}");
        return Err(LabelFailure::Implausible(message));
    }
    Ok(label)
}
