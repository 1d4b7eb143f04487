//! SOAP: Adam in the eigenbases of Shampoo's preconditioners.

use faer::{Mat, MatRef, Side};
use potentials::grace::WeightGroup;
use serde::{Deserialize, Serialize};

/// Decay of the preconditioners, of the mean of the gradient and of that of its square (Vyas et al., arXiv:2409.11321).
const DECAYS: [f64; 3] = [0.95, 0.9, 0.95];
/// Added to the root of the mean square.
const EPSILON: f64 = 1e-8;
/// Steps between two eigenbases of a preconditioner.
const INTERVAL: u64 = 5;
/// A side of a matrix that is longer has no preconditioner: its eigenbasis would cost more than the gradient.
const MAX_SIDE: usize = 256;

/// SOAP (Vyas et al., arXiv:2409.11321). An array of weights is a matrix W with the gradient G. The means of G Gᵀ and Gᵀ G, the
/// preconditioners of Shampoo (Gupta, Koren & Singer, ICML 2018), have eigenvectors U and V. Adam runs on Uᵀ G V, and its step turns
/// back: weights whose gradients are correlated move along the directions in which they vary together.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct SoapState {
    steps: u64,
    groups: Vec<GroupState>,
}

/// An array of weights.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
struct GroupState {
    /// Index of its first weight.
    begin: usize,
    rows: usize,
    columns: usize,
    /// Of G Gᵀ and of Gᵀ G.
    sides: [Preconditioner; 2],
    /// Mean of G, `[rows × columns]`.
    mean: Vec<f64>,
    /// Mean of the squares of Uᵀ G V.
    square: Vec<f64>,
}

/// The preconditioner of one side, `[n × n]`; empty if the side has none.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
struct Preconditioner {
    mean: Vec<f64>,
    /// Eigenvectors as columns.
    basis: Vec<f64>,
}

impl SoapState {
    /// Before the first step.
    pub fn new(groups: &[WeightGroup]) -> Self {
        let groups = groups.iter().map(|group| GroupState::new(group.range.start, &group.shape));
        Self { steps: 0, groups: groups.collect() }
    }

    /// Number of steps made.
    pub fn steps(&self) -> u64 {
        self.steps
    }

    /// Changes the weights of the groups that are not frozen.
    ///
    /// # Panics
    /// If a list is shorter than the groups.
    pub fn step(&mut self, weights: &mut [f64], gradient: &[f64], rate: f64, frozen: &[bool]) {
        self.steps += 1;
        for group in &mut self.groups {
            let range = group.begin..group.begin + group.rows * group.columns;
            if range.is_empty() || frozen[group.begin] {
                continue;
            }
            let change = group.change(&gradient[range.clone()], self.steps);
            for (number, weight) in weights[range].iter_mut().enumerate() {
                *weight -= rate * change[(number / group.columns, number % group.columns)];
            }
        }
    }
}

impl GroupState {
    fn new(begin: usize, shape: &[usize]) -> Self {
        let all: usize = shape.iter().product();
        // Its indices in order, divided where the sides become most alike.
        let rows = (0..=shape.len()).map(|at| shape[..at].iter().product::<usize>()).filter(|rows| *rows > 0);
        let rows = rows.min_by_key(|rows| (*rows).max(all / rows)).unwrap_or(1);
        let columns = all / rows;
        let sides = [rows, columns].map(Preconditioner::new);
        Self { begin, rows, columns, sides, mean: vec![0.0; all], square: vec![0.0; all] }
    }

    /// The step against this gradient, for a rate of 1.
    fn change(&mut self, gradient: &[f64], step: u64) -> Mat<f64> {
        let Self { rows, columns, sides: [left, right], mean, square, .. } = self;
        let (rows, columns) = (*rows, *columns);
        let g = MatRef::from_row_major_slice(gradient, rows, columns);
        left.add(g);
        right.add(g.transpose());
        if step % INTERVAL == 1 {
            left.turn();
            right.turn();
        }
        for (mean, g) in mean.iter_mut().zip(gradient) {
            *mean = DECAYS[1] * *mean + (1.0 - DECAYS[1]) * g;
        }
        let turned = |matrix| right.times_basis(left.transposed_basis_times(matrix).as_ref());
        let (g, mean) = (turned(g), turned(MatRef::from_row_major_slice(mean, rows, columns)));
        let power = i32::try_from(step).unwrap_or(i32::MAX);
        let [of_mean, of_square] = [DECAYS[1], DECAYS[2]].map(|decay| 1.0 - decay.powi(power));
        let scaled = Mat::from_fn(rows, columns, |i, k| {
            let square = &mut square[i * columns + k];
            *square = DECAYS[2] * *square + (1.0 - DECAYS[2]) * g[(i, k)] * g[(i, k)];
            mean[(i, k)] / of_mean / ((*square / of_square).sqrt() + EPSILON)
        });
        right.times_transposed_basis(left.basis_times(scaled.as_ref()).as_ref())
    }
}

impl Preconditioner {
    fn new(side: usize) -> Self {
        let numbers = if side <= MAX_SIDE { side * side } else { 0 };
        Self { mean: vec![0.0; numbers], basis: vec![0.0; numbers] }
    }

    fn side(&self) -> usize {
        self.mean.len().isqrt()
    }

    /// Adds M Mᵀ to the mean.
    fn add(&mut self, matrix: MatRef<'_, f64>) {
        if self.mean.is_empty() {
            return;
        }
        let (product, side) = (matrix * matrix.transpose(), self.side());
        for (number, mean) in self.mean.iter_mut().enumerate() {
            *mean = DECAYS[0] * *mean + (1.0 - DECAYS[0]) * product[(number / side, number % side)];
        }
    }

    /// Takes the eigenvectors of the mean. Keeps the old ones if they are not found.
    fn turn(&mut self) {
        let side = self.side();
        let mean = MatRef::from_row_major_slice(&self.mean, side, side);
        match mean.self_adjoint_eigen(Side::Lower) {
            Ok(found) => {
                let vectors = found.U();
                for (number, x) in self.basis.iter_mut().enumerate() {
                    *x = vectors[(number / side, number % side)];
                }
            }
            Err(_) if self.basis.iter().all(|x| *x == 0.0) => {
                self.basis.iter_mut().step_by(side + 1).for_each(|x| *x = 1.0);
            }
            Err(_) => {}
        }
    }

    fn basis(&self) -> Option<MatRef<'_, f64>> {
        let side = self.side();
        (side > 0).then(|| MatRef::from_row_major_slice(&self.basis, side, side))
    }

    fn basis_times(&self, matrix: MatRef<'_, f64>) -> Mat<f64> {
        self.basis().map_or_else(|| matrix.to_owned(), |basis| basis * matrix)
    }

    fn transposed_basis_times(&self, matrix: MatRef<'_, f64>) -> Mat<f64> {
        self.basis().map_or_else(|| matrix.to_owned(), |basis| basis.transpose() * matrix)
    }

    fn times_basis(&self, matrix: MatRef<'_, f64>) -> Mat<f64> {
        self.basis().map_or_else(|| matrix.to_owned(), |basis| matrix * basis)
    }

    fn times_transposed_basis(&self, matrix: MatRef<'_, f64>) -> Mat<f64> {
        self.basis().map_or_else(|| matrix.to_owned(), |basis| matrix * basis.transpose())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::adam::AdamState;

    fn group(begin: usize, shape: &[usize]) -> WeightGroup {
        let numbers: usize = shape.iter().product();
        WeightGroup { name: begin.to_string(), shape: shape.to_vec(), range: begin..begin + numbers }
    }

    /// G = U S Vᵀ: the first step is U Vᵀ, whatever S.
    #[test]
    fn the_first_step_has_no_scale_in_any_direction() {
        let (c, s) = (0.8, 0.6);
        let (u, v) = ([[c, -s], [s, c]], [[s, c], [-c, s]]);
        let product = |scales: [f64; 2]| -> Vec<f64> {
            (0..4).map(|n| (0..2).map(|k| u[n / 2][k] * scales[k] * v[n % 2][k]).sum()).collect()
        };
        let mut state = SoapState::new(&[group(0, &[2, 2]), group(4, &[3])]);
        let mut weights = vec![0.0; 7];
        let gradient = [product([7.0, 1e-3]), vec![1.0; 3]].concat();
        state.step(&mut weights, &gradient, 0.1, &[false, false, false, false, true, true, true]);
        for (weight, expected) in weights.iter().zip(product([0.1, 0.1])) {
            assert!((weight + expected).abs() < 1e-5, "{weights:?}");
        }
        assert_eq!((&weights[4..], state.steps()), (&[0.0; 3][..], 1));
    }

    #[test]
    fn arrays_become_matrices_of_similar_sides() {
        let sides = |shape: &[usize]| {
            let group = GroupState::new(0, shape);
            (group.rows, group.columns, group.sides.map(|side| side.side()))
        };
        assert_eq!(sides(&[8, 8, 15]), (64, 15, [64, 15]));
        assert_eq!(sides(&[1, 9, 8, 28]), (72, 28, [72, 28]));
        assert_eq!(sides(&[64, 64]), (64, 64, [64, 64]));
        assert_eq!(sides(&[5]), (1, 5, [1, 5]));
        assert_eq!(sides(&[]), (1, 1, [1, 1]));
        assert_eq!(sides(&[2, 300]), (2, 300, [2, 0]), "a long side has no preconditioner");
    }

    /// A matrix behind two ill-conditioned ones: ½ ‖A (W − W₀) B‖², where the gradients of weights are correlated.
    #[test]
    fn correlated_weights_converge_faster_than_with_adam() {
        const N: usize = 4;
        let mixing = |shift: usize| Mat::from_fn(N, N, |i, k| 1.0 / (i + k + 1 + shift) as f64);
        let (a, b) = (mixing(0), mixing(1));
        let gradient = |weights: &[f64]| -> (f64, Vec<f64>) {
            let rest = Mat::from_fn(N, N, |i, k| weights[N * i + k] - ((3 * i + 5 * k) as f64).sin());
            let error = &a * rest * &b;
            let gradient = a.transpose() * &error * b.transpose();
            (0.5 * error.squared_norm_l2(), (0..N * N).map(|n| gradient[(n / N, n % N)]).collect())
        };
        let mut soap = SoapState::new(&[group(0, &[N, N])]);
        let mut adam = AdamState::new(N * N);
        let (mut by_soap, mut by_adam) = (vec![0.0; N * N], vec![0.0; N * N]);
        for step in 0..400 {
            let rate = 0.02 * (1.0 - f64::from(step) / 400.0);
            let [of_soap, of_adam] = [&by_soap, &by_adam].map(|weights| gradient(weights).1);
            soap.step(&mut by_soap, &of_soap, rate, &[false; N * N]);
            adam.step(&mut by_adam, &of_adam, rate, &[false; N * N]);
        }
        let [by_soap, by_adam] = [by_soap, by_adam].map(|weights| gradient(&weights).0);
        assert!(by_soap < 0.1 * by_adam, "{by_soap:e} {by_adam:e}");
    }
}
