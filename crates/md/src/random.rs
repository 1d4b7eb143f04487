//! Counter-based random numbers: pure functions of their counters, so that repeating or continuing a sequence
//! needs no stored state.

use serde::{Deserialize, Serialize};

/// The use of a random number; different uses never share numbers.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[repr(u32)]
pub enum StreamId {
    /// Maxwell–Boltzmann velocities at the start of a walk.
    InitialVelocities = 0,
    /// The random force of the Langevin thermostat.
    Langevin = 1,
    /// Stochastic velocity rescaling.
    VelocityRescaling = 2,
    /// The random force on the cell.
    Cell = 3,
}

/// The random stream of one segment of a walk.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Stream {
    /// The campaign's random seed.
    pub rng_seed: u64,
    /// The walk.
    pub walk: u32,
    /// The segment of the walk, incremented by each return to a checkpoint.
    pub segment: u32,
}

impl Stream {
    /// The stream of segment `segment` of walk `walk`.
    pub fn new(rng_seed: u64, walk: u32, segment: u32) -> Self {
        Self { rng_seed, walk, segment }
    }

    /// Three independent standard normal numbers.
    ///
    /// The random seed encrypts walk and segment into the 64-bit key of the stream: two of n streams share a
    /// key with probability n²/2⁶⁵. Within a stream no two calls share a draw.
    pub fn normals(&self, step: u64, atom: u32, id: StreamId) -> [f64; 3] {
        let [k0, k1, ..] = philox([self.walk, self.segment, 0, 0], words(self.rng_seed));
        let [low, high] = words(step);
        let block = |b: u32| philox([low, high, atom, 2 * id as u32 + b], [k0, k1]);
        let ([x, y], [z, _]) = (box_muller(block(0)), box_muller(block(1)));
        [x, y, z]
    }
}

/// Two independent standard normal numbers from 128 random bits (Box & Muller, Ann. Math. Stat. 29, 610 (1958)).
fn box_muller(bits: [u32; 4]) -> [f64; 2] {
    let uniform = |high: u32, low: u32| {
        // 53 bits, in (0, 1].
        let integer = (u64::from(high) << 32 | u64::from(low)) >> 11;
        (integer + 1) as f64 / (1_u64 << 53) as f64
    };
    let radius = (-2.0 * uniform(bits[0], bits[1]).ln()).sqrt();
    let (sin, cos) = (std::f64::consts::TAU * uniform(bits[2], bits[3])).sin_cos();
    [radius * cos, radius * sin]
}

/// Philox4x32-10: 128 random bits for each counter and key.
///
/// Salmon, Moraes, Dror & Shaw, "Parallel random numbers: as easy as 1, 2, 3", SC11 (2011).
pub fn philox(counter: [u32; 4], key: [u32; 2]) -> [u32; 4] {
    let (mut x, mut k) = (counter, key);
    for _ in 0..10 {
        let [low0, high0] = words(0xD251_1F53 * u64::from(x[0]));
        let [low1, high1] = words(0xCD9E_8D57 * u64::from(x[2]));
        x = [high1 ^ x[1] ^ k[0], low1, high0 ^ x[3] ^ k[1], low0];
        // Weyl sequences of the golden ratio and of √3 − 1.
        k = [k[0].wrapping_add(0x9E37_79B9), k[1].wrapping_add(0xBB67_AE85)];
    }
    x
}

/// Lower and upper half.
fn words(x: u64) -> [u32; 2] {
    [x as u32, (x >> 32) as u32]
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The known-answer vectors that Random123 publishes.
    #[test]
    fn philox_gives_the_published_answers() {
        assert_eq!(philox([0; 4], [0; 2]), [0x6627_e8d5, 0xe169_c58d, 0xbc57_ac4c, 0x9b00_dbd8]);
        let ones = u32::MAX;
        assert_eq!(philox([ones; 4], [ones; 2]), [0x408f_276d, 0x41c8_3b0e, 0xa20b_c7c6, 0x6d54_51fd]);
        assert_eq!(
            philox([0x243f_6a88, 0x85a3_08d3, 0x1319_8a2e, 0x0370_7344], [0xa409_3822, 0x299f_31d0]),
            [0xd16c_fe09, 0x94fd_cceb, 0x5001_e420, 0x2412_6ea1]
        );
    }

    #[test]
    fn normals_have_the_moments_of_the_normal_distribution() {
        let stream = Stream::new(11, 3, 0);
        let n = 200_000;
        let mut sums = [0.0; 4];
        let mut correlation = 0.0;
        for step in 0..n {
            let [x, y, z] = stream.normals(step, 5, StreamId::Langevin);
            for value in [x, y, z] {
                (1..=4).for_each(|power| sums[power as usize - 1] += value.powi(power));
            }
            correlation += x * y + y * z + z * x;
        }
        let count = 3.0 * n as f64;
        // ⟨x⟩ … ⟨x⁴⟩ = 0, 1, 0, 3 with the variances 1, 2, 15, 96 of x … x⁴.
        for ((sum, expected), variance) in sums.iter().zip([0.0, 1.0, 0.0, 3.0]).zip([1.0, 2.0, 15.0, 96.0]) {
            let tolerance = 5.0 * f64::sqrt(variance / count);
            assert!((sum / count - expected).abs() < tolerance, "{} {expected}", sum / count);
        }
        assert!((correlation / count).abs() < 5.0 / count.sqrt());
    }

    #[test]
    fn each_part_of_the_address_changes_the_numbers() {
        let base = Stream::new(1, 2, 3).normals(4, 5, StreamId::Langevin);
        assert_eq!(base, Stream::new(1, 2, 3).normals(4, 5, StreamId::Langevin));
        for other in [
            Stream::new(2, 2, 3).normals(4, 5, StreamId::Langevin),
            Stream::new(1 << 32 | 1, 2, 3).normals(4, 5, StreamId::Langevin),
            Stream::new(1, 3, 3).normals(4, 5, StreamId::Langevin),
            Stream::new(1, 2, 4).normals(4, 5, StreamId::Langevin),
            Stream::new(1, 2, 3).normals(5, 5, StreamId::Langevin),
            Stream::new(1, 2, 3).normals(1 << 32 | 4, 5, StreamId::Langevin),
            Stream::new(1, 2, 3).normals(4, 6, StreamId::Langevin),
            Stream::new(1, 2, 3).normals(4, 5, StreamId::InitialVelocities),
        ] {
            assert!((0..3).all(|k| base[k] != other[k]));
        }
    }
}
