//! A station with servers and one queue.

use std::collections::VecDeque;

/// Serves jobs in the order of their arrival.
pub struct Station<T> {
    free: usize,
    servers: usize,
    queue: VecDeque<(T, f64)>,
    /// Longest queue so far.
    pub longest: usize,
    /// Service time of all jobs that have begun, s.
    work: f64,
}

impl<T> Station<T> {
    pub fn new(servers: usize) -> Self {
        Self { free: servers, servers, queue: VecDeque::new(), longest: 0, work: 0.0 }
    }

    /// A job with its service time, s. Returns it if it begins now.
    pub fn enter(&mut self, job: T, time: f64) -> Option<(T, f64)> {
        self.queue.push_back((job, time));
        self.begin()
    }

    /// A job that goes before those that wait.
    pub fn enter_first(&mut self, job: T, time: f64) -> Option<(T, f64)> {
        self.queue.push_front((job, time));
        self.begin()
    }

    /// A job has ended. Returns the one that begins now.
    pub fn leave(&mut self) -> Option<(T, f64)> {
        self.free += 1;
        self.begin()
    }

    /// Share of the servers that was busy in this time, s.
    pub fn load(&self, seconds: f64) -> f64 {
        self.work / (seconds * self.servers as f64)
    }

    fn begin(&mut self) -> Option<(T, f64)> {
        if self.free > 0
            && let Some((job, time)) = self.queue.pop_front()
        {
            self.free -= 1;
            self.work += time;
            return Some((job, time));
        }
        self.longest = self.longest.max(self.queue.len());
        None
    }
}

/// Checks the mean wait of random arrivals with one server and a constant service time of 1, ρ / (2 (1 − ρ)).
pub fn check() {
    const LOAD: f64 = 0.7;
    const JOBS: usize = 200_000;
    let (mut station, mut arrival, mut ends) = (Station::new(1), 0.0, None);
    let (mut waited, mut bits) = (0.0, 1_u64);
    for _ in 0..JOBS {
        bits = bits.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        arrival -= (((bits >> 11) as f64 + 0.5) / (1_u64 << 53) as f64).ln() / LOAD;
        while let Some(end) = ends.filter(|end| *end <= arrival) {
            ends = station.leave().map(|(job, time): (f64, f64)| {
                waited += end - job;
                end + time
            });
        }
        if let Some((_, time)) = station.enter(arrival, 1.0) {
            ends = Some(arrival + time);
        }
    }
    let (mean, known) = (waited / JOBS as f64, LOAD / (2.0 * (1.0 - LOAD)));
    assert!((mean / known - 1.0).abs() < 0.05, "mean wait {mean}, expected {known}");
}
