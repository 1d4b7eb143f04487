//! Discrete-event simulation of many walkers with one orchestrator, in virtual time, on one thread and from one seed.
//! It has no real selector or store, only their measured service times.
//!
//! `cargo bench -p orchestrator --bench virtual_scale`. Results are in `docs/scaling.md`.

mod station;

use std::cmp::Reverse;
use std::collections::BinaryHeap;

use station::Station;

// Service times in s; sources are sections of `docs/benchmarks.md`.
/// Selector, stages, features not kept: verification, bonds and grades (16 + 317 + 336 µs).
const REGRADE: f64 = 669e-6;
/// `docs/scaling.md`, deciding a declined candidate.
const DECLINE: f64 = 50e-6;
/// Selector, stages, all accepted: search for α.
const ACCEPT: f64 = 1008e-6;
/// Selector, stages, all accepted: monitoring of 2700 training atoms, divided by the cores.
const MONITOR: f64 = 4154e-6;
/// A commit of any size. SQLite alone, features not kept and all accepted: groups of 23 rows of 47 kB take 6.5 ms, groups
/// of 20 rows of 171 kB 14.4 ms; the line through both has 3.4 ms per MB and this at no bytes.
const FLUSH: f64 = 2.8e-3;
/// `store/src/sqlite/file.rs`: pages of the write-ahead log at which it is copied into the database, while a commit waits.
const LOG: f64 = 4096.0;
/// The same: 64 MB take about 0.1 s, here for each page. It is the disk's time and needs hardly a core. Pages of walks and indices that
/// commits rewrite are copied once and do not count here.
const COPY: f64 = 0.1 / LOG;
/// Selector, single commits: pages that a commit of any size writes into the log, …
const PAGES: f64 = 11.6;
/// … and those of each candidate, without and with features.
const CANDIDATE_PAGES: f64 = 3.5;
const KEPT_PAGES: f64 = 9.7;
/// Selector, stages, features not kept: a commit of 23 candidates takes 541 µs for each, this without the flush and the copies.
const COMMIT: f64 = 541e-6 - FLUSH / 23.0 - COPY * CANDIDATE_PAGES;
/// The same for mostly covered candidates with their features: groups of 29, 969 µs for each.
const KEPT: f64 = 969e-6 - FLUSH / 29.0 - COPY * KEPT_PAGES;
/// Bytes of an offer over the network, `docs/scaling.md`.
const BYTES: f64 = 150e3;
/// 10 Gbit/s.
const NETWORK: f64 = 1.25e9;
/// Share of new candidates in the bench `agents`.
const NEW: f64 = 0.02;
/// What an offer costs agents and connections, core-seconds. **Fitted** to the throughput of 1024 walkers as fast as
/// they can (782 per second on two cores); not measured.
const AGENT: f64 = 0.78e-3;
/// Memory, MB: base, and for each candidate offered and not answered. **Fitted** to 170 and 570 MB of 1024 walkers.
const BASE: f64 = 165.0;
const WAITING: f64 = 0.4;

/// What to simulate.
#[derive(Clone, Copy)]
struct Plan {
    name: &'static str,
    walkers: usize,
    agents: usize,
    /// Candidates per second that walkers would offer without waiting; 0 for as many as possible.
    rate: f64,
    cores: usize,
    /// Whether the agents use the cores of the orchestrator.
    shared: bool,
    /// Parallel commits, each of a shard of the candidates.
    writers: usize,
    /// Largest group of a commit.
    group: usize,
    /// Time of a commit for each candidate, s, and the pages that it writes.
    commit: f64,
    pages: f64,
    /// Core time of an offer for agents and connections, s.
    agent: f64,
    seconds: f64,
}

#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
enum Event {
    Offer(usize),
    Arrived(usize),
    Regraded(usize),
    Decided(usize),
    Written(usize),
    Copied(usize),
    Sent(usize),
}

#[derive(Clone, Copy, Default)]
struct Walker {
    offered: f64,
    version: usize,
}

struct Simulation {
    plan: Plan,
    now: f64,
    events: BinaryHeap<Reverse<(u64, u64, Event)>>,
    count: u64,
    random: u64,
    walkers: Vec<Walker>,
    network: Station<Event>,
    cores: Station<Event>,
    decide: Station<Event>,
    /// Decided candidates, waiting for a commit.
    decided: Vec<usize>,
    most_decided: usize,
    groups: Vec<Option<Vec<usize>>>,
    /// Pages in the log of each writer, and those that will be copied.
    logs: Vec<(f64, f64)>,
    commits: usize,
    writing: f64,
    version: usize,
    /// Time of the commit of each version, and when agents have it, s.
    committed: Vec<Option<f64>>,
    arrivals: Vec<Vec<(usize, f64)>>,
    waits: Vec<f64>,
    unanswered: usize,
    most_unanswered: usize,
}

fn main() {
    station::check();
    let bench = Plan {
        name: "1024, 400/s",
        walkers: 1024,
        agents: 32,
        rate: 400.0,
        cores: 2,
        shared: true,
        writers: 1,
        group: usize::MAX,
        commit: COMMIT,
        pages: CANDIDATE_PAGES,
        agent: AGENT,
        seconds: 60.0,
    };
    let many = Plan { walkers: 10_000, agents: 300, cores: 16, shared: false, ..bench };
    let elsewhere = Plan { commit: 0.1 * COMMIT, pages: 0.1 * CANDIDATE_PAGES, ..many };
    println!(
        "| | cand./s | accepts/s | answer median, ms | 99 %, ms | last agent median, ms | 99 %, ms | not answered, most | waiting for a core | for a decision | for a commit | per commit | cores busy | decision busy | writers busy | network busy | memory, MB |"
    );
    println!("{}", "|---".repeat(17) + "|");
    for plan in [
        bench,
        Plan { name: "1024, maximum", rate: 0.0, seconds: 30.0, ..bench },
        Plan {
            name: "64 walkers in process, maximum",
            walkers: 64,
            agents: 1,
            rate: 0.0,
            agent: 0.0,
            ..bench
        },
        Plan { name: "10⁴, 36/s", rate: 36.0, seconds: 600.0, ..many },
        Plan { name: "10⁴, 360/s", rate: 360.0, seconds: 120.0, ..many },
        Plan { name: "10⁴, 1000/s", rate: 1000.0, ..many },
        Plan { name: "10⁴, 1600/s", rate: 1600.0, ..many },
        Plan { name: "10⁴, 3600/s", rate: 3600.0, ..many },
        Plan {
            name: "… features of declined ones kept",
            rate: 3600.0,
            commit: KEPT,
            pages: KEPT_PAGES,
            ..many
        },
        Plan { name: "… 2 cores", rate: 3600.0, cores: 2, ..many },
        Plan { name: "… groups of 64 at most", rate: 3600.0, group: 64, ..many },
        Plan { name: "… 2 shards", rate: 3600.0, writers: 2, ..many },
        Plan { name: "… 4 shards", rate: 3600.0, writers: 4, ..many },
        Plan { name: "… declined ones elsewhere", rate: 3600.0, ..elsewhere },
        Plan { name: "… the same, maximum", rate: 0.0, ..elsewhere },
    ] {
        Simulation::new(plan).run().report();
    }
}

impl Simulation {
    fn new(plan: Plan) -> Self {
        Self {
            plan,
            now: 0.0,
            events: BinaryHeap::new(),
            count: 0,
            random: 1,
            walkers: vec![Walker::default(); plan.walkers],
            network: Station::new(1),
            cores: Station::new(plan.cores),
            decide: Station::new(1),
            decided: Vec::new(),
            most_decided: 0,
            groups: vec![None; plan.writers],
            logs: vec![(0.0, 0.0); plan.writers],
            commits: 0,
            writing: 0.0,
            version: 0,
            committed: vec![None],
            arrivals: vec![Vec::new(); plan.agents],
            waits: Vec::new(),
            unanswered: 0,
            most_unanswered: 0,
        }
    }

    /// Events of the first tenth of the time are not counted in delays and rates.
    fn measured(&self) -> bool {
        self.now > 0.1 * self.plan.seconds
    }

    fn run(mut self) -> Self {
        for walker in 0..self.plan.walkers {
            self.think(walker);
        }
        while let Some(Reverse((time, _, event))) = self.events.pop() {
            self.now = time as f64 * 1e-9;
            if self.now > self.plan.seconds {
                break;
            }
            self.handle(event);
        }
        self
    }

    fn handle(&mut self, event: Event) {
        match event {
            Event::Offer(walker) => {
                self.walkers[walker].offered = self.now;
                self.unanswered += 1;
                self.most_unanswered = self.most_unanswered.max(self.unanswered);
                let time = if self.plan.shared { 0.0 } else { BYTES / NETWORK };
                let begun = self.network.enter(Event::Arrived(walker), time);
                self.begin(begun);
            }
            Event::Arrived(walker) => {
                let next = self.network.leave();
                self.begin(next);
                // On hosts of their own, agents bear half of the cost of an offer.
                let agent = if self.plan.shared { self.plan.agent } else { 0.5 * self.plan.agent };
                let begun = self.cores.enter(Event::Regraded(walker), agent + REGRADE);
                self.begin(begun);
            }
            Event::Regraded(walker) => {
                let next = self.cores.leave();
                self.begin(next);
                let new = self.uniform() < NEW;
                if new {
                    self.version += 1;
                    self.committed.push(None);
                }
                self.walkers[walker].version = self.version;
                let time = if new { ACCEPT + MONITOR / self.plan.cores as f64 } else { DECLINE };
                let begun = self.decide.enter(Event::Decided(walker), time);
                self.begin(begun);
            }
            Event::Decided(walker) => {
                let next = self.decide.leave();
                self.begin(next);
                self.decided.push(walker);
                self.most_decided = self.most_decided.max(self.decided.len());
                self.write();
            }
            // The second part of a commit: its turn on a core has come, and it is on disk. The log may be copied then.
            Event::Written(writer) => {
                let next = self.cores.leave();
                self.begin(next);
                let mut copy = 0.0;
                if self.logs[writer].0 >= LOG {
                    copy = COPY * std::mem::take(&mut self.logs[writer]).1;
                }
                self.writing += copy;
                self.after(copy, Event::Copied(writer));
            }
            Event::Copied(writer) => {
                for walker in self.groups[writer].take().unwrap_or_default() {
                    self.commit(walker);
                }
                self.write();
            }
            Event::Sent(walker) => self.answer(walker),
        }
    }

    /// Begins a commit of all that is decided, if a writer is free, as the reactor does.
    fn write(&mut self) {
        let Some(writer) = self.groups.iter().position(Option::is_none) else { return };
        if self.decided.is_empty() {
            return;
        }
        let group: Vec<usize> = self.decided.drain(..self.decided.len().min(self.plan.group)).collect();
        let time = FLUSH + group.len() as f64 * self.plan.commit;
        let new = group.len() as f64 * self.plan.pages;
        let (pages, copied) = &mut self.logs[writer];
        (*pages, *copied) = (*pages + PAGES + new, *copied + new);
        self.groups[writer] = Some(group);
        self.commits += 1;
        self.writing += time;
        let begun = self.cores.enter_first(Event::Written(writer), time);
        self.begin(begun);
    }

    fn commit(&mut self, walker: usize) {
        let version = self.walkers[walker].version;
        self.committed[version].get_or_insert(self.now);
        // A round trip without the store is well below this.
        self.after(1e-3, Event::Sent(walker));
    }

    fn answer(&mut self, walker: usize) {
        self.unanswered -= 1;
        let Walker { offered, version } = self.walkers[walker];
        if self.measured() {
            self.waits.push(self.now - offered);
        }
        let agent = &mut self.arrivals[walker % self.plan.agents];
        if agent.last().is_none_or(|(last, _)| *last < version) {
            agent.push((version, self.now));
        }
        self.think(walker);
    }

    fn think(&mut self, walker: usize) {
        let mean = if self.plan.rate > 0.0 { self.plan.walkers as f64 / self.plan.rate } else { 0.0 };
        // The first offers come at any time of a walk.
        let share = if self.now == 0.0 { self.uniform() } else { 0.5 + self.uniform() };
        self.after(mean * share, Event::Offer(walker));
    }

    fn begin(&mut self, begun: Option<(Event, f64)>) {
        if let Some((event, time)) = begun {
            self.after(time, event);
        }
    }

    fn after(&mut self, time: f64, event: Event) {
        self.count += 1;
        self.events.push(Reverse((((self.now + time) * 1e9) as u64, self.count, event)));
    }

    /// SplitMix64, 0 to 1.
    fn uniform(&mut self) -> f64 {
        self.random = self.random.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut bits = self.random;
        bits = (bits ^ (bits >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        bits = (bits ^ (bits >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        ((bits ^ (bits >> 31)) >> 11) as f64 / (1_u64 << 53) as f64
    }

    /// Delay of each version from its commit to the last agent, s.
    fn delays(&self) -> Vec<f64> {
        let first = 0.1 * self.plan.seconds;
        let delay = |(version, committed): (usize, &Option<f64>)| {
            let committed = committed.filter(|time| *time > first)?;
            let arrival = |agent: &Vec<(usize, f64)>| {
                agent.get(agent.partition_point(|(other, _)| *other < version)).map(|(_, time)| *time)
            };
            let arrivals = self.arrivals.iter().map(arrival).collect::<Option<Vec<_>>>()?;
            arrivals.into_iter().reduce(f64::max).map(|last| last - committed)
        };
        self.committed.iter().enumerate().skip(1).filter_map(delay).collect()
    }

    fn report(mut self) {
        let (plan, seconds) = (self.plan, self.plan.seconds);
        let rate = self.waits.len() as f64 / (0.9 * seconds);
        let mut delays = self.delays();
        let accepted = self.version as f64 / seconds;
        let [median, most] = [0.5, 0.99].map(|share| 1e3 * quantile(&mut self.waits, share));
        let [last, last_most] = [0.5, 0.99].map(|share| 1e3 * quantile(&mut delays, share));
        let per_commit = rate * seconds / self.commits as f64;
        let [cores, decide, network] =
            [&self.cores, &self.decide, &self.network].map(|station| 100.0 * station.load(seconds));
        let writers = 100.0 * (self.writing / (seconds * plan.writers as f64)).min(1.0);
        let memory = BASE + WAITING * self.most_unanswered as f64;
        println!(
            "| {} | {rate:.0} | {accepted:.1} | {median:.1} | {most:.0} | {last:.0} | {last_most:.0} | {} | {} | {} | {} | {per_commit:.1} | {cores:.0} % | {decide:.0} % | {writers:.0} % | {network:.0} % | {memory:.0} |",
            plan.name, self.most_unanswered, self.cores.longest, self.decide.longest, self.most_decided
        );
    }
}

/// A quantile of numbers, which it sorts; NaN without any.
fn quantile(numbers: &mut [f64], share: f64) -> f64 {
    numbers.sort_by(f64::total_cmp);
    let last = numbers.len().saturating_sub(1);
    numbers.get((share * last as f64).round() as usize).copied().unwrap_or(f64::NAN)
}
