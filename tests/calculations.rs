//! Labels by an external program in a real campaign, while every process that works on them is killed.

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::{Duration, Instant};

use crate::common::campaign::{Small, outcome_at};
use crate::common::label_campaign::{LabelCampaign, WRITE_FIXED_LABEL, check_single_labels, on_store};
use crate::common::processes::{calculation_processes, processes_in, processes_running, signal, wait_until};

/// Takes half a second, and starts background processes that do not end.
const SCRIPT: &str = r#"
sleep 1000 &
setsid sleep 1000 &
sleep 0.5
"#;

/// Maximum number of kills of programs: each kill counts as a failure of its job, whose retries are limited.
const PROGRAMS: usize = 2;
const KILLS: usize = 24;

/// The kind of process to kill.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
enum Victim {
    Label,
    Labeller,
    CalculationRunner,
    Program,
    Child,
}
use Victim::{CalculationRunner, Child, Label, Labeller, Program};

/// A deterministic random number generator.
struct Random(u64);

impl Random {
    fn below(&mut self, limit: usize) -> usize {
        self.0 = self.0.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (self.0 >> 33) as usize % limit
    }
}

/// A campaign whose labels are made by [`SCRIPT`], below `scratch`.
fn place(scratch: &Path) -> LabelCampaign {
    let command = r#"{ command = { command = ["sh", "label.sh"], files = ["label.sh"], version = "1" } }"#;
    let keys = format!(
        "[label]\nconcurrency = 0\nmax_attempts = 20\nscratch = {:?}\nmethod = {command} # ",
        scratch.display().to_string()
    );
    let small = Small { walkers: 1, steps: 120, ..Small::default() };
    let place = LabelCampaign::new(&small, &[("[label]\nmethod", &keys)]);
    fs::write(place.path().join("label.sh"), SCRIPT.to_owned() + WRITE_FIXED_LABEL).unwrap();
    place
}

fn directories(scratch: &Path) -> Vec<PathBuf> {
    let campaigns = fs::read_dir(scratch).unwrap().map(|entry| entry.unwrap().path());
    campaigns
        .flat_map(|campaign| fs::read_dir(campaign).unwrap())
        .map(|entry| entry.unwrap().path())
        .collect()
}

/// Processes of this kind that are running now.
fn victims(place: &LabelCampaign, scratch: &Path, who: Victim) -> Vec<u32> {
    let started = |what: &str| {
        let all = calculation_processes(scratch).into_iter();
        all.filter(|(_, command)| command.starts_with(what)).map(|(pid, _)| pid).collect()
    };
    match who {
        Label => processes_running(place.path(), "label"),
        Labeller => processes_running(place.path(), "labeller"),
        CalculationRunner => processes_running(place.path(), "calculation-runner"),
        Program => started("sh label.sh"),
        Child => started("sleep 1000"),
    }
}

#[test]
fn each_label_is_made_once_despite_kills() {
    let scratch = tempfile::tempdir().unwrap();
    let (scratch, mut random) = (scratch.path().canonicalize().unwrap(), Random(11));
    let place = place(&scratch);
    let mut run = place.run();
    let slots = ["--concurrency", "2", "--wait-timeout", "2m"];
    let mut label = place.label(&slots);
    let (mut killed, begun) = (BTreeMap::<Victim, usize>::new(), Instant::now());
    while run.0.try_wait().unwrap().is_none() {
        assert!(begun.elapsed() < Duration::from_secs(240), "{}", place.said());
        std::thread::sleep(Duration::from_millis(50 + random.below(200) as u64));
        if label.0.try_wait().unwrap().is_some() {
            label = place.label(&slots);
        }
        let who = [Label, Labeller, CalculationRunner, Program, Child][random.below(5)];
        let found = victims(&place, &scratch, who);
        let enough = killed.values().sum::<usize>() >= KILLS
            || (who == Program && killed.get(&Program).is_some_and(|times| *times >= PROGRAMS));
        if !found.is_empty() && !enough {
            signal(found[random.below(found.len())], "KILL");
            *killed.entry(who).or_default() += 1;
        }
    }
    assert_eq!(run.0.wait().unwrap().code(), Some(0), "{}", place.said());
    assert!(killed.len() == 5, "{killed:?} {}", place.said());
    // The last labellers exit on their own.
    label.0.wait().unwrap();
    outcome_at(place.argument(), place.path());
    assert!(on_store(place.location(), check_single_labels) > 2);
    wait_until("all processes have exited", || processes_in(place.path()).is_empty());

    // A later labeller removes the directories of a killed one after a minute.
    for directory in directories(&scratch) {
        let touched = Command::new("touch").args(["-d", "2 minutes ago"]).arg(directory).status();
        assert!(touched.unwrap().success());
    }
    assert_eq!(place.label(&["--until-empty"]).0.wait().unwrap().code(), Some(0), "{}", place.said());
    assert_eq!((calculation_processes(&scratch), directories(&scratch)), (vec![], vec![]), "{killed:?}");
    assert_eq!(fs::read_dir(&scratch).unwrap().count(), 0);
}

/// A stand-in for GPAW that returns the energy in its setup file of aluminium. After the first calculation, it replaces the
/// original of the setup file.
const GPAW: &str = r#"
if [ ! -e input.json ]; then
    echo "{\"gpaw\": \"1\", \"ase\": \"1\", \"setup_paths\": [\"$GPAW_SETUP_PATH\"]}"
    exit
fi
awk -v energy="$(sed -n 's/<!-- energy \(.*\) -->/\1/p' ../data/Al.PBE)" '
    BEGIN { print "{\"by\": {\"gpaw\": \"1\", \"ase\": \"1\"}, \"converged\":" }
    /"moments"/ { exit }
    /"positions"/ { places = 1 }
    /"cell"/ { places = 0 }
    { print }
    places {
        sub(/"positions"/, "\"forces\"")
        if (sub(/-?[0-9][0-9.e-]*/, number % 3 ? "0.0" : "0.25")) number++
        forces = forces $0 "\n"
    }
    END {
        print forces "\"energy\": " energy ", \"energy_without_smearing\": null, \"stress\": null, \"moments\": null,"
        print "\"magnetisation\": null, \"steps\": 1}}"
    }
' input.json > unfinished
mv unfinished result.json
if mkdir "$GPAW_SETUP_PATH/replaced" 2> /dev/null; then
    sed 's/energy -1.5/energy -2.5/' ../data/Al.PBE > "$GPAW_SETUP_PATH/new"
    mv "$GPAW_SETUP_PATH/new" "$GPAW_SETUP_PATH/Al.PBE"
fi
"#;

const SETUP: &str = "<atom symbol=\"Al\" Z=\"13\" core=\"10\" valence=\"3\"/>\n<xc_functional type=\"GGA\" name=\"PBE\"/>\n\
                     <!-- energy -1.5 -->\n";

/// A campaign whose labels are made by [`GPAW`].
fn with_setup(home: &Path) -> LabelCampaign {
    fs::write(home.join("Al.PBE"), SETUP).unwrap();
    fs::write(home.join("gpaw.sh"), GPAW).unwrap();
    let command = ["sh".to_owned(), home.join("gpaw.sh").display().to_string()];
    let keys = format!(
        "[label]\nconcurrency = 0\nscratch = {scratch:?}\nkeep_directories = \"all\"\nmethod = {{ gpaw = {{ command = {command:?}, \
         pseudopotentials = {scratch:?}, spin_polarized = false }} }} # ",
        scratch = home.display().to_string()
    );
    // A labeller that cannot continue fails again each time that it is restarted.
    let restarts = ("[run]\n", "[run]\nmax_restarts = 1\n");
    let small = Small { walkers: 1, steps: 120, ..Small::default() };
    LabelCampaign::new(&small, &[("[label]\nmethod", &keys), restarts])
}

#[test]
fn a_setup_that_is_replaced_between_two_labels_makes_none() {
    let home = tempfile::tempdir().unwrap();
    let place = with_setup(&home.path().canonicalize().unwrap());
    let mut run = place.run();
    let mut label = place.label(&["--wait-timeout", "2m"]);
    assert_eq!(label.0.wait().unwrap().code(), Some(1), "{}", place.said());
    let (said, setup) = (place.said(), home.path().canonicalize().unwrap().join("Al.PBE"));
    assert!(
        said.contains(&format!("cannot use {} (its content has changed: BLAKE3 ", setup.display())),
        "{said}"
    );
    // A labeller that starts now is refused.
    assert!(said.contains("labels made here would not belong to the campaign's protocol 'gpaw'"), "{said}");
    assert!(said.contains("settings.pseudopotentials.Al"), "{said}");
    assert_eq!((place.jobs("labelled"), place.jobs("failed")), (1, 0), "{said}");
    fs::write(&setup, SETUP).unwrap();
    let mut label = place.label(&["--wait-timeout", "2m"]);
    assert_eq!(run.0.wait().unwrap().code(), Some(0), "{}", place.said());
    assert_eq!(label.0.wait().unwrap().code(), Some(0), "{}", place.said());
    outcome_at(place.argument(), place.path());
    // All labels are made with the protocol's setup file, and no archive contains it.
    assert!(on_store(place.location(), check_single_labels) > 2);
    for job in on_store(place.location(), async |store| store.queue_list(None, u32::MAX, 0).await.unwrap()) {
        let details = place.job(&job.candidate);
        assert!(details.attempts_made.iter().all(|attempt| attempt.class.is_none()), "{details:?}");
        let kept = on_store(place.location(), async |store| store.archives(job.job).await.unwrap());
        let left_out = kept.iter().map(|kept| &*kept.left_out).collect::<String>();
        assert_eq!(left_out, format!("data/Al.PBE ({} bytes)\n", SETUP.len()));
    }
}
