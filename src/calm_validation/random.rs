//! Random numbers as a function of a random seed and a number.

use md::philox;

/// A sequence of random numbers.
pub struct RandomSequence {
    key: [u32; 2],
    sequence: [u32; 2],
    position: u64,
}

impl RandomSequence {
    /// Sequence number `sequence` of this random seed.
    pub fn new(seed: u64, sequence: u64) -> Self {
        Self { key: halves(seed), sequence: halves(sequence), position: 0 }
    }

    /// Uniform in (0, 1).
    pub fn uniform(&mut self) -> f64 {
        let [a, b] = halves(self.position);
        self.position += 1;
        let [high, low, ..] = philox([a, b, self.sequence[0], self.sequence[1]], self.key);
        let bits = (u64::from(high) << 32 | u64::from(low)) >> 11;
        (bits as f64 + 0.5) / (1_u64 << 53) as f64
    }

    /// A whole number below `limit`.
    pub fn below(&mut self, limit: usize) -> usize {
        ((self.uniform() * limit as f64) as usize).min(limit.saturating_sub(1))
    }

    /// Standard normal (Box & Muller, Ann. Math. Stat. 29, 610 (1958)).
    pub fn normal(&mut self) -> f64 {
        let (u, v) = (self.uniform(), self.uniform());
        (-2.0 * u.ln()).sqrt() * (std::f64::consts::TAU * v).cos()
    }
}

fn halves(x: u64) -> [u32; 2] {
    [x as u32, (x >> 32) as u32]
}
