//! Minimisation of a smooth function of many numbers by L-BFGS: Liu & Nocedal, Math. Program. 45, 503 (1989), with backtracking.

use std::collections::VecDeque;

/// Steps that are remembered.
const MEMORY: usize = 30;
/// Share of the expected decrease that a step must give (Armijo).
const DECREASE: f64 = 1e-4;
/// Times that a step is halved.
const HALVINGS: usize = 40;
/// Changes of the gradient with less of their norm along the step are not remembered.
const CURVATURE: f64 = 1e-12;

/// When a minimisation ends, and how far it goes at a time.
#[derive(Clone, Copy, Debug)]
pub struct Lbfgs {
    /// It ends at this value …
    pub target: f64,
    /// … or after so many evaluations.
    pub max_evaluations: usize,
    /// Largest change of a number in a step.
    pub reach: f64,
}

/// Where a minimisation ended.
#[derive(Clone, Debug)]
pub struct LowestPoint {
    /// The numbers.
    pub point: Vec<f64>,
    /// The function there; no larger than at the start.
    pub value: f64,
    /// Evaluations made.
    pub evaluations: usize,
}

/// A step, the change of the gradient along it, and their product.
struct RememberedStep {
    step: Vec<f64>,
    change: Vec<f64>,
    product: f64,
}

impl Lbfgs {
    /// Minimises `f`, which writes its gradient and returns its value; `None` where it has none, which no step goes to. Ends early when
    /// no step decreases `f`, or when `stop` returns true. `None` without a value at the start.
    pub fn minimise(
        &self,
        start: Vec<f64>,
        mut f: impl FnMut(&[f64], &mut [f64]) -> Option<f64>,
        stop: impl Fn() -> bool,
    ) -> Option<LowestPoint> {
        let (mut gradient, mut next) = (vec![0.0; start.len()], vec![0.0; start.len()]);
        let value = f(&start, &mut gradient).filter(|value| value.is_finite())?;
        let mut now = LowestPoint { point: start, value, evaluations: 1 };
        let mut memory = VecDeque::new();
        while now.value > self.target && now.evaluations < self.max_evaluations && !stop() {
            let direction = direction(&memory, &gradient);
            match self.step(&mut now, &direction, &gradient, &mut next, &mut f) {
                Some(step) => {
                    let change: Vec<_> = next.iter().zip(&gradient).map(|(new, old)| new - old).collect();
                    let product = dot(&step, &change);
                    if product > CURVATURE * (dot(&step, &step) * dot(&change, &change)).sqrt() {
                        if memory.len() == MEMORY {
                            memory.pop_front();
                        }
                        memory.push_back(RememberedStep { step, change, product });
                    }
                    std::mem::swap(&mut gradient, &mut next);
                }
                // Without memory, the direction is that of steepest descent.
                None if memory.is_empty() => break,
                None => memory.clear(),
            }
        }
        Some(now)
    }

    /// Goes along `direction` as far as `f` decreases enough. Returns the step, and leaves the gradient after it in `next`.
    fn step(
        &self,
        now: &mut LowestPoint,
        direction: &[f64],
        gradient: &[f64],
        next: &mut [f64],
        f: &mut impl FnMut(&[f64], &mut [f64]) -> Option<f64>,
    ) -> Option<Vec<f64>> {
        let slope = dot(direction, gradient);
        if slope.partial_cmp(&0.0) != Some(std::cmp::Ordering::Less) {
            return None;
        }
        let largest = direction.iter().fold(0.0, |largest: f64, x| largest.max(x.abs()));
        let mut length = (self.reach / largest).min(1.0);
        for _ in 0..HALVINGS {
            if now.evaluations >= self.max_evaluations {
                return None;
            }
            let step: Vec<_> = direction.iter().map(|x| length * x).collect();
            let point: Vec<_> = now.point.iter().zip(&step).map(|(x, dx)| x + dx).collect();
            now.evaluations += 1;
            let value = f(&point, next).filter(|value| *value <= now.value + DECREASE * length * slope);
            if let Some(value) = value {
                (now.point, now.value) = (point, value);
                return Some(step);
            }
            length *= 0.5;
        }
        None
    }
}

/// The direction of the next step: the negative gradient times the inverse Hessian of the remembered steps.
fn direction(memory: &VecDeque<RememberedStep>, gradient: &[f64]) -> Vec<f64> {
    let mut direction: Vec<_> = gradient.iter().map(|x| -x).collect();
    let mut weights = Vec::with_capacity(memory.len());
    for of in memory.iter().rev() {
        let weight = dot(&of.step, &direction) / of.product;
        add_multiple(&mut direction, -weight, &of.change);
        weights.push(weight);
    }
    if let Some(last) = memory.back() {
        let scale = last.product / dot(&last.change, &last.change);
        direction.iter_mut().for_each(|x| *x *= scale);
    }
    for (of, weight) in memory.iter().zip(weights.iter().rev()) {
        let correction = weight - dot(&of.change, &direction) / of.product;
        add_multiple(&mut direction, correction, &of.step);
    }
    direction
}

fn add_multiple(sum: &mut [f64], factor: f64, of: &[f64]) {
    sum.iter_mut().zip(of).for_each(|(sum, x)| *sum += factor * x);
}

fn dot(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).map(|(a, b)| a * b).sum()
}

#[cfg(test)]
mod tests {
    use super::*;

    const LIMITS: Lbfgs = Lbfgs { target: 1e-20, max_evaluations: 500, reach: 0.2 };

    /// Rosenbrock's valley (Comput. J. 3, 175 (1960)) in two dimensions; its minimum, 0, is at (1, 1).
    fn valley(x: &[f64], gradient: &mut [f64]) -> Option<f64> {
        let rise = x[1] - x[0] * x[0];
        gradient[0] = -400.0 * rise * x[0] - 2.0 * (1.0 - x[0]);
        gradient[1] = 200.0 * rise;
        Some(100.0 * rise * rise + (1.0 - x[0]).powi(2))
    }

    #[test]
    fn the_end_of_a_curved_valley_is_found() {
        let found = LIMITS.minimise(vec![-1.2, 1.0], valley, || false).unwrap();
        assert!(found.value <= 1e-20 && found.evaluations < 200, "{found:?}");
        assert!(found.point.iter().all(|x| (x - 1.0).abs() < 1e-9), "{found:?}");
    }

    #[test]
    fn it_ends_at_its_limits() {
        let (few, start) = (Lbfgs { max_evaluations: 7, ..LIMITS }, vec![-1.2, 1.0]);
        let found = few.minimise(start.clone(), valley, || false).unwrap();
        assert!(found.evaluations == 7 && found.value < 24.2, "{found:?}");
        assert_eq!(LIMITS.minimise(start.clone(), valley, || true).unwrap().evaluations, 1);
        assert!(LIMITS.minimise(start, |_, _| None, || false).is_none());
        // No step goes where there is no value.
        let wall = |x: &[f64], gradient: &mut [f64]| {
            gradient[0] = 1.0;
            (x[0] > 0.5).then_some(x[0])
        };
        let found = LIMITS.minimise(vec![1.0], wall, || false).unwrap();
        assert!((0.5..0.51).contains(&found.value), "{found:?}");
    }
}
