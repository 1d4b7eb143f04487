//! Whether docs/glossary.md explains every word of `status`, of the decision log and of failed labels.

use dft::FailureClass;
use monitor::reference_check::CheckState;
use monitor::walk_ends::EarlyEndCause;
use serde::Serialize;
use store::{JobState, LabelStatus};
use wire::messages::{DeclineReason, WalkEnd};

use crate::config::NotifyEvent;

const GLOSSARY: &str = include_str!("../../docs/glossary.md");

/// The first column of the table below a heading.
fn column(heading: &str) -> Vec<&'static str> {
    let section = GLOSSARY.split(&format!("\n{heading}")).nth(1).expect("a section");
    let table =
        section.lines().skip_while(|line| !line.starts_with('|')).take_while(|line| line.starts_with('|'));
    table.skip(2).map(|line| line.split('|').nth(1).unwrap_or_default().trim()).collect()
}

fn json(word: impl Serialize) -> String {
    serde_json::to_value(word).unwrap().as_str().unwrap().to_owned()
}

#[test]
fn every_status_word_is_explained() {
    let none = String::new;
    let ends = [
        WalkEnd::Completed,
        WalkEnd::QuotaReached,
        WalkEnd::Budget,
        WalkEnd::Superseded,
        WalkEnd::NothingNew,
        WalkEnd::VolumeBoundary,
        WalkEnd::Trapped { guard: none() },
        WalkEnd::Diverged { reason: none() },
        WalkEnd::InvalidStart { reason: none() },
    ];
    let ends = ends.iter().map(|end| end.name().to_owned());
    let causes = {
        use EarlyEndCause::*;
        [TooHot, NotFinite, LostAtom, Crashed, Trapped, BeyondGrade, UnstableCell, InvalidStart, Other]
            .map(json)
    };
    let decisions = [
        "begun",
        "ended",
        "resumed",
        "segment",
        "accepted",
        "declined",
        "left_out",
        "control",
        "forgetting",
        "imported",
        "configuration",
        "version",
    ];
    let reasons = DeclineReason::ALL.into_iter().filter(|reason| *reason != DeclineReason::LeftOut);
    let classes = FailureClass::ALL
        .iter()
        .map(|class| class.name())
        .chain(["rejected_by_label_guard", "lost_too_often"]);
    let own = |words: &[&str]| words.iter().map(|word| (*word).to_owned()).collect::<Vec<_>>();
    let statuses = [LabelStatus::Label, LabelStatus::Check, LabelStatus::Superseded, LabelStatus::Excluded];
    let checks = [CheckState::Running, CheckState::Passed, CheckState::Failed, CheckState::Accepted];
    for (title, words) in [
        ("Walks", own(&["waiting", "running", "stopped", "paused"]).into_iter().chain(ends).collect()),
        ("Causes of early ends", causes.to_vec()),
        ("Decisions", own(&decisions)),
        ("Reasons to decline", reasons.map(|reason| reason.name().to_owned()).collect()),
        ("Label jobs", JobState::ALL.map(|state| state.name().to_owned()).to_vec()),
        ("Labels", statuses.map(json).to_vec()),
        ("Reference check", checks.map(json).to_vec()),
        ("Failure classes", classes.map(str::to_owned).collect()),
        ("Events of notifications", NotifyEvent::ALL.map(|event| event.name().to_owned()).to_vec()),
    ] {
        let known = column(&format!("**{title}**"));
        for word in words {
            let is_explained = known.iter().any(|row| row.contains(&format!("`{word}`")));
            assert!(is_explained, "'{word}' is missing under '{title}'");
        }
    }
}

#[test]
fn words_are_in_alphabetical_order() {
    let greek = [('α', "alpha"), ('γ', "gamma"), ('σ', "sigma"), ('θ', "theta"), ('τ', "tau")];
    let key = |word: &str| {
        greek.iter().fold(word.to_lowercase(), |word, (letter, name)| word.replace(*letter, name))
    };
    for section in GLOSSARY.lines().filter(|line| line.starts_with("## ") && *line != "## Status words") {
        let words: Vec<_> = column(section).into_iter().map(key).collect();
        assert!(words.len() > 5 && words.is_sorted(), "{section}: {words:?}");
    }
}
