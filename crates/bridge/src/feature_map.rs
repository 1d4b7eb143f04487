//! From the invariants of an adapter to the features that are graded, and back (paper, Methods: Latent features and uncertainty
//! models).

use calm::Projection;
use faer::linalg::matmul::matmul;
use faer::{Accum, MatMut, MatRef, Par};

/// ε₀ of the paper.
const NORM_FLOOR: f64 = 1e-12;
/// Keeps the norm's derivative finite at B = 0.
const SQUARE_FLOOR: f64 = 1e-30;

/// z = (T(B̂ R), s log(‖B‖ + ε₀), s log(‖B₁‖ + ε₀), …) with B̂ = B / (‖B‖ + ε₀), where the B_k are the invariants of each layer.
#[derive(Clone, Debug, PartialEq)]
pub struct RawProjection {
    projection: Projection,
    matrix: Vec<f64>,
    blocks: Vec<usize>,
}

/// What the pull-back needs of the forward pass.
#[derive(Clone, Debug, Default)]
pub(crate) struct MappedFeatures {
    /// B, `[n × rows]`.
    raw: Vec<f64>,
    /// B̂ R, `[n × columns]`.
    projected: Vec<f64>,
    /// ‖B‖ and ‖B_k‖, `[n × (1 + blocks)]`.
    norms: Vec<f64>,
    /// z, `[n × D]`.
    pub features: Vec<f64>,
}

impl RawProjection {
    /// A projection of invariants in these blocks.
    ///
    /// # Errors
    /// A projection of other invariants.
    pub fn new(projection: Projection, blocks: &[usize]) -> Result<Self, String> {
        let rows: usize = blocks.iter().sum();
        if projection.rows != rows {
            return Err(format!(
                "the projection is one of {} invariants, the model has {rows}",
                projection.rows
            ));
        }
        let norms = if projection.density_channels { 1 + blocks.len() } else { 0 };
        if projection.feature_dimension != projection.columns + norms {
            return Err(format!(
                "the projection has {} features, expected {} of {} layers",
                projection.feature_dimension,
                projection.columns + norms,
                blocks.len()
            ));
        }
        let matrix = projection.matrix.iter().map(|x| f64::from(*x)).collect();
        Ok(Self { projection, matrix, blocks: blocks.to_vec() })
    }

    /// As artifacts store it.
    pub fn projection(&self) -> &Projection {
        &self.projection
    }

    /// D
    pub fn dimension(&self) -> usize {
        self.projection.feature_dimension
    }

    fn matrix(&self) -> MatRef<'_, f64> {
        MatRef::from_row_major_slice(&self.matrix, self.projection.rows, self.projection.columns)
    }

    /// Computes the features of `raw`, `[n × rows]`.
    pub(crate) fn forward(&self, raw: &[f64], work: &mut MappedFeatures) {
        let Projection { rows, columns, normalised, density_channels, density_scale, asinh, .. } =
            self.projection;
        let (n, n_norms) = (raw.len() / rows, 1 + self.blocks.len());
        work.raw.clear();
        work.raw.extend_from_slice(raw);
        work.norms.clear();
        for atom in raw.chunks_exact(rows) {
            work.norms.push(norm(atom));
            let mut rest = atom;
            for block in &self.blocks {
                let (own, others) = rest.split_at(*block);
                work.norms.push(norm(own));
                rest = others;
            }
        }
        work.projected.resize(n * columns, 0.0);
        let out = MatMut::from_row_major_slice_mut(&mut work.projected, n, columns);
        matmul(out, Accum::Replace, MatRef::from_row_major_slice(raw, n, rows), self.matrix(), 1.0, Par::Seq);
        let dimension = self.dimension();
        work.features.resize(n * dimension, 0.0);
        let atoms = work.features.chunks_exact_mut(dimension).zip(work.projected.chunks_exact_mut(columns));
        for ((z, projected), norms) in atoms.zip(work.norms.chunks_exact(n_norms)) {
            let scale = if normalised { 1.0 / (norms[0] + NORM_FLOOR) } else { 1.0 };
            projected.iter_mut().for_each(|x| *x *= scale);
            for (z, x) in z.iter_mut().zip(&*projected) {
                *z = if asinh { x.asinh() } else { *x };
            }
            if density_channels {
                for (z, norm) in z[columns..].iter_mut().zip(norms) {
                    *z = f64::from(density_scale) * (norm + NORM_FLOOR).ln();
                }
            }
        }
    }

    /// The cotangent of the invariants, `[n × rows]`, for one of the features, `[n × D]`.
    pub(crate) fn backward(&self, work: &MappedFeatures, cotangent: &[f64], out: &mut Vec<f64>) {
        let Projection { rows, columns, normalised, density_channels, density_scale, asinh, .. } =
            self.projection;
        let (n, n_norms, dimension) = (work.raw.len() / rows, 1 + self.blocks.len(), self.dimension());
        let mut of_projected = vec![0.0; n * columns];
        let atoms = of_projected.chunks_exact_mut(columns).zip(cotangent.chunks_exact(dimension));
        for ((out, z), projected) in atoms.zip(work.projected.chunks_exact(columns)) {
            for ((out, z), x) in out.iter_mut().zip(z).zip(projected) {
                *out = if asinh { z / (1.0 + x * x).sqrt() } else { *z };
            }
        }
        out.resize(n * rows, 0.0);
        let left = MatRef::from_row_major_slice(&of_projected, n, columns);
        let target = MatMut::from_row_major_slice_mut(&mut out[..], n, rows);
        matmul(target, Accum::Replace, left, self.matrix().transpose(), 1.0, Par::Seq);
        for (atom, out) in out.chunks_exact_mut(rows).enumerate() {
            let raw = &work.raw[atom * rows..][..rows];
            let norms = &work.norms[atom * n_norms..][..n_norms];
            let of_z = &cotangent[atom * dimension..][..dimension];
            let total = norms[0] + NORM_FLOOR;
            if normalised {
                let inner: f64 = of_projected[atom * columns..][..columns]
                    .iter()
                    .zip(&work.projected[atom * columns..][..columns])
                    .map(|(c, x)| c * x)
                    .sum();
                // ∂(B/(‖B‖ + ε₀))/∂B: the part along B shrinks.
                for (out, b) in out.iter_mut().zip(raw) {
                    *out = *out / total - inner / (total * norms[0]) * b;
                }
            }
            if density_channels {
                let factor = |k: usize| {
                    f64::from(density_scale) * of_z[columns + k] / ((norms[k] + NORM_FLOOR) * norms[k])
                };
                let mut first = 0;
                for (k, block) in self.blocks.iter().enumerate() {
                    let factor = factor(0) + factor(1 + k);
                    let range = first..first + block;
                    first = range.end;
                    out[range.clone()].iter_mut().zip(&raw[range]).for_each(|(out, b)| *out += factor * b);
                }
            }
        }
    }
}

fn norm(values: &[f64]) -> f64 {
    (values.iter().map(|x| x * x).sum::<f64>() + SQUARE_FLOOR).sqrt()
}

#[cfg(test)]
mod tests {
    use calm::build::random_projection;

    use super::*;

    const BLOCKS: [usize; 2] = [3, 4];

    fn numbers(count: usize, seed: f64) -> Vec<f64> {
        (0..count).map(|k| (seed + 1.7 * k as f64).sin() + 0.3 * (0.9 * k as f64 * seed).cos()).collect()
    }

    fn features(map: &RawProjection, raw: &[f64]) -> MappedFeatures {
        let mut work = MappedFeatures::default();
        map.forward(raw, &mut work);
        work
    }

    #[test]
    fn features_are_those_of_the_paper() {
        let map = RawProjection::new(random_projection(3, 7, 2, 2), &BLOCKS).unwrap();
        let raw = numbers(7, 0.4);
        let found = features(&map, &raw).features;
        let norm = |values: &[f64]| values.iter().map(|x| x * x).sum::<f64>().sqrt();
        for (column, found) in found[..2].iter().enumerate() {
            let expected: f64 = (0..7)
                .map(|row| raw[row] / norm(&raw) * f64::from(map.projection.matrix[2 * row + column]))
                .sum();
            assert!((found - expected).abs() < 1e-12);
        }
        let logs = [norm(&raw).ln(), norm(&raw[..3]).ln(), norm(&raw[3..]).ln()];
        found[2..].iter().zip(logs).for_each(|(found, expected)| assert!((found - expected).abs() < 1e-12));
    }

    /// Every combination of the options, against central differences.
    #[test]
    fn cotangents_are_pulled_back() {
        for options in 0..8 {
            let (normalised, asinh, density_channels) =
                (options & 1 == 1, options & 2 == 2, options & 4 == 4);
            let mut projection = random_projection(5, 7, 3, 2);
            projection.feature_dimension = if density_channels { 6 } else { 3 };
            let projection =
                Projection { normalised, asinh, density_channels, density_scale: 0.7, ..projection };
            let map = RawProjection::new(projection, &BLOCKS).unwrap();
            let (raw, cotangent) = (numbers(14, 1.1), numbers(2 * map.dimension(), 2.3));
            let mut found = Vec::new();
            map.backward(&features(&map, &raw), &cotangent, &mut found);
            let function = |raw: &[f64]| -> f64 {
                features(&map, raw).features.iter().zip(&cotangent).map(|(z, c)| z * c).sum()
            };
            for (k, found) in found.iter().enumerate() {
                let moved = |step: f64| {
                    let mut raw = raw.clone();
                    raw[k] += step;
                    function(&raw)
                };
                let expected = (moved(1e-5) - moved(-1e-5)) / 2e-5;
                assert!((found - expected).abs() < 1e-8, "{options}, {k}: {found} {expected}");
            }
        }
    }

    #[test]
    fn other_projections_are_refused() {
        assert!(RawProjection::new(random_projection(3, 8, 2, 2), &BLOCKS).is_err());
        assert!(RawProjection::new(random_projection(3, 7, 2, 1), &BLOCKS).is_err());
    }
}
