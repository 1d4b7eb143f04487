//! Replays the labels of a finished campaign in the order in which structures were found, and in the order of their value.
//!
//! `cargo bench --bench label_order -- CAMPAIGN MODEL MIXTURE [--seed N] [--held-out SHARE]` prints JSON: the candidates whose labels are
//! held out, and the others in both orders, each with whether its label completes and its core-seconds. MODEL and MIXTURE are
//! those of the campaign (`kokkos.npz`, `gmm_artifacts.npz`), which must have one version of the potential. `measure.py`
//! trains with what it prints.
//!
//! Each order is made by the queue itself, in a copy of the store without labels: a label arrives when its job is leased, so an
//! order knows only the labels before it. Held-out are all structures of a random share of the biased walks and of their
//! controls, whose jobs are dropped before.

use std::collections::{BTreeSet, HashMap};
use std::error::Error;
use std::path::Path;

use calm::Artifact;
use monitor::label_value::{FeatureScales, LabelOrderReader, order};
use potentials::grace::GraceModel;
use serde_json::{Value, json};
use sqlx::sqlite::SqliteConnectOptions;
use sqlx::{ConnectOptions, Connection};
use store::{ExportFilter, JobState, Label, LabelValue, Lease, Store};
use wire::ContentHash;

/// The order is computed again after this part of the queue.
const CHANGED_PART: usize = 10;
const MAX_CHANGES: usize = 50;
const PAGE: u32 = 256;

/// Undoes every label. Triggers keep the counts of jobs.
const WITHOUT_LABELS: &str = "DELETE FROM archive; DELETE FROM label; DELETE FROM attempt;
    UPDATE job SET state = 'queued', attempts = 0, failures = 0, holder = NULL, expires = NULL, relabel = NULL,
        value = NULL, value_factors = NULL WHERE state IN ('labelled', 'failed', 'leased');
    UPDATE campaign SET value = '0' WHERE key IN ('labels_made', 'core_milliseconds', 'label_core_milliseconds');";

type AnyResult<T> = Result<T, Box<dyn Error>>;

/// A recorded campaign.
struct Recording {
    store: Store,
    protocol: ContentHash,
    labels: HashMap<ContentHash, Label>,
    scales: FeatureScales,
}

#[derive(Debug)]
struct Arguments {
    paths: [String; 3],
    seed: u64,
    held_out: f64,
}

impl Arguments {
    fn parse() -> AnyResult<Self> {
        let (mut paths, mut seed, mut held_out) = (Vec::new(), 0, 0.25);
        let mut words = std::env::args().skip(1).filter(|word| word != "--bench");
        while let Some(word) = words.next() {
            match word.as_str() {
                "--seed" => seed = words.next().ok_or("--seed needs a number")?.parse()?,
                "--held-out" => held_out = words.next().ok_or("--held-out needs a share")?.parse()?,
                _ => paths.push(word),
            }
        }
        let paths = paths.try_into().map_err(|_| "expected CAMPAIGN MODEL MIXTURE")?;
        Ok(Self { paths, seed, held_out })
    }
}

fn main() -> AnyResult<()> {
    // `cargo test --benches` starts it without arguments.
    if std::env::args().len() <= 2 {
        return Ok(());
    }
    let Arguments { paths: [campaign, model, mixture], seed, held_out } = Arguments::parse()?;
    let runtime = tokio::runtime::Builder::new_multi_thread().enable_all().build()?;
    let printed = runtime.block_on(async {
        let recording = Recording::read(Path::new(&campaign), Path::new(&model), Path::new(&mixture)).await?;
        let left_out = recording.held_out(seed, held_out).await?;
        let found = recording.replay(&left_out, false).await?;
        let value = recording.replay(&left_out, true).await?;
        AnyResult::Ok(json!({ "seed": seed, "held_out": left_out, "found": found, "value": value }))
    })?;
    println!("{printed}");
    Ok(())
}

impl Recording {
    async fn read(campaign: &Path, model: &Path, mixture: &Path) -> AnyResult<Self> {
        let store = Store::open_read_only(campaign).await?;
        let protocol = store.protocol_in_force().await?.ok_or("the campaign has no label protocol")?.hash;
        if !store.walk_versions().await?.is_single() {
            return Err(
                "the campaign has several versions of its potential: replay one without [refit]".into()
            );
        }
        let filter = ExportFilter { protocol, biased: true, control: true, imported: false };
        let (mut labels, mut after) = (HashMap::new(), None);
        loop {
            let page = store.labelled(&filter, after, PAGE).await?;
            let Some(last) = page.last() else { break };
            after = Some(last.cursor);
            labels
                .extend(page.into_iter().map(|row| (ContentHash::from_structure(&row.structure), row.label)));
        }
        let elements = GraceModel::load(model)?.elements().to_vec();
        let scales = FeatureScales::new(&Artifact::load(mixture)?.mixture, &elements);
        Ok(Self { store, protocol, labels, scales })
    }

    /// Names of the candidates of a random share of the biased walks and of their controls.
    async fn held_out(&self, seed: u64, share: f64) -> AnyResult<Vec<String>> {
        let walks = self.store.load_walks().await?;
        let pair = |walk: &store::WalkRecord| walk.partner.unwrap_or(walk.walk).0;
        let pairs: BTreeSet<u32> = walks.iter().map(pair).collect();
        let number = ((share * pairs.len() as f64).round() as usize).max(1);
        let mut drawn: Vec<u32> = pairs.into_iter().collect();
        drawn.sort_by(|a, b| uniform(seed, *a).total_cmp(&uniform(seed, *b)));
        let left_out: BTreeSet<u32> = drawn.into_iter().take(number).collect();
        let pairs: HashMap<u32, u32> = walks.iter().map(|walk| (walk.walk.0, pair(walk))).collect();
        let jobs = self.store.queue_list(None, u32::MAX, 0).await?;
        let is_left_out = |walk: &u32| pairs.get(walk).is_some_and(|pair| left_out.contains(pair));
        let names = jobs.into_iter().filter(|job| job.origin != "imported" && is_left_out(&job.walk));
        Ok(names.map(|job| job.candidate).collect())
    }

    /// The labels that are not left out, in one of both orders.
    async fn replay(&self, left_out: &[String], by_value: bool) -> AnyResult<Vec<Value>> {
        let directory = tempfile::tempdir()?;
        let copy = directory.path().join("copy");
        self.store.backup(&copy, 0, |_, _| {}).await?;
        let options = SqliteConnectOptions::new().filename(copy.join(store::DATABASE)).foreign_keys(false);
        let mut connection = options.connect().await?;
        sqlx::raw_sql(WITHOUT_LABELS).execute(&mut connection).await?;
        connection.close().await?;
        let queue = Store::open(copy.as_path()).await?;
        for name in left_out {
            if queue.queue_show(name).await?.job.state == JobState::Queued {
                queue.drop_job(name, 0).await?;
            }
        }
        let mut reader = LabelOrderReader::new(0, self.scales.clone());
        let (mut made, mut now, mut until_next) = (Vec::new(), 0, 0);
        loop {
            if by_value && until_next == 0 {
                until_next = self.compute_values(&queue, &mut reader).await?;
            }
            until_next = until_next.saturating_sub(1);
            let Some(lease) = queue.lease(self.protocol, "replay", now, 3600).await? else { break };
            made.push(self.finish(&queue, &lease, &mut now).await?);
        }
        queue.close().await;
        Ok(made)
    }

    /// Sets the values of the queue. Returns after how many labels they are to be computed again.
    async fn compute_values(&self, queue: &Store, reader: &mut LabelOrderReader) -> AnyResult<usize> {
        let inputs = reader.read(queue, self.protocol).await?;
        let ordered = order(&inputs.rows, &inputs.covering);
        let value = |valued: &monitor::label_value::ValuedLabel| LabelValue {
            job: valued.job,
            value: valued.value,
            factors: json!(valued.factors),
        };
        queue.set_label_values(&ordered.iter().map(value).collect::<Vec<_>>()).await?;
        Ok((ordered.len() / CHANGED_PART).clamp(1, MAX_CHANGES))
    }

    /// Ends a lease as the recorded campaign did, with the cost of its last attempt.
    async fn finish(&self, queue: &Store, lease: &Lease, now: &mut i64) -> AnyResult<Value> {
        let attempts = self.store.queue_show(&lease.candidate).await?.attempts_made;
        let last = attempts.last();
        let lasted = last.and_then(|attempt| Some(attempt.ended? - attempt.started)).unwrap_or(1);
        let core_seconds = last.and_then(|attempt| attempt.core_seconds);
        if let Some(attempt) = last {
            queue.record_calculation(lease, "replay", &attempt.made).await?;
        }
        if let Some(core_seconds) = core_seconds {
            queue.record_cost(lease, core_seconds, "").await?;
        }
        *now += lasted.max(1);
        let label = self.labels.get(&ContentHash::from_structure(&lease.structure));
        match label {
            Some(label) => queue.complete(lease, label, *now).await.map(|_| ())?,
            None => queue.fail(lease, "not_converged", "", 1, *now).await.map(|_| ())?,
        }
        let core_seconds = core_seconds.unwrap_or(lasted as f64 / 1000.0);
        Ok(json!({ "candidate": lease.candidate, "labelled": label.is_some(), "core_seconds": core_seconds }))
    }
}

/// A number between 0 and 1 that follows from both (SplitMix64).
fn uniform(seed: u64, number: u32) -> f64 {
    let mut z = (seed << 32 | u64::from(number)).wrapping_add(1).wrapping_mul(0x9e37_79b9_7f4a_7c15);
    z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    ((z ^ (z >> 31)) >> 11) as f64 / (1_u64 << 53) as f64
}
