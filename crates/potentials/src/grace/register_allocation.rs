//! Allocates lanes on the tapes to the rows of a graph.
//!
//! Rows that are no longer needed release their lanes to later ones, so that the tapes of a batch stay in the
//! L1 and L2 caches.

use std::collections::{BTreeMap, BTreeSet};

use super::tape::{TapeOperation, Tensor};
use super::tape_program::{Gather, Gathered, Ranges, TapeProgram, TapeStep};
use super::vector::Vector;

/// The allocated lanes of the graph's rows.
#[derive(Clone, Debug, Default)]
struct Registers {
    of: BTreeMap<usize, usize>,
    /// Released lanes, by the width of the row.
    free: BTreeMap<usize, Vec<usize>>,
    end: usize,
}

impl Registers {
    /// Allocates a row; false if it already has lanes.
    fn take(&mut self, row: usize, width: usize) -> bool {
        if self.of.contains_key(&row) {
            return false;
        }
        let free = self.free.get_mut(&width).and_then(Vec::pop);
        self.of.insert(row, free.unwrap_or(self.end));
        self.end += if free.is_some() { 0 } else { width };
        true
    }

    /// Releases rows whose lanes are not before `first`.
    fn leave(&mut self, rows: impl IntoIterator<Item = usize>, first: usize, widths: &[usize]) {
        for row in rows {
            if self.of[&row] >= first {
                self.free.entry(widths[row]).or_default().push(self.of[&row]);
            }
        }
    }
}

/// Allocates all rows. `widths` gives the number of lanes of each row, indexed by its lane in the graph. The
/// tensors `whole` stay contiguous, among them `message`, which receives its lanes. `basis` lists the first
/// lanes and widths of the basis rows. In `training`, rows that are multiplied by weights are kept too.
pub(super) fn allocate<V: Vector>(
    operations: Vec<TapeOperation<V>>,
    widths: &[usize],
    whole: Vec<Tensor>,
    basis: &[(usize, usize)],
    message: Option<&mut Tensor>,
    training: bool,
) -> TapeProgram<V> {
    let given = given(&operations, basis);
    let fixed = fixed(&operations, whole, &given, widths);
    let (fixed_lanes, mut tape, mut cotangents) = (fixed.end, fixed.clone(), fixed);
    for row in operations.iter().flat_map(|operation| operation.factors(training)) {
        tape.take(row, widths[row]);
    }
    let kept_lanes = tape.end;
    along_tape(&operations, &mut tape, kept_lanes, widths);
    let fresh = along_cotangents(&operations, &mut cotangents, fixed_lanes, widths);

    let gather = |made_here: &dyn Fn(usize) -> bool| gather(basis, made_here, &tape, &cotangents);
    let step = |(mut operation, fresh): (TapeOperation<V>, Vec<usize>)| {
        let made = operation.writes();
        let is_sum = matches!(operation, TapeOperation::Linear(_));
        let sums = if is_sum { ranges(made.clone(), &tape, widths) } else { Ranges::default() };
        let lane = |places: &Registers, row: u32| places.of[&(row as usize)] as u32;
        operation.rename(|row| lane(&tape, row), |row| lane(&cotangents, row));
        let (fresh, basis) = (ranges(fresh, &cotangents, widths), gather(&|row| made.contains(&row)));
        TapeStep { operation, sums, fresh, basis }
    };
    if let Some(message) = message {
        message.start = tape.of[&message.start];
    }
    TapeProgram {
        steps: operations.into_iter().zip(fresh).map(step).collect(),
        given: gather(&|row| given.contains(&row)),
        fixed_lanes,
        kept_lanes,
        tape_lanes: tape.end,
        cotangent_lanes: cotangents.end,
        basis_lanes: basis.iter().map(|(_, width)| width).sum(),
    }
}

/// Allocates the contiguous rows at the start of both tapes, in graph order: those of the tensors `whole`, of
/// normalised tensors, and those that no operation produces.
fn fixed<V: Vector>(
    operations: &[TapeOperation<V>],
    mut whole: Vec<Tensor>,
    given: &BTreeSet<usize>,
    widths: &[usize],
) -> Registers {
    for operation in operations {
        if let TapeOperation::EquivariantNorm(norm) = operation {
            whole.extend([norm.from, norm.to]);
        }
    }
    whole.sort_by_key(|tensor| tensor.start);
    let mut places = Registers::default();
    for row in whole.iter().flat_map(Tensor::rows).chain(given.iter().copied()) {
        places.take(row, widths[row]);
    }
    places
}

/// Rows that are read or belong to the basis, but that no operation produces.
fn given<V: Vector>(operations: &[TapeOperation<V>], basis: &[(usize, usize)]) -> BTreeSet<usize> {
    let made: BTreeSet<usize> = operations.iter().flat_map(TapeOperation::writes).collect();
    let taken = operations.iter().flat_map(TapeOperation::reads).chain(basis.iter().map(|(row, _)| *row));
    taken.filter(|row| !made.contains(row)).collect()
}

/// Forward, a row that does not start before `kept` keeps its lanes until its last read.
fn along_tape<V: Vector>(
    operations: &[TapeOperation<V>],
    places: &mut Registers,
    kept: usize,
    widths: &[usize],
) {
    let uses = operations.iter().enumerate();
    let last: BTreeMap<usize, usize> =
        uses.flat_map(|(k, operation)| operation.reads().into_iter().map(move |row| (row, k))).collect();
    for (k, operation) in operations.iter().enumerate() {
        let made = operation.writes();
        for row in &made {
            places.take(*row, widths[*row]);
        }
        let done: BTreeSet<usize> = operation.reads().into_iter().chain(made).collect();
        let is_done = |row: &usize| last.get(row).is_none_or(|last| *last <= k);
        places.leave(done.into_iter().filter(is_done), kept, widths);
    }
}

/// In reverse, a cotangent has lanes from the first contribution to it until its row's own operation. Returns
/// the rows that each operation allocates.
fn along_cotangents<V: Vector>(
    operations: &[TapeOperation<V>],
    places: &mut Registers,
    fixed: usize,
    widths: &[usize],
) -> Vec<Vec<usize>> {
    let mut fresh = Vec::new();
    for operation in operations.iter().rev() {
        let made: BTreeSet<usize> = operation.writes().into_iter().collect();
        let touched: BTreeSet<usize> = operation.reads().into_iter().chain(made.iter().copied()).collect();
        fresh.push(touched.into_iter().filter(|row| places.take(*row, widths[*row])).collect());
        places.leave(made, fixed, widths);
    }
    fresh.reverse();
    fresh
}

fn ranges(rows: Vec<usize>, places: &Registers, widths: &[usize]) -> Ranges {
    Ranges::new(rows.into_iter().map(|row| (places.of[&row], widths[row])).collect())
}

/// The basis rows that are produced here.
fn gather(
    basis: &[(usize, usize)],
    made_here: &dyn Fn(usize) -> bool,
    tape: &Registers,
    cotangents: &Registers,
) -> Gather {
    let (mut position, mut rows) = (0, Vec::new());
    for (row, width) in basis {
        if made_here(*row) {
            let (tape, cotangent) = (tape.of[row], cotangents.of[row]);
            rows.push(Gathered { tape, cotangent, position, width: *width });
        }
        position += width;
    }
    Gather(rows)
}

#[cfg(test)]
mod tests {
    use super::super::instructions::Instructions;
    use super::super::product::{Combination, Coupled, Product, Term};
    use super::super::tape::AtomBatch;
    use super::super::vector::{Double, Vector};
    use super::*;

    /// to = factor · from
    fn multiple(to: u32, from: u32, factor: f64) -> TapeOperation<Double> {
        TapeOperation::Combination(Combination::new(1, 8, vec![(to, vec![(from, factor)])]))
    }

    fn square(to: usize, from: u32) -> TapeOperation<Double> {
        let terms = vec![Term { left: from, right: from, coefficient: 1.0 }];
        let outputs = vec![Coupled { row: to, terms }];
        let mut product = Product { width: 1, channels: 8, outputs, inputs: Vec::new() };
        product.keep(&mut [true; 5]);
        TapeOperation::Product(product)
    }

    /// x → 2x → 6x → 36x² → −36x²
    fn chain() -> TapeProgram<Double> {
        let operations = vec![multiple(1, 0, 2.0), multiple(2, 1, 3.0), square(3, 2), multiple(4, 3, -1.0)];
        let density = Tensor { start: 0, components: 1, channels: 8, width: 1 };
        allocate(operations, &[1; 5], vec![density], &[(4, 1)], None, false)
    }

    #[test]
    fn rows_leave_their_places_to_later_ones_unless_the_reverse_sweep_reads_them() {
        let steps = chain();
        // x is fixed, 6x is kept, and 36x² reuses the lanes of 2x.
        assert_eq!((steps.fixed_lanes, steps.kept_lanes, steps.tape_lanes), (1, 2, 4));
        assert_eq!(steps.cotangent_lanes, 3);
    }

    #[test]
    fn nothing_that_stood_there_before_is_seen() {
        let steps = chain();
        let batch = AtomBatch { element: 0, atoms: 2, instructions: Instructions::best() };
        let mut tape = vec![Double::splat(f64::NAN); 2 * steps.tape_lanes];
        let mut cotangent = vec![Double::splat(f64::NAN); 4 * steps.cotangent_lanes];
        tape[..2].copy_from_slice(&[Double::splat(0.5), Double::splat(-1.0)]);
        cotangent[..4].fill(Double::ZERO);
        let mut basis = [Double::ZERO; 2];
        steps.forward(&batch, &mut tape, &mut basis);
        assert_eq!(basis, [Double::splat(-9.0), Double::splat(-36.0)]);
        let bases = [&[Double::splat(1.0); 2][..], &[Double::splat(0.0), Double::splat(10.0)]];
        steps.backward::<2>(&batch, &tape[..2 * steps.kept_lanes], &mut cotangent, bases);
        let expected = [-36.0, 72.0, 0.0, 720.0].map(Double::splat);
        assert_eq!(cotangent[..4], expected);
    }
}
