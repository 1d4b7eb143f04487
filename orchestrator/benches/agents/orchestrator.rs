//! The orchestrator.

use std::process::{Command, Stdio};
use std::sync::{Arc, Mutex};
use std::time::Duration;

use orchestrator::reactor::{Notice, Reactor};
use orchestrator::selector::SelectorSettings;
use store::Fate;
use tokio::sync::mpsc;
use tokio::time::{interval, sleep};
use tokio_util::sync::CancellationToken;
use wire::net::{AgentBootstrap, AgentServer, StopTokens};

use crate::database::Database;
use crate::recording::Model;
use crate::simulated::Seen;
use crate::{AGENTS, PERIODS, Plan, WALKERS, campaign, endpoint, now, period, quantile};

/// Timeout for agents to end.
const AGENT_TIMEOUT: Duration = Duration::from_secs(60);

/// Log of commits.
#[derive(Default)]
struct Log {
    /// Number of candidates, and of accepted ones, in each period.
    candidates: [(u64, u64); PERIODS],
    /// Mixture versions, and the time of their commits, s.
    versions: Vec<(u64, f64)>,
}

pub async fn lead(plan: Plan) {
    let model = Model::load();
    let database = *Database::all().last().expect("SQLite at least");
    let room = database.room().await;
    let settings = SelectorSettings { declined_feature_bytes: 0, ..campaign::settings(1.5) };
    let mut selector = campaign::selector(&model, WALKERS, &settings);
    let store = campaign::create_store(room.location, WALKERS).await;
    store.commit(&selector.start_walks()).await.unwrap();
    let server =
        AgentServer::open(&endpoint(plan), None, 1, AGENT_TIMEOUT, AgentBootstrap::default()).await.unwrap();
    let tokens = StopTokens::default();
    // The same capacity as in `calmwalk run`.
    let (to_reactor, incoming) = mpsc::channel(64);
    let mixture = Arc::clone(selector.mixture());
    let server = tokio::spawn(server.run(Arc::clone(&mixture), mixture, tokens.clone(), to_reactor, |_| {}));
    let program = std::env::current_exe().unwrap();
    let arguments = [plan.rate, plan.duration.as_secs_f64(), f64::from(plan.port), plan.begun];
    let arguments = arguments.map(|number| number.to_string());
    let agents = Command::new(program).args(arguments).stdout(Stdio::piped()).spawn().unwrap();

    let log = Arc::new(Mutex::new(Log::default()));
    let memory = tokio::spawn(watch_memory(plan));
    let stop = tokens.stopping.clone();
    tokio::spawn(async move {
        sleep(Duration::from_secs_f64((plan.begun - now()).max(0.0)) + plan.duration).await;
        stop.cancel();
    });
    let stopping = tokens.stopping;
    let walks_end = CancellationToken::new();
    let reactor = Reactor {
        selector,
        store: store.clone(),
        incoming,
        stopping,
        walks_end,
        queue_limit: u64::MAX,
        completion: None,
    };
    let writing = Arc::clone(&log);
    reactor.run(move |notice| writing.lock().unwrap().record(&notice, plan)).await.unwrap();
    tokens.closing.cancel();
    server.await.unwrap().unwrap();
    let agents = agents.wait_with_output().unwrap();
    assert!(agents.status.success());
    let seen: Seen = serde_json::from_slice(&agents.stdout).unwrap();
    store.close().await;
    println!("{}, {WALKERS} walkers on {AGENTS} agents", database.name());
    let memory = memory.await.unwrap();
    report(&log.lock().unwrap(), seen, &memory, plan);
}

impl Log {
    fn record(&mut self, notice: &Notice<'_>, plan: Plan) {
        let Notice::Committed(commit) = notice else { return };
        if let Some(period) = period(now(), plan) {
            let accepted = commit.candidates.iter().filter(|candidate| candidate.fate == Fate::Accepted);
            self.candidates[period].0 += commit.candidates.len() as u64;
            self.candidates[period].1 += accepted.count() as u64;
        }
        let version = commit.values.iter().find(|(name, _)| name == "mixture_version");
        let version: u64 = version.map_or(0, |(_, version)| version.parse().unwrap());
        if self.versions.last().is_none_or(|(last, _)| *last < version) {
            self.versions.push((version, now()));
        }
    }
}

/// The largest resident memory of this process in each period, MB.
async fn watch_memory(plan: Plan) -> [f64; PERIODS] {
    let mut largest = [0.0_f64; PERIODS];
    let mut look = interval(Duration::from_millis(200));
    while now() < plan.begun + plan.duration.as_secs_f64() {
        look.tick().await;
        let status = std::fs::read_to_string("/proc/self/status").unwrap();
        let line = status.lines().find_map(|line| line.strip_prefix("VmRSS:")).unwrap();
        let resident: f64 = line.trim().trim_end_matches(" kB").parse().unwrap();
        if let Some(period) = period(now(), plan) {
            largest[period] = largest[period].max(resident / 1000.0);
        }
    }
    largest
}

fn report(log: &Log, mut seen: Seen, memory: &[f64; PERIODS], plan: Plan) {
    let each = plan.duration.as_secs_f64() / PERIODS as f64;
    println!("  {PERIODS} periods of {each:.0} s, one after the other");
    let row = |what: &str, numbers: [f64; PERIODS], decimals: usize| {
        let numbers = numbers.map(|number| format!("{number:>10.decimals$}"));
        println!("  {what:<52}{}", numbers.concat());
    };
    row("candidates/s", log.candidates.map(|(all, _)| all as f64 / each), 0);
    row("accepts/s", log.candidates.map(|(_, accepted)| accepted as f64 / each), 1);
    let waits = seen.waits.each_mut();
    row("offer to next assignment, median (ms)", waits.map(|waits| 1e3 * quantile(waits, 0.5)), 1);
    let waits = seen.waits.each_mut();
    row("offer to next assignment, 99 % (ms)", waits.map(|waits| 1e3 * quantile(waits, 0.99)), 1);
    row("memory of the orchestrator (MB)", *memory, 0);
    let mut delays = delays(log, &seen);
    let [median, most, worst] = [0.5, 0.99, 1.0].map(|share| 1e3 * quantile(&mut delays, share));
    println!(
        "  from a commit to the last agent's shared memory: {median:.0} ms (99 % {most:.0}, worst {worst:.0}; {} versions)",
        delays.len()
    );
}

/// For each version that every agent received, or a later one: delay from its commit to the last agent, s.
fn delays(log: &Log, seen: &Seen) -> Vec<f64> {
    let last = |(version, committed): &(u64, f64)| {
        let there = seen.versions.iter().map(|agent| {
            let first = agent.partition_point(|(other, _)| other < version);
            agent.get(first).map(|(_, time)| time - committed)
        });
        there.collect::<Option<Vec<_>>>()?.into_iter().reduce(f64::max)
    };
    log.versions.iter().skip(1).filter_map(last).collect()
}
