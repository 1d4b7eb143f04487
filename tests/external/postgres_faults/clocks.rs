//! Labellers on other hosts whose clocks are wrong by an hour, or jump: only the server's clock decides about leases.

use std::fs;
use std::thread::sleep;
use std::time::Duration;

use crate::common::Running;
use crate::common::campaign::{Small, outcome_at};
use crate::common::clock::Clock;
use crate::common::hosts::uninterrupted_outcome;
use crate::common::label_campaign::LabelCampaign;
use crate::common::processes::{processes_running, wait_until};
use crate::common::{random, through};

/// `calmwalk label` with this clock on a simulated other host, which has its own process ids and its own boot id.
fn label(place: &LabelCampaign, clock: &Clock) -> Running {
    let boot = place.path().join("boot_id");
    fs::write(&boot, "11111111-2222-3333-4444-555555555555\n").unwrap();
    let elsewhere = ["unshare", "--pid", "--mount", "--fork", "--kill-child", "--mount-proc", "sh", "-c"];
    let script = format!("mount --bind {} /proc/sys/kernel/random/boot_id && exec \"$@\"", boot.display());
    let starter = elsewhere.map(str::to_owned).into_iter().chain([script, "sh".into()]);
    let starter: Vec<_> = starter.chain(clock.starter()).collect();
    place.spawn(through(&starter, place.path()), &["label", "--store", place.argument()])
}

fn clocks(place: &LabelCampaign) -> [Clock; 2] {
    ["+1h", "-1h"].map(|offset| {
        let directory = place.path().join(offset);
        fs::create_dir(&directory).unwrap();
        Clock::new(&directory, offset)
    })
}

/// Two labellers make all labels. Their clocks differ from each other and from the server's.
#[test]
fn labellers_with_wrong_clocks_label_everything_once() {
    let small = Small { steps: 1600, max_per_walk: 12, ..Small::default() };
    let place =
        LabelCampaign::on_server(&small, &[("[label]", "[label]\nconcurrency = 0\nlease_timeout = \"2s\"")]);
    let mut run = place.run();
    wait_until("there is a campaign", || place.jobs("queued") > 0);
    let clocks = clocks(&place);
    let mut labelling: Vec<_> = clocks.iter().map(|clock| label(&place, clock)).collect();
    for jump in 0.. {
        if run.0.try_wait().unwrap().is_some() {
            break;
        }
        sleep(Duration::from_millis(200 + random(jump) % 800));
        clocks[jump as usize % 2].set(["+1h", "+0", "-1h"][jump as usize % 3]);
    }
    assert_eq!(run.0.wait().unwrap().code(), Some(0), "{}", place.said());
    for label in &mut labelling {
        assert_eq!(label.0.wait().unwrap().code(), Some(0), "{}", place.said());
    }
    assert_eq!(
        place.said().matches(": labelled ").count() as u64,
        place.jobs("labelled"),
        "{}",
        place.said()
    );
    assert_eq!(outcome_at(place.argument(), place.path()), uninterrupted_outcome(&small));
}

/// A labeller whose clock is an hour behind holds a lease and is paused for some seconds; one whose clock is an hour ahead
/// looks for jobs.
#[test]
fn a_lease_does_not_depend_on_the_clocks_of_other_labellers() {
    let small = Small { steps: 60, ..Small::default() };
    let place = LabelCampaign::on_server(&small, &[("[label]", "[label]\nlease_timeout = \"1m\"")]);
    assert_eq!(place.run().0.wait().unwrap().code(), Some(0), "{}", place.said());
    let name = place.queue_large();
    let [ahead, behind] = clocks(&place);
    let mut first = label(&place, &behind);
    let slot = place.pause_labeller();
    assert_eq!(place.jobs("leased"), 1, "it was stopped too late: {}", place.said());
    let mut second = label(&place, &ahead);
    wait_until("another labeller is running", || processes_running(place.path(), "labeller").len() == 2);
    // Long enough for the second labeller to poll the queue several times.
    sleep(Duration::from_secs(8));
    slot.resume();
    for label in [&mut first, &mut second] {
        assert_eq!(label.0.wait().unwrap().code(), Some(0), "{}", place.said());
    }
    let job = place.job(&name);
    assert_eq!((job.job.attempts, job.energies.len()), (1, 1), "{}", place.said());
}
