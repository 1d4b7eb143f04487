//! The stages of a candidate's path, each measured alone on one thread, with the candidates of the whole run.

use std::path::Path;
use std::sync::Arc;
use std::time::{Duration, Instant};

use calm::Mixture;
use orchestrator::reactor::commit_batch;
use orchestrator::selector::{Scheduling, SelectorSettings};
use sqlx::sqlite::{SqliteConnectOptions, SqliteConnection, SqliteJournalMode, SqliteSynchronous};
use sqlx::{ConnectOptions, Connection};
use store::{Commit, Location};
use wire::CandidateBlock;

use crate::campaign::{checked, create_store, report, selector};
use crate::recording::Model;

/// Time spent in each stage; indented stages are parts of the one before.
#[derive(Default)]
pub struct Stages {
    pub check: Duration,
    pub decide: Duration,
    pub bonds: Duration,
    pub grades: Duration,
    pub search: Duration,
    pub watch: Duration,
    pub commit: Duration,
}

fn timed<T>(total: &mut Duration, work: impl FnOnce() -> T) -> T {
    let begun = Instant::now();
    let result = work();
    *total += begun.elapsed();
    result
}

impl Stages {
    /// Passes all candidates through the selector without a reactor, and repeats each part of a decision alone; then writes
    /// the commits to a database in groups of this size.
    pub async fn measure(
        model: &Model,
        settings: &SelectorSettings,
        recording: &[Vec<CandidateBlock>],
        group: usize,
        location: Location,
    ) -> Self {
        let mut stages = Self::default();
        let commits = stages.decide(model, settings, recording);
        stages.commit(commits, recording.len(), group, location).await;
        stages
    }

    /// Passes all candidates through the selector; the commits.
    pub fn decide(
        &mut self,
        model: &Model,
        settings: &SelectorSettings,
        recording: &[Vec<CandidateBlock>],
    ) -> Vec<Commit> {
        let mut selector = selector(model, recording.len(), settings);
        let mut commits = vec![selector.start_walks()];
        let mut offers: Vec<_> = recording.iter().map(|blocks| blocks.iter()).collect();
        let mut assignments = Vec::new();
        loop {
            while let Scheduling::Assign(assignment) = selector.next_assignment(0) {
                assignments.push(assignment);
            }
            if assignments.is_empty() {
                return commits;
            }
            for assignment in assignments.drain(..) {
                let block = offers[assignment.walk.0 as usize].next();
                let before = Arc::clone(selector.mixture());
                let report = report(&assignment, block.cloned());
                commits.extend(timed(&mut self.decide, || selector.report(report)).unwrap());
                if let Some(block) = block {
                    self.parts(model, settings, block, &before, selector.mixture());
                }
            }
        }
    }

    /// Repeats the parts of a decision.
    fn parts(
        &mut self,
        model: &Model,
        settings: &SelectorSettings,
        block: &CandidateBlock,
        before: &Arc<Mixture>,
        after: &Arc<Mixture>,
    ) {
        timed(&mut self.check, || checked(block.clone()));
        let view = block.view();
        let bonds = timed(&mut self.bonds, || model.grader.bonds(&view.structure())).unwrap();
        timed(&mut self.grades, || bonds.grade(before, view.features)).unwrap();
        if !Arc::ptr_eq(before, &model.original) {
            timed(&mut self.grades, || bonds.grade(&model.original, view.features)).unwrap();
        }
        if !Arc::ptr_eq(before, after) {
            let search = || calm::update(before, &bonds.elements, view.features, &settings.search);
            timed(&mut self.search, search).unwrap();
            let mut training = model.training.clone();
            let watch = || training.regrade(after, |_| true);
            timed(&mut self.watch, watch).unwrap();
        }
    }

    async fn commit(&mut self, commits: Vec<Commit>, walks: usize, size: usize, location: Location) {
        let store = create_store(location, walks).await;
        let mut commits = commits.into_iter().peekable();
        while commits.peek().is_some() {
            let mut whole = Commit::default();
            commits.by_ref().take(size).for_each(|commit| commit_batch::append(&mut whole, commit));
            let begun = Instant::now();
            store.commit(&whole).await.unwrap();
            self.commit += begun.elapsed();
        }
        store.close().await;
    }
}

/// Time that SQLite itself, with its own settings of pages and log, needs to insert as many rows of the same size, in
/// one transaction per group.
pub async fn plain_inserts(rows: usize, bytes: usize, group: usize, directory: &Path) -> Duration {
    let options =
        SqliteConnectOptions::new().filename(directory.join("plain.sqlite")).create_if_missing(true);
    let options = options.journal_mode(SqliteJournalMode::Wal).synchronous(SqliteSynchronous::Full);
    let mut connection: SqliteConnection = options.connect().await.unwrap();
    sqlx::query("CREATE TABLE row (number INTEGER PRIMARY KEY, bytes BLOB)")
        .execute(&mut connection)
        .await
        .unwrap();
    let row = vec![0x5a_u8; bytes];
    let begun = Instant::now();
    for first in (0..rows).step_by(group) {
        let mut transaction = connection.begin().await.unwrap();
        for _ in first..rows.min(first + group) {
            let insert = sqlx::query("INSERT INTO row (bytes) VALUES (?)").bind(&row);
            insert.execute(&mut *transaction).await.unwrap();
        }
        transaction.commit().await.unwrap();
    }
    begun.elapsed()
}
