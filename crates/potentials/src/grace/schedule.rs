//! The execution order of operations.
//!
//! Operations are divided into pieces that share no rows where possible. A piece runs right before the piece
//! that needs it, so that its results are still in the cache, also in the reverse pass.

use std::collections::BTreeMap;

use super::linear::Linear;
use super::product::Term;
use super::tape::TapeOperation;
use super::vector::Vector;

/// The operations in pieces, depth first from those whose results no other piece reads.
pub(super) fn depth_first<V: Vector>(operations: Vec<TapeOperation<V>>) -> Vec<TapeOperation<V>> {
    let pieces: Vec<TapeOperation<V>> = operations.into_iter().flat_map(divided).collect();
    let needs = needs(&pieces);
    let mut taken = vec![false; pieces.len()];
    needs.iter().flatten().for_each(|k| taken[*k] = true);
    let (mut order, mut visited) = (Vec::new(), vec![false; pieces.len()]);
    for last in (0..pieces.len()).filter(|k| !taken[*k]) {
        visit(last, &needs, &mut visited, &mut order);
    }
    let mut pieces: Vec<Option<TapeOperation<V>>> = pieces.into_iter().map(Some).collect();
    order.into_iter().filter_map(|k| pieces[k].take()).collect()
}

/// For each piece, the pieces whose rows it reads.
fn needs<V: Vector>(pieces: &[TapeOperation<V>]) -> Vec<Vec<usize>> {
    let writes =
        pieces.iter().enumerate().flat_map(|(k, piece)| piece.writes().into_iter().map(move |row| (row, k)));
    let makers: BTreeMap<usize, usize> = writes.collect();
    let needs = |piece: &TapeOperation<V>| {
        let mut needs: Vec<usize> = piece.reads().iter().filter_map(|row| makers.get(row).copied()).collect();
        needs.dedup();
        needs
    };
    pieces.iter().map(needs).collect()
}

fn visit(k: usize, needs: &[Vec<usize>], visited: &mut [bool], order: &mut Vec<usize>) {
    if std::mem::replace(&mut visited[k], true) {
        return;
    }
    needs[k].iter().for_each(|needed| visit(*needed, needs, visited, order));
    order.push(k);
}

/// The parts of a linear map that add to different rows, and groups of a product's results that share no
/// factor.
fn divided<V: Vector>(operation: TapeOperation<V>) -> Vec<TapeOperation<V>> {
    match operation {
        TapeOperation::Linear(Linear { parts }) => {
            let groups = connected(parts, |part| part.tape[1].clone());
            groups.into_iter().map(|parts| TapeOperation::Linear(Linear { parts })).collect()
        }
        TapeOperation::Product(product) => {
            let rows = |terms: &[Term<V>]| terms.iter().flat_map(|t| [t.left, t.right]).collect();
            let groups = connected(product.outputs.clone(), |output| rows(&output.terms));
            groups.into_iter().map(|outputs| TapeOperation::Product(product.with_outputs(outputs))).collect()
        }
        whole => vec![whole],
    }
}

/// Groups of items connected by common rows, ordered by their first rows.
fn connected<T>(items: Vec<T>, rows: impl Fn(&T) -> Vec<u32>) -> Vec<Vec<T>> {
    let mut groups: Vec<(Vec<u32>, Vec<T>)> = Vec::new();
    for item in items {
        let (mut rows, mut together) = (rows(&item), Vec::new());
        let (joined, apart): (Vec<_>, Vec<_>) =
            groups.into_iter().partition(|(others, _)| others.iter().any(|row| rows.contains(row)));
        for (others, items) in joined {
            rows.extend(others);
            together.extend(items);
        }
        together.push(item);
        rows.sort_unstable();
        rows.dedup();
        groups = apart;
        groups.push((rows, together));
    }
    groups.sort_by_key(|(rows, _)| rows[0]);
    groups.into_iter().map(|(_, items)| items).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_has_rows_in_common_stays_together() {
        let items = vec![vec![1, 2], vec![5], vec![3], vec![2, 3], vec![7, 5]];
        let groups = connected(items, Vec::clone);
        assert_eq!(groups, [vec![vec![1, 2], vec![3], vec![2, 3]], vec![vec![5], vec![7, 5]]]);
    }
}
