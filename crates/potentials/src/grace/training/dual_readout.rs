//! The readout with the derivative of each value along a direction, and its reverse pass.

use super::super::invariant_norm::{InvariantNorm, SQUARE_FLOOR};
use super::super::matrix::{Matrix, StridedRows};
use super::super::readout::{Readout, zeros};
use super::super::tape::AtomBatch;
use super::super::vector::{Double, Vector};
use super::sums::WeightSums;

/// Scratch arrays for one batch; each has a row per atom.
#[derive(Clone, Debug, Default)]
pub(super) struct DualReadoutWork {
    /// Values and derivatives after each layer of the perceptron, its input first.
    values: Vec<[Vec<Double>; 2]>,
    /// f′ and f″ x′ of each activation.
    slopes: Vec<[Vec<Double>; 2]>,
    cotangents: [Vec<Double>; 2],
    swap: Vec<Double>,
}

/// The densities W B of one layer and their derivatives, from those of its basis, one row per atom.
#[inline(always)]
pub(super) fn densities(
    weights: &Matrix<Double>,
    batch: &AtomBatch,
    bases: [&[Double]; 2],
    out: [&mut [Double]; 2],
) {
    for (basis, out) in bases.into_iter().zip(out) {
        out.fill(Double::ZERO);
        multiply(weights, batch, basis, out);
    }
}

/// Goes through the readout of a batch from the densities of each layer, and back from the cotangents `seeds` of the
/// derivative of each energy and of the energy, to those of the densities of each layer.
#[inline(always)]
pub(super) fn read_out(
    readout: &Readout<Double>,
    batch: &AtomBatch,
    seeds: [f64; 2],
    densities: &[[&[Double]; 2]],
    out: &mut [[&mut [Double]; 2]],
    (work, sums): (&mut DualReadoutWork, &mut WeightSums),
) {
    forward(readout, batch, densities, work);
    backward(readout, batch, seeds, work, sums);
    sums.shifts[batch.element] += seeds[1] * batch.atoms as f64;
    let lanes = readout.density_lanes();
    for (layer, (x, out)) in densities.iter().zip(out).enumerate() {
        let [along, values] = out;
        along.copy_from_slice(&work.cotangents[0]);
        values.copy_from_slice(&work.cotangents[1]);
        let Some(norm) = &readout.blocks[layer].norm else { continue };
        let of_scale = &mut sums.layers[layer].norm;
        for atom in 0..batch.atoms {
            let row = atom * lanes..(atom + 1) * lanes;
            let x = [Double::flat(&x[0][row.clone()]), Double::flat(&x[1][row.clone()])];
            let c = [Double::flat_mut(&mut along[row.clone()]), Double::flat_mut(&mut values[row])];
            norm_backward(norm, x, c, of_scale);
        }
    }
}

#[inline(always)]
fn forward(
    readout: &Readout<Double>,
    batch: &AtomBatch,
    densities: &[[&[Double]; 2]],
    work: &mut DualReadoutWork,
) {
    let (atoms, lanes) = (batch.atoms, readout.density_lanes());
    work.values.resize(readout.layers.len() + 1, Default::default());
    work.slopes.resize(readout.layers.len(), Default::default());
    work.values[0].iter_mut().for_each(|y| zeros(y, atoms * lanes));
    for (block, x) in readout.blocks.iter().zip(densities) {
        let [y, along] = &mut work.values[0];
        for atom in 0..atoms {
            let row = atom * lanes..(atom + 1) * lanes;
            let x = [Double::flat(&x[0][row.clone()]), Double::flat(&x[1][row.clone()])];
            let y = [Double::flat_mut(&mut y[row.clone()]), Double::flat_mut(&mut along[row])];
            add_normalised(block.norm.as_ref(), x, y);
        }
    }
    for (k, layer) in readout.layers.iter().enumerate() {
        let layer = layer.forward(0);
        let (before, after) = work.values.split_at_mut(k + 1);
        for (from, to) in before[k].iter().zip(&mut after[0]) {
            zeros(to, atoms * layer.output_lanes());
            multiply(layer, batch, from, to);
        }
        if k + 1 < readout.layers.len() {
            activate(readout, &mut after[0], &mut work.slopes[k]);
        }
    }
}

/// Applies the activation; keeps f′ and f″ x′.
#[inline(always)]
fn activate(
    readout: &Readout<Double>,
    [values, along]: &mut [Vec<Double>; 2],
    [slopes, bends]: &mut [Vec<Double>; 2],
) {
    slopes.clone_from(values);
    bends.clone_from(along);
    let rows = Double::flat_mut(values).iter_mut().zip(Double::flat_mut(along));
    let kept = Double::flat_mut(slopes).iter_mut().zip(Double::flat_mut(bends));
    for ((x, x_along), (slope, bend)) in rows.zip(kept) {
        *bend = readout.activation.curvature(*x) * *x_along;
        (*x, *slope) = readout.activation.evaluate(*x);
        *x_along *= *slope;
    }
}

/// From the energies to y.
#[inline(always)]
fn backward(
    readout: &Readout<Double>,
    batch: &AtomBatch,
    seeds: [f64; 2],
    work: &mut DualReadoutWork,
    sums: &mut WeightSums,
) {
    let (atoms, lanes, last) = (batch.atoms, readout.density_lanes(), readout.layers.len());
    for (c, seed) in work.cotangents.iter_mut().zip(seeds) {
        zeros(c, atoms);
        c.iter_mut().for_each(|c| c[0] = readout.scale * seed);
    }
    for (k, layer) in readout.layers.iter().enumerate().rev() {
        if k + 1 < last {
            deactivate(&work.slopes[k], &mut work.cotangents);
        }
        let rows = |stride| StridedRows::of_atoms(atoms, stride);
        let (from, to) = (rows(layer.forward(0).input_lanes()), rows(layer.forward(0).output_lanes()));
        let ([values, along], [c_along, c]) = (&work.values[k], &work.cotangents);
        sums.perceptron[k].add_outer_products(0, atoms, (along, from), (c_along, to));
        sums.perceptron[k].add_outer_products(0, atoms, (values, from), (c, to));
        for c in &mut work.cotangents {
            zeros(&mut work.swap, atoms * layer.transposed(0).output_lanes());
            multiply(layer.transposed(0), batch, c, &mut work.swap);
            std::mem::swap(&mut work.swap, c);
        }
    }
    for (c, seed) in work.cotangents.iter_mut().zip(seeds) {
        if last == 0 {
            zeros(c, atoms * lanes);
        }
        c.chunks_exact_mut(lanes).for_each(|row| row[0][0] += readout.scale * seed);
    }
}

/// c′ ← f′ c′ and c ← f′ c + f″ x′ c′, for the cotangents c′ of derivatives and c of values.
#[inline(always)]
fn deactivate([slopes, bends]: &[Vec<Double>; 2], [along, values]: &mut [Vec<Double>; 2]) {
    let kept = Double::flat(slopes).iter().zip(Double::flat(bends));
    let rows = Double::flat_mut(along).iter_mut().zip(Double::flat_mut(values));
    for ((slope, bend), (c_along, c)) in kept.zip(rows) {
        *c = slope * *c + bend * *c_along;
        *c_along *= slope;
    }
}

/// Adds s x i to y and its derivative to y′, with i = (mean x² + 10⁻¹⁰)^(−1/2).
#[inline(always)]
fn add_normalised(norm: Option<&InvariantNorm>, [x, x_along]: [&[f64]; 2], [y, y_along]: [&mut [f64]; 2]) {
    let Some(norm) = norm else {
        y.iter_mut().zip(x).for_each(|(y, x)| *y += x);
        y_along.iter_mut().zip(x_along).for_each(|(y, x)| *y += x);
        return;
    };
    if let Some(factor) = norm.linear {
        y[0] += factor * x[0];
        y_along[0] += factor * x_along[0];
    }
    let first = norm.first();
    let (i, i_along, _) = inverse_root(norm, x, x_along);
    for (k, scale) in norm.scale.iter().enumerate() {
        y[first + k] += scale * x[first + k] * i;
        y_along[first + k] += scale * (x_along[first + k] * i + x[first + k] * i_along);
    }
}

/// i, its derivative −i³ m and m = mean(x x′).
#[inline(always)]
fn inverse_root(norm: &InvariantNorm, x: &[f64], x_along: &[f64]) -> (f64, f64, f64) {
    let (first, n) = (norm.first(), norm.scale.len());
    let (mut square, mut mixed) = (0.0, 0.0);
    for (x, x_along) in x[first..first + n].iter().zip(&x_along[first..]) {
        square += x * x;
        mixed += x * x_along;
    }
    let n = n.max(1) as f64;
    let i = 1.0 / (square / n + SQUARE_FLOOR).sqrt();
    (i, -i * i * i * mixed / n, mixed / n)
}

/// Replaces the cotangents of y′ and y with those of x′ and x, and adds to that of s.
#[inline(always)]
fn norm_backward(
    norm: &InvariantNorm,
    [x, x_along]: [&[f64]; 2],
    [c_along, c]: [&mut [f64]; 2],
    of_scale: &mut [f64],
) {
    if let Some(factor) = norm.linear {
        c_along[0] *= factor;
        c[0] *= factor;
    }
    let (first, n) = (norm.first(), norm.scale.len() as f64);
    let (i, i_along, mixed) = inverse_root(norm, x, x_along);
    // Σ s c′ x, Σ s c′ x′ and Σ s c x.
    let (mut along_x, mut along_x_along, mut value_x) = (0.0, 0.0, 0.0);
    for (k, scale) in norm.scale.iter().enumerate() {
        let at = first + k;
        of_scale[k] += c[at] * x[at] * i + c_along[at] * (x_along[at] * i + x[at] * i_along);
        along_x += scale * c_along[at] * x[at];
        along_x_along += scale * c_along[at] * x_along[at];
        value_x += scale * c[at] * x[at];
    }
    let cube = -i * i * i / n;
    for (k, scale) in norm.scale.iter().enumerate() {
        let at = first + k;
        // ∂i/∂x and ∂i′/∂x
        let (of_i, of_i_along) = (cube * x[at], cube * (x_along[at] - 3.0 * i * i * mixed * x[at]));
        c[at] = scale * (i * c[at] + i_along * c_along[at])
            + of_i * (value_x + along_x_along)
            + of_i_along * along_x;
        c_along[at] = scale * i * c_along[at] + of_i * along_x;
    }
}

/// Adds each row times the matrix.
#[inline(always)]
pub(super) fn multiply(matrix: &Matrix<Double>, batch: &AtomBatch, from: &[Double], to: &mut [Double]) {
    let rows = |stride| StridedRows::of_atoms(batch.atoms, stride);
    let (x, y) = (rows(matrix.input_lanes()), rows(matrix.output_lanes()));
    matrix.multiply_add((from, to), x, y, batch.instructions);
}
