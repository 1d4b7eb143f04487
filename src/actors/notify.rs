//! Runs the user's command when something has happened to the campaign (`[notify]`). Nothing waits for it but the end of a run, and
//! that for `notify.time_limit`; that it fails is a line in the operations log.

use std::convert::Infallible;
use std::process::Stdio;
use std::time::Duration;

use serde_json::{Value, json};
use store::{Location, Store, StoreError, unix_milliseconds};
use tokio::io::AsyncWriteExt;
use tokio::process::Command;
use tokio::task::JoinSet;
use tokio::time::{MissedTickBehavior, interval, timeout};

use crate::cli::status;
use crate::config::{Config, NotifyEvent};
use crate::forgetting::Forgetting;
use crate::notify::{Due, NOTE, Watch};
use crate::outcome::Failure;
use crate::output::warn;

/// Longest time between two looks.
const LOOK: Duration = Duration::from_secs(15);
/// As much is kept of what a command says that fails, bytes.
const LAST_WORDS: usize = 1000;

/// Tells the owner of a campaign.
pub struct Notifier<'a> {
    store: &'a Store,
    location: String,
    command: Vec<String>,
    limit: Duration,
    look: Duration,
    watch: Watch,
    forgetting: Forgetting,
    at_work: JoinSet<(NotifyEvent, Result<(), String>)>,
}

impl<'a> Notifier<'a> {
    /// None if nobody is to be told.
    pub async fn new(
        config: &Config,
        store: &'a Store,
        location: &Location,
    ) -> Result<Option<Self>, StoreError> {
        let settings = &config.notify;
        let Some(command) = settings.command.clone() else { return Ok(None) };
        let told = store.note(NOTE).await?;
        let told = told.and_then(|text| serde_json::from_str(&text).ok()).unwrap_or_default();
        let stall = settings.stall.get();
        Ok(Some(Self {
            store,
            location: location.to_string(),
            command,
            limit: settings.time_limit.get(),
            look: LOOK.min(stall / 4).max(Duration::from_millis(100)),
            watch: Watch::new(settings.clone(), told),
            forgetting: Forgetting::new(&config.calm),
            at_work: JoinSet::new(),
        }))
    }

    /// Looks and tells without end.
    async fn keep(&mut self) -> Infallible {
        let mut look = interval(self.look);
        look.set_missed_tick_behavior(MissedTickBehavior::Delay);
        loop {
            tokio::select! {
                _ = look.tick() => {
                    // Whoever has more to do with the database finds out what is wrong with it.
                    let _ = self.look().await;
                }
                Some(done) = self.at_work.join_next() => self.log(done.ok()).await,
            }
        }
    }

    async fn look(&mut self) -> Result<(), Failure> {
        let mut due = self.watch.look(&self.store.status().await?, unix_milliseconds());
        let values = status::Values(self.store.values().await?);
        if let Some((share, raised)) = values.forgetting() {
            due.extend(self.watch.look_at_training(&self.forgetting, share, raised));
        }
        if due.is_empty() {
            return Ok(());
        }
        // First, so that it is not told twice whatever happens now.
        let told = serde_json::to_string(self.watch.told()).map_err(Failure::failed)?;
        self.store.leave_note(NOTE, &told).await?;
        let snapshot = status::Snapshot::of(self.store).await?;
        let state = snapshot.to_json().map_err(Failure::failed)?;
        due.into_iter().for_each(|due| self.tell(due, &state));
        Ok(())
    }

    fn tell(&mut self, due: Due, state: &Value) {
        let Due { event, message } = due;
        let input = json!({
            "event": event.name(), "message": message, "time": unix_milliseconds(), "location": self.location,
            "status": state,
        });
        let campaign = state["campaign"].as_str().unwrap_or_default();
        let mut command = Command::new(&self.command[0]);
        command.args(&self.command[1..]).env("CALMWALK_EVENT", event.name()).env("CALMWALK_MESSAGE", message);
        command.env("CALMWALK_CAMPAIGN", campaign).env("CALMWALK_LOCATION", &self.location);
        let carried_out = carry_out(command, input.to_string(), self.limit);
        self.at_work.spawn(async move { (event, carried_out.await) });
    }

    async fn log(&mut self, done: Option<(NotifyEvent, Result<(), String>)>) {
        let Some((event, how)) = done else { return };
        let (kind, detail) = match how {
            Ok(()) => ("notified", json!({ "event": event.name() })),
            Err(how) => {
                warn(format_args!("notify.command on {}: {how}", event.name()));
                ("not_notified", json!({ "event": event.name(), "how": how }))
            }
        };
        let _ = self.store.log_operation(unix_milliseconds(), kind, &detail).await;
    }
}

/// Looks and tells without end, if somebody is to be told.
pub async fn keep(notifier: &mut Option<Notifier<'_>>) -> Infallible {
    match notifier {
        Some(notifier) => notifier.keep().await,
        None => std::future::pending().await,
    }
}

/// The last look at a run, which may have failed; waits until all is told.
pub async fn finish(notifier: Option<Notifier<'_>>, failure: Option<&Failure>) {
    let Some(mut notifier) = notifier else { return };
    if let Some(due) = failure.and_then(|failure| notifier.watch.failed(&failure.to_string())) {
        // The database may be what failed.
        notifier.tell(due, &Value::Null);
    } else {
        let _ = notifier.look().await;
    }
    while let Some(done) = notifier.at_work.join_next().await {
        notifier.log(done.ok()).await;
    }
}

/// Runs a command with this on its standard input, for so long at most; how it failed.
async fn carry_out(mut command: Command, input: String, limit: Duration) -> Result<(), String> {
    command.stdin(Stdio::piped()).stdout(Stdio::null()).stderr(Stdio::piped());
    // Ctrl-C in a terminal is meant for the campaign.
    command.process_group(0).kill_on_drop(true);
    let mut child = command.spawn().map_err(|error| format!("cannot be started: {error}"))?;
    let stdin = child.stdin.take();
    let work = async {
        if let Some(mut stdin) = stdin {
            // It may not want to know.
            let _ = stdin.write_all(input.as_bytes()).await;
        }
        child.wait_with_output().await
    };
    match timeout(limit, work).await {
        Err(_) => Err(format!("not done after {} s, and killed", limit.as_secs_f64())),
        Ok(Err(error)) => Err(error.to_string()),
        Ok(Ok(output)) if output.status.success() => Ok(()),
        Ok(Ok(output)) => {
            let said = output.stderr.len().saturating_sub(LAST_WORDS);
            Err(format!("{}: {}", output.status, String::from_utf8_lossy(&output.stderr[said..]).trim()))
        }
    }
}
