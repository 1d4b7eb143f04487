//! Frames of trajectories: the steps at their interval, the same however the walk was cut into reports.

use wire::messages::{Assignment, Outcome};
use wire::{WalkConditions, WalkFrame};
use workers::settings::WalkSettings;
use workers::walk::advance_observed;

use crate::walk::{
    assignment, conditions, context, first_of, mixture, never, run, seed_structure, settings, uniform_zbl,
    whole_walk,
};

/// A frame after every seventh step, without candidates.
fn recorded() -> WalkSettings {
    WalkSettings { trajectory_interval: 7, collection: never(), ..settings() }
}

fn places(frames: &[WalkFrame]) -> Vec<(u32, u64)> {
    frames.iter().map(|frame| (frame.segment, frame.step)).collect()
}

/// The frames of a walk under these settings, from what an observer sees of its steps.
fn observed(settings: &WalkSettings, assignment: &Assignment) -> Vec<WalkFrame> {
    let (context, mut frames) = (context(settings.clone()), Vec::new());
    advance_observed(
        &context,
        assignment,
        mixture(),
        || false,
        |_| (),
        |view| {
            let position = view.position();
            if position.step.is_multiple_of(7) {
                frames.push(WalkFrame {
                    segment: position.segment,
                    step: position.step,
                    time: view.time(),
                    temperature: view.temperature(),
                    cell: view.structure().cell.0,
                    positions: WalkFrame::rounded(&view.structure().positions),
                });
            }
        },
    )
    .unwrap();
    frames
}

#[test]
fn frames_are_the_steps_at_the_interval() {
    let (settings, walk) = (recorded(), assignment(seed_structure("vacancy"), 60));
    let frames = run(&settings, &walk).frames;
    assert_eq!(places(&frames), (0..60).step_by(7).map(|step| (0, step)).collect::<Vec<_>>());
    assert_eq!(frames, observed(&settings, &walk));
    // The cell follows the ramp.
    assert!(frames[0].cell == walk.seed_structure.cell.0 && frames.last().unwrap().cell != frames[0].cell);
    let plain = run(&WalkSettings { trajectory_interval: 0, ..settings.clone() }, &walk);
    assert_eq!(plain.frames, []);
    assert_eq!(plain.checkpoint, run(&settings, &walk).checkpoint, "frames change no result");
}

#[test]
fn reports_have_a_bounded_number_of_frames_and_lose_none() {
    let whole = run(&recorded(), &assignment(seed_structure("vacancy"), 120)).frames;
    assert_eq!(whole.len(), 18);
    for max_frames in [1, 2, 5] {
        let settings = WalkSettings { max_frames, ..recorded() };
        let (mut next, mut frames) = (assignment(seed_structure("vacancy"), 120), Vec::new());
        loop {
            let report = run(&settings, &next);
            assert!(report.frames.len() <= max_frames, "{}", report.frames.len());
            next.checkpoint = Some(report.checkpoint);
            frames.extend(report.frames);
            match report.outcome {
                Outcome::Interrupted => {}
                outcome => break assert_eq!(outcome, Outcome::StepsDone),
            }
        }
        assert_eq!(frames, whole, "{max_frames}");
    }
}

#[test]
fn a_split_assignment_gives_the_same_frames() {
    let (settings, mut next) = (recorded(), assignment(seed_structure("vacancy"), 0));
    let whole = run(&settings, &assignment(seed_structure("vacancy"), 90)).frames;
    let mut split = Vec::new();
    for last_step in [0, 1, 6, 7, 8, 35, 77, 90] {
        next.last_step = last_step;
        let report = run(&settings, &next);
        next.checkpoint = Some(report.checkpoint);
        split.extend(report.frames);
    }
    assert_eq!(split, whole);
}

#[test]
fn an_abandoned_path_keeps_its_frames() {
    let settings = WalkSettings { zbl: uniform_zbl(1.0, 1.8), trajectory_interval: 4, ..settings() };
    let reports = whole_walk(&settings, first_of("fcc-100", WalkConditions { tau: 2.0, ..conditions() }));
    assert!(reports.last().unwrap().progress.rollbacks > 0);
    let frames: Vec<_> = reports.into_iter().flat_map(|report| report.frames).collect();
    let back: Vec<_> = frames.windows(2).filter(|pair| pair[0].segment != pair[1].segment).collect();
    assert!(
        !back.is_empty() && back.iter().all(|pair| pair[1].step <= pair[0].step),
        "{:?}",
        places(&frames)
    );
    assert!(frames.iter().all(|frame| frame.step.is_multiple_of(4)));
}
