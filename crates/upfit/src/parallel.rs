//! Work on a list, over threads.

use std::sync::{Mutex, PoisonError};
use std::thread::Builder;

/// Calls `work` once for each item, on up to `threads` threads, fewer if the system has no more. Each thread has a state of its
/// own, which it makes itself.
pub fn for_each<T: Send, S>(
    items: &mut [T],
    threads: usize,
    make_state: impl Fn() -> S + Sync,
    work: impl Fn(&mut S, &mut T) + Sync,
) {
    let threads = threads.min(items.len());
    let remaining = Mutex::new(items.iter_mut());
    let run = || {
        let mut state = make_state();
        loop {
            let next = remaining.lock().unwrap_or_else(PoisonError::into_inner).next();
            let Some(item) = next else { break };
            work(&mut state, item);
        }
    };
    std::thread::scope(|scope| {
        for _ in 1..threads {
            if Builder::new().spawn_scoped(scope, run).is_err() {
                break;
            }
        }
        run();
    });
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_item_is_visited_once() {
        for threads in [1, 2, 7, 200] {
            let mut items = vec![0; 100];
            for_each(
                &mut items,
                threads,
                || 0,
                |visits, item| {
                    *visits += 1;
                    *item += 1;
                },
            );
            assert!(items.iter().all(|item| *item == 1));
        }
        for_each(&mut [0_u8; 0], 3, || (), |(), _| unreachable!("there are no items"));
    }
}
