//! Until the shared mixture is there.
use calm::Mixture;
use std::sync::Arc;

/// The writer.
pub trait Mixtures: Send {
    /// Makes it visible.
    fn publish(&mut self, mixture: &Arc<Mixture>) -> Result<(), String>;
    /// A reader is dead.
    fn release(&mut self, reader: u32);
}

/// A reader.
pub trait Pins: Send {
    /// That version.
    fn pin(&mut self, version: u64) -> Result<Arc<Mixture>, String>;
}
