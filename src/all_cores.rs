//! Work on many items that all cores of this host share.

use std::panic::resume_unwind;
use std::sync::{Mutex, PoisonError};
use std::thread::{self, available_parallelism};

/// The results of `work` for each item, in the order of the items. Each thread has a `state` of its own.
pub fn map<T: Send, S, R: Send>(
    items: impl ExactSizeIterator<Item = T> + Send,
    state: impl Fn() -> S + Sync,
    work: impl Fn(&mut S, T) -> R + Sync,
) -> Vec<R> {
    let threads = available_parallelism().map_or(1, |cores| cores.get()).min(items.len());
    let items = Mutex::new(items.enumerate());
    let next = || items.lock().unwrap_or_else(PoisonError::into_inner).next();
    let share = || {
        let (mut state, mut results) = (state(), Vec::new());
        while let Some((number, item)) = next() {
            results.push((number, work(&mut state, item)));
        }
        results
    };
    let mut results: Vec<_> = thread::scope(|scope| {
        let threads: Vec<_> = (0..threads).map(|_| scope.spawn(share)).collect();
        let results = threads.into_iter().flat_map(|t| t.join().unwrap_or_else(|panic| resume_unwind(panic)));
        results.collect()
    });
    results.sort_unstable_by_key(|(number, _)| *number);
    results.into_iter().map(|(_, result)| result).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn results_have_the_order_of_the_items() {
        let counted = |seen: &mut usize, item: usize| {
            *seen += 1;
            (item * item, *seen)
        };
        let results = map(0..1000, || 0, counted);
        assert!(results.iter().map(|(square, _)| *square).eq((0..1000).map(|item| item * item)));
        assert!(results.iter().all(|(_, seen)| *seen >= 1));
        assert!(map(0..0, || 0, counted).is_empty());
    }
}
