//! The question of long work whether to stop.

/// Asks whether to stop; once it says so, it goes on to say so.
pub type StopRequest<'a> = &'a (dyn Fn() -> bool + Sync);
