//! Runs the user's command when an event of `[notify]` happens. Only the end of a run waits for the command, for at
//! most `notify.time_limit`. A command that fails is recorded in the operations log.

use std::convert::Infallible;
use std::process::Stdio;
use std::time::Duration;

use monitor::Snapshot;
use monitor::end_reason::CampaignEnd;
use monitor::mixture_values::MixtureValues;
use monitor::versions::CampaignVersions;
use serde::Deserialize;
use serde_json::{Value, json};
use store::{Location, Store, StoreError, unix_milliseconds};
use tokio::io::AsyncWriteExt;
use tokio::process::Command;
use tokio::task::JoinSet;
use tokio::time::{MissedTickBehavior, interval, timeout};

use crate::config::{Config, NotifyEvent};
use crate::exit_status::CommandError;
use crate::forgetting::{ForgettingMeasurement, ForgettingRule};
use crate::notify::{METADATA_KEY, Notification, NotificationTracker};
use crate::output::log_and_warn;
use crate::wording;

/// Longest interval between checks.
const MAX_CHECK_INTERVAL: Duration = Duration::from_secs(15);
/// Length of the standard error of a failed command that is kept, bytes.
const MAX_STDERR_BYTES: usize = 1000;

/// Notifies the owner of a campaign.
pub struct Notifier<'a> {
    store: &'a Store,
    location: String,
    command: Vec<String>,
    limit: Duration,
    interval: Duration,
    tracker: NotificationTracker,
    forgetting: ForgettingRule,
    /// Whether refits follow when all walks have ended.
    has_refits: bool,
    commands: JoinSet<(NotifyEvent, Result<(), String>)>,
}

impl<'a> Notifier<'a> {
    /// `None` if no command is configured.
    pub async fn new(
        config: &Config,
        store: &'a Store,
        location: &Location,
    ) -> Result<Option<Self>, StoreError> {
        let settings = &config.notify;
        let Some(command) = settings.command.clone() else { return Ok(None) };
        let sent = store.metadata(METADATA_KEY).await?;
        let sent = sent.and_then(|text| serde_json::from_str(&text).ok()).unwrap_or_default();
        let stall = settings.stall_timeout.get();
        Ok(Some(Self {
            store,
            location: location.to_string(),
            command,
            limit: settings.time_limit.get(),
            interval: MAX_CHECK_INTERVAL.min(stall / 4).max(Duration::from_millis(100)),
            tracker: NotificationTracker::new(settings.clone(), sent),
            forgetting: ForgettingRule::new(&config.calm),
            has_refits: config.refit.is_some(),
            commands: JoinSet::new(),
        }))
    }

    /// Checks for events and notifies, for ever.
    async fn run(&mut self) -> Infallible {
        let mut ticks = interval(self.interval);
        ticks.set_missed_tick_behavior(MissedTickBehavior::Delay);
        loop {
            tokio::select! {
                _ = ticks.tick() => {
                    // Other parts of the run report a broken database.
                    let _ = self.check(false).await;
                }
                Some(done) = self.commands.join_next() => self.log(done.ok()).await,
            }
        }
    }

    /// `is_last`: the run has ended.
    async fn check(&mut self, is_last: bool) -> Result<(), CommandError> {
        let mut status = self.store.status().await?;
        let values = MixtureValues(self.store.values().await?);
        let versions = CampaignVersions::read(self.store, &status, &values.0).await?;
        if self.has_refits {
            // Other walks may follow those of this version of the potential.
            let is_over = is_last && CampaignEnd::read(self.store, &status).await?.is_some();
            status.finished &= is_over;
        }
        let mut due = self.tracker.check(&status, unix_milliseconds());
        due.extend(self.tracker.check_versions(&versions));
        if let Ok(measured) = ForgettingMeasurement::deserialize(values.training_frames()) {
            due.extend(self.tracker.check_training(&self.forgetting, &measured));
        }
        if due.is_empty() {
            return Ok(());
        }
        // Store this first, so that no event is reported twice.
        let sent = serde_json::to_string(self.tracker.sent()).map_err(CommandError::failed)?;
        self.store.set_metadata(METADATA_KEY, &sent).await?;
        let snapshot = Snapshot::read(self.store).await?;
        let state = wording::json::snapshot(&snapshot).map_err(CommandError::failed)?;
        due.into_iter().for_each(|due| self.notify(due, &state));
        Ok(())
    }

    fn notify(&mut self, due: Notification, state: &Value) {
        let Notification { event, message } = due;
        let input = json!({
            "event": event.name(), "message": message, "time": unix_milliseconds(), "location": self.location,
            "status": state,
        });
        let campaign = state["campaign"].as_str().unwrap_or_default();
        let mut command = Command::new(&self.command[0]);
        command.args(&self.command[1..]).env("CALMWALK_EVENT", event.name()).env("CALMWALK_MESSAGE", message);
        command.env("CALMWALK_CAMPAIGN", campaign).env("CALMWALK_LOCATION", &self.location);
        let running = run_command(command, input.to_string(), self.limit);
        self.commands.spawn(async move { (event, running.await) });
    }

    async fn log(&mut self, done: Option<(NotifyEvent, Result<(), String>)>) {
        let Some((event, how)) = done else { return };
        let (kind, detail) = match how {
            Ok(()) => ("notified", json!({ "event": event.name() })),
            Err(how) => {
                log_and_warn(format_args!("notify.command on {}: {how}", event.name()));
                ("not_notified", json!({ "event": event.name(), "how": how }))
            }
        };
        let _ = self.store.log_operation(unix_milliseconds(), kind, &detail).await;
    }
}

/// Checks for events and notifies, for ever, if a command is configured.
pub async fn run(notifier: &mut Option<Notifier<'_>>) -> Infallible {
    match notifier {
        Some(notifier) => notifier.run().await,
        None => std::future::pending().await,
    }
}

/// Checks a last time at the end of a run, which may have failed, and waits for all commands.
pub async fn finish(notifier: Option<Notifier<'_>>, failure: Option<&CommandError>) {
    let Some(mut notifier) = notifier else { return };
    if let Some(due) = failure.and_then(|failure| notifier.tracker.failed(&failure.to_string())) {
        // The database may be what failed.
        notifier.notify(due, &Value::Null);
    } else {
        let _ = notifier.check(true).await;
    }
    while let Some(done) = notifier.commands.join_next().await {
        notifier.log(done.ok()).await;
    }
}

/// Runs a command with `input` on its standard input, for at most `limit`. Returns how it failed.
async fn run_command(mut command: Command, input: String, limit: Duration) -> Result<(), String> {
    command.stdin(Stdio::piped()).stdout(Stdio::null()).stderr(Stdio::piped());
    // Ctrl-C in a terminal is meant for the campaign.
    command.process_group(0).kill_on_drop(true);
    let mut child = command.spawn().map_err(|error| format!("cannot start: {error}"))?;
    let stdin = child.stdin.take();
    let work = async {
        if let Some(mut stdin) = stdin {
            // The command need not read its input.
            let _ = stdin.write_all(input.as_bytes()).await;
        }
        child.wait_with_output().await
    };
    match timeout(limit, work).await {
        Err(_) => Err(format!("killed after {} s", limit.as_secs_f64())),
        Ok(Err(error)) => Err(error.to_string()),
        Ok(Ok(output)) if output.status.success() => Ok(()),
        Ok(Ok(output)) => {
            let said = output.stderr.len().saturating_sub(MAX_STDERR_BYTES);
            Err(format!("{}: {}", output.status, String::from_utf8_lossy(&output.stderr[said..]).trim()))
        }
    }
}
