//! Vectors of numbers in double or single precision.
//!
//! Channels are the innermost index of every array, padded with zeros to whole vectors. Loops over a vector
//! have a fixed length, so the compiler vectorises them. Additions keep their order for any register width, so
//! the bits do not depend on it. Products are accumulated by fused multiply-add.

use std::fmt::Debug;
use std::ops::{Add, AddAssign, Div, Index, IndexMut, Mul, MulAssign, Sub, SubAssign};

use bytemuck::{Pod, Zeroable, must_cast_slice, must_cast_slice_mut};

/// The number type of the passes over atoms.
pub(super) trait Number:
    Copy
    + Debug
    + Default
    + PartialEq
    + Send
    + Sync
    + Into<f64>
    + Add<Output = Self>
    + Sub<Output = Self>
    + Mul<Output = Self>
    + Div<Output = Self>
    + AddAssign
    + SubAssign
    + MulAssign
{
    /// Target of the relative error of tables of radial functions: below the rounding error, but not far below,
    /// because finer tables lose more digits of their coefficients to cancellation in derivatives.
    const TABLE_ERROR: f64;

    /// The nearest number.
    fn round(x: f64) -> Self;
}

impl Number for f64 {
    const TABLE_ERROR: f64 = 1e-11;

    #[inline(always)]
    fn round(x: f64) -> Self {
        x
    }
}

impl Number for f32 {
    const TABLE_ERROR: f64 = 1e-8;

    #[inline(always)]
    fn round(x: f64) -> Self {
        x as Self
    }
}

/// Adjacent channels (for spherical harmonics: bonds) that are processed together: as many as an AVX-512
/// register holds.
pub(super) trait Vector:
    Copy + Debug + Default + Send + Sync + 'static + Index<usize, Output = Self::Number> + IndexMut<usize>
{
    type Number: Number;

    /// Number of lanes.
    const LANES: usize;

    /// Zero in every lane.
    const ZERO: Self;

    /// The same in every lane.
    fn splat(x: Self::Number) -> Self;

    /// The numbers of consecutive vectors.
    fn flat(vectors: &[Self]) -> &[Self::Number];

    /// As [`Vector::flat`].
    fn flat_mut(vectors: &mut [Self]) -> &mut [Self::Number];

    /// self += s x, lane by lane.
    fn add_scaled(&mut self, s: Self::Number, x: &Self);

    /// self += x, lane by lane.
    fn add(&mut self, x: &Self);

    /// self += x y, lane by lane.
    fn add_product(&mut self, x: &Self, y: &Self);

    /// self × y, lane by lane.
    fn product(&self, y: &Self) -> Self;

    /// s × self, lane by lane.
    #[inline(always)]
    fn scaled(&self, s: Self::Number) -> Self {
        Self::splat(s).product(self)
    }

    /// Σ over lanes: the upper half is added to the lower until one is left.
    fn horizontal_sum(&self) -> Self::Number;
}

/// Vectors are copied before use, which tells the compiler that they do not alias. Each fills one cache line,
/// because reads across two lines take twice as long.
macro_rules! vector {
    ($(#[$doc:meta])* $vector:ident, $number:ty, $lanes:literal) => {
        $(#[$doc])*
        #[derive(Clone, Copy, Debug, Default, PartialEq, Pod, Zeroable)]
        #[repr(C, align(64))]
        pub(super) struct $vector([$number; $lanes]);

        impl Index<usize> for $vector {
            type Output = $number;

            #[inline(always)]
            fn index(&self, lane: usize) -> &$number {
                &self.0[lane]
            }
        }

        impl IndexMut<usize> for $vector {
            #[inline(always)]
            fn index_mut(&mut self, lane: usize) -> &mut $number {
                &mut self.0[lane]
            }
        }

        impl Vector for $vector {
            type Number = $number;
            const LANES: usize = $lanes;
            const ZERO: Self = Self([0.0; $lanes]);

            #[inline(always)]
            fn splat(x: $number) -> Self {
                Self([x; $lanes])
            }

            #[inline(always)]
            fn flat(vectors: &[Self]) -> &[$number] {
                must_cast_slice(vectors)
            }

            #[inline(always)]
            fn flat_mut(vectors: &mut [Self]) -> &mut [$number] {
                must_cast_slice_mut(vectors)
            }

            #[inline(always)]
            fn add_scaled(&mut self, s: $number, x: &Self) {
                let (mut out, x) = (*self, *x);
                for k in 0..$lanes {
                    out[k] = s.mul_add(x[k], out[k]);
                }
                *self = out;
            }

            #[inline(always)]
            fn add(&mut self, x: &Self) {
                let (mut out, x) = (*self, *x);
                for k in 0..$lanes {
                    out[k] += x[k];
                }
                *self = out;
            }

            #[inline(always)]
            fn add_product(&mut self, x: &Self, y: &Self) {
                let (mut out, x, y) = (*self, *x, *y);
                for k in 0..$lanes {
                    out[k] = x[k].mul_add(y[k], out[k]);
                }
                *self = out;
            }

            #[inline(always)]
            fn product(&self, y: &Self) -> Self {
                let (mut out, y) = (*self, *y);
                for k in 0..$lanes {
                    out[k] *= y[k];
                }
                out
            }

            #[inline(always)]
            fn horizontal_sum(&self) -> $number {
                let (mut sums, mut half) = (*self, $lanes / 2);
                while half > 0 {
                    for k in 0..half {
                        sums[k] += sums[k + half];
                    }
                    half /= 2;
                }
                sums[0]
            }
        }
    };
}

vector!(
    /// Double precision.
    Double,
    f64,
    8
);
vector!(
    /// Single precision.
    Single,
    f32,
    16
);

/// Largest number of lanes.
pub(super) const MAX_LANES: usize = 16;

/// Number of vectors that hold `channels` numbers.
pub(super) fn lanes_for<V: Vector>(channels: usize) -> usize {
    channels.div_ceil(V::LANES)
}

/// `channels`, rounded and padded with zeros to whole vectors.
pub(super) fn to_lanes<V: Vector>(channels: &[f64]) -> Vec<V> {
    let mut vectors = vec![V::ZERO; lanes_for::<V>(channels.len())];
    for (to, from) in V::flat_mut(&mut vectors).iter_mut().zip(channels) {
        *to = V::Number::round(*from);
    }
    vectors
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn all_lanes_are_summed() {
        let double = Double(std::array::from_fn(|k| (k + 1) as f64));
        let single = Single(std::array::from_fn(|k| (k + 1) as f32));
        assert_eq!((double.horizontal_sum(), single.horizontal_sum()), (36.0, 136.0));
    }

    #[test]
    fn padding_is_zero() {
        let lanes: Vec<Single> = to_lanes(&[0.1; 17]);
        assert_eq!(lanes.len(), 2);
        assert_eq!(Single::flat(&lanes)[16], 0.1_f32);
        assert!(Single::flat(&lanes)[17..].iter().all(|x| *x == 0.0));
    }
}
