//! Displays the progress of a run: bars on a terminal, plain lines otherwise.

use std::collections::BTreeMap;
use std::io::IsTerminal;
use std::time::{Duration, Instant};

use indicatif::{MultiProgress, ProgressBar, ProgressStyle};
use monitor::walk_ends::WalkEnds;
use orchestrator::reactor::Notice;
use serde::Deserialize;
use store::Fate;
use tokio_util::sync::CancellationToken;
use wire::{Origin, WalkId};

use crate::forgetting::{AlarmState, ForgettingMeasurement, ForgettingRule};
use crate::label_line::LabelLine;
use crate::output::{count, decimals, is_quiet, print_progress, print_stderr};
use crate::wording::walk_ends;

/// Interval between plain lines that only report steps.
const LINE_INTERVAL: Duration = Duration::from_secs(10);

/// Display of a run.
pub struct RunDisplay {
    bars: Option<Bars>,
    labels: LabelLine,
    names: BTreeMap<WalkId, String>,
    steps: WalkSteps,
    /// Steps of a whole walk.
    walk_steps: u64,
    accepted: u64,
    /// Whether the display has reported that walkers wait for labels.
    waiting: bool,
    forgetting: AlarmState,
    /// Stops the run, if the alarm asks for it.
    stop: CancellationToken,
    ends: WalkEnds,
    /// Whether the display has warned of early ends.
    warned: bool,
    last_line: Instant,
}

/// The step of each walk, and their sum, which every notice of the reactor asks for.
#[derive(Default)]
struct WalkSteps {
    of_walk: BTreeMap<WalkId, u64>,
    sum: u64,
}

struct Bars {
    steps: ProgressBar,
    message: ProgressBar,
    labels: ProgressBar,
    all: MultiProgress,
}

impl RunDisplay {
    /// Displays walks of `walk_steps` steps each. `walks` are (walk, seed structure, current step), `ends` those of
    /// earlier runs. `labels` shows labels under way below the bars.
    pub fn new(
        walk_steps: u64,
        walks: Vec<(WalkId, String, u64)>,
        ends: WalkEnds,
        forgetting: ForgettingRule,
        stop: CancellationToken,
        labels: LabelLine,
    ) -> Self {
        let (mut names, mut steps) = (BTreeMap::new(), WalkSteps::default());
        for (walk, name, step) in walks {
            names.insert(walk, name);
            steps.set(walk, step);
        }
        let bars = (std::io::stderr().is_terminal() && !is_quiet()).then(Bars::new);
        labels.set_bar(bars.as_ref().map(|bars| bars.labels.clone()));
        let mut display = Self {
            bars,
            labels,
            names,
            steps,
            walk_steps,
            accepted: 0,
            waiting: false,
            forgetting: AlarmState::new(forgetting),
            stop,
            warned: ends.is_alarming(),
            ends,
            last_line: Instant::now(),
        };
        display.draw();
        display
    }

    /// Takes a notice of the reactor.
    pub fn notice(&mut self, notice: &Notice<'_>) {
        match notice {
            Notice::Progress(walk, progress) => {
                self.steps.set(*walk, progress.step);
                self.waiting = false;
            }
            Notice::Committed(commit) => self.committed(commit),
            Notice::QueueFull(jobs) => self.on_queue_full(*jobs),
            Notice::Walkers { .. } => {}
        }
        self.draw();
    }

    /// Removes the bars.
    pub fn finish(self) {
        self.labels.set_bar(None);
        if let Some(bars) = self.bars {
            bars.labels.finish_and_clear();
            bars.steps.finish_and_clear();
            bars.message.finish_and_clear();
        }
    }

    fn committed(&mut self, commit: &store::Commit) {
        for record in &commit.walks {
            if let Some(partner) = record.partner {
                let name = format!("{} (control)", self.name(partner));
                self.names.entry(record.walk).or_insert(name);
            }
            self.steps.set(record.walk, record.progress.step);
        }
        for candidate in &commit.candidates {
            let view = candidate.block.view();
            let id = view.id();
            let largest = |grades: &store::records::AtomGrades| {
                decimals(grades.gamma.iter().copied().reduce(f64::max), 2)
            };
            let [current, original] = [&candidate.selector, &candidate.original].map(largest);
            let what = match candidate.fate {
                Fate::Accepted if view.origin() == Origin::Control => "control frame".to_owned(),
                Fate::Accepted => "accepted".to_owned(),
                Fate::Declined(reason) => format!("declined ({})", reason.name().replace('_', " ")),
            };
            self.accepted += u64::from(candidate.fate == Fate::Accepted && view.origin() == Origin::Biased);
            self.show(&format!(
                "{}: step {}, γ_max {current}, γ₀_max {original}, {what}",
                self.name(id.walk),
                id.step
            ));
        }
        for decision in commit.decisions.iter().filter(|decision| decision.kind == "left_out") {
            let (step, error) =
                (&decision.detail["step"], decision.detail["error"].as_str().unwrap_or_default());
            let name = decision.walk.map_or("?", |walk| self.name(walk));
            let line = format!("WARNING: {name}: step {step}, a candidate is left out: {error}");
            tracing::warn!("{line}");
            self.show_lasting(&line);
        }
        for decision in &commit.decisions {
            let Ok(measured) = ForgettingMeasurement::deserialize(&decision.detail["forgetting"]) else {
                continue;
            };
            let share_above_one = decision.detail["training_frames"]["share_above_one"].as_f64();
            if let Some(alarm) =
                self.forgetting.update(&ForgettingMeasurement { share_above_one, ..measured })
            {
                tracing::warn!("{alarm}");
                self.show_lasting(&alarm);
                if self.forgetting.pauses() {
                    self.stop.cancel();
                }
            }
        }
        for decision in commit.decisions.iter().filter(|decision| decision.kind == "ended") {
            if let Some(walk) = decision.walk {
                // The walk will not make its remaining steps.
                self.steps.set(walk, self.walk_steps);
                let text = |key: &str| decision.detail[key].as_str().unwrap_or_default();
                self.ends.add(walk.0, text("end"), text("reason"));
                let end = text("end").replace('_', " ");
                self.show(&format!("{}: ended ({end}) at step {}", self.name(walk), decision.detail["step"]));
            }
        }
        if !self.warned && self.ends.is_alarming() {
            self.warned = true;
            let warning = format!("WARNING: {}", walk_ends::warning(&self.ends));
            tracing::warn!("{warning}");
            self.show_lasting(&warning);
        }
    }

    /// Reported once, until a walk advances.
    fn on_queue_full(&mut self, jobs: u64) {
        if !std::mem::replace(&mut self.waiting, true) {
            let line = format!("walkers wait: the label queue is full ({} in it)", count(jobs, "structure"));
            tracing::info!("{line}");
            self.show(&line);
        }
    }

    fn name(&self, walk: WalkId) -> &str {
        self.names.get(&walk).map_or("?", String::as_str)
    }

    fn show(&self, line: &str) {
        match &self.bars {
            Some(bars) => bars.message.set_message(line.to_owned()),
            None => print_progress(line),
        }
    }

    /// Shows a line that the next one does not replace.
    fn show_lasting(&self, line: &str) {
        match &self.bars {
            // Ignore a terminal that is gone.
            Some(bars) => drop(bars.all.println(line)),
            None => print_stderr(line),
        }
    }

    fn draw(&mut self) {
        let (done, all) = (self.steps.sum, self.steps.of_walk.len() as u64 * self.walk_steps);
        if let Some(bars) = &self.bars {
            bars.steps.set_length(all);
            bars.steps.set_position(done.min(all));
            bars.steps.set_message(format!("{} accepted", self.accepted));
        } else if self.last_line.elapsed() > LINE_INTERVAL {
            self.last_line = Instant::now();
            print_progress(format_args!("{done} of {all} steps, {} accepted in this run", self.accepted));
        }
    }
}

impl WalkSteps {
    fn set(&mut self, walk: WalkId, step: u64) {
        let before = self.of_walk.insert(walk, step).unwrap_or(0);
        self.sum = self.sum - before + step;
    }
}

impl Bars {
    fn new() -> Self {
        let all = MultiProgress::new();
        let style = |template| {
            ProgressStyle::with_template(template).unwrap_or_else(|_| ProgressStyle::default_bar())
        };
        let steps = all.add(ProgressBar::new(0));
        steps.set_style(style("walks  {bar:32} {pos}/{len} steps  {eta} left  {msg}"));
        let message = all.add(ProgressBar::new_spinner());
        message.set_style(style("{wide_msg}"));
        let labels = all.add(ProgressBar::new_spinner());
        labels.set_style(style("{wide_msg}"));
        Self { steps, message, labels, all }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A walk that rolls back is at an earlier step than before.
    #[test]
    fn the_sum_follows_the_step_of_each_walk() {
        let mut steps = WalkSteps::default();
        for (walk, step, sum) in [(0, 0, 0), (1, 30, 30), (0, 50, 80), (1, 10, 60), (7, 5, 65), (0, 60, 75)] {
            steps.set(WalkId(walk), step);
            assert_eq!(steps.sum, sum);
            assert_eq!(steps.sum, steps.of_walk.values().sum::<u64>());
        }
    }
}
