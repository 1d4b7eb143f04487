//! Derivatives with respect to matrices.

use super::instructions::{Instructions, SimdPass};
use super::matrix::StridedRows;
use super::vector::Vector;
use super::weight_map::WeightMap;

/// ∂L/∂M of the matrices `[type][input × output]` of a map.
#[derive(Clone, Debug)]
pub(super) struct WeightGradient<V> {
    /// Lanes of a row of inputs and of a row of outputs.
    lanes: [usize; 2],
    /// `[type, panel, padded input]`, where a panel is one lane of outputs.
    sums: Vec<V>,
}

/// A sum of outer products, compiled for the best instructions.
struct OuterProducts<'a, V> {
    sums: &'a mut WeightGradient<V>,
    slots: usize,
    x: (&'a [V], StridedRows<'a>),
    y: (&'a [V], StridedRows<'a>),
}

impl<V: Vector> SimdPass for OuterProducts<'_, V> {
    #[inline(always)]
    fn run(self, _: bool) {
        self.sums.add_outer_products(0, self.slots, self.x, self.y);
    }
}

/// Inputs summed together, in registers.
const INPUTS: usize = 8;

impl<V: Vector> WeightGradient<V> {
    /// Zeros.
    pub fn new(map: &WeightMap) -> Self {
        let lanes = [map.inputs.div_ceil(V::LANES), map.outputs.div_ceil(V::LANES)];
        Self { lanes, sums: vec![V::ZERO; map.types * lanes[1] * lanes[0] * V::LANES] }
    }

    /// Adds Σ x_i ȳ_o over `slots` slots of each row: for rows x that were multiplied by the matrix, and the
    /// cotangents ȳ of the results.
    #[inline(always)]
    pub fn add_outer_products(
        &mut self,
        element: usize,
        slots: usize,
        (x, from): (&[V], StridedRows),
        (y, to): (&[V], StridedRows),
    ) {
        let [of_input, panels] = self.lanes;
        let of_panel = of_input * V::LANES;
        let of_type = panels * of_panel;
        let first = if self.sums.len() == of_type { 0 } else { element * of_type };
        let x = V::flat(x);
        for panel in 0..panels {
            let out = &mut self.sums[first + panel * of_panel..][..of_panel];
            for (k, out) in out.chunks_exact_mut(INPUTS).enumerate() {
                let mut sums: [V; INPUTS] = std::array::from_fn(|i| out[i]);
                for (a, b) in from.starts.iter().zip(to.starts) {
                    let a = (*a as usize * from.slots + from.shift) * V::LANES + k * INPUTS;
                    let b = *b as usize * to.slots + to.shift + panel;
                    for slot in 0..slots {
                        let x = &x[a + slot * from.stride * V::LANES..][..INPUTS];
                        let y = &y[b + slot * to.stride];
                        for (sum, x) in sums.iter_mut().zip(x) {
                            sum.add_scaled(*x, y);
                        }
                    }
                }
                out.copy_from_slice(&sums);
            }
        }
    }

    /// The same for a matrix that all elements share, for callers compiled for the baseline.
    pub fn add_all_outer_products(&mut self, slots: usize, x: (&[V], StridedRows), y: (&[V], StridedRows)) {
        Instructions::best().run(OuterProducts { sums: self, slots, x, y });
    }

    /// Adds other sums.
    pub fn add(&mut self, other: &Self) {
        self.sums.iter_mut().zip(&other.sums).for_each(|(sum, x)| sum.add(x));
    }

    /// All sums.
    pub fn flat(&self) -> &[V::Number] {
        V::flat(&self.sums)
    }

    /// The same.
    pub fn flat_mut(&mut self) -> &mut [V::Number] {
        V::flat_mut(&mut self.sums)
    }

    /// `[type, input, output]`
    pub fn numbers(&self, map: &WeightMap) -> Vec<f64> {
        let [of_input, panels] = self.lanes;
        let at = |t: usize, i: usize, o: usize| {
            let lane = (t * panels + o / V::LANES) * of_input * V::LANES + i;
            self.sums[lane][o % V::LANES].into()
        };
        let of_type =
            |t: usize| (0..map.inputs).flat_map(move |i| (0..map.outputs).map(move |o| at(t, i, o)));
        (0..map.types).flat_map(of_type).collect()
    }
}
