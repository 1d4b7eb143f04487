//! The transport between processes, with real ones.

mod desk;
mod exchange;
mod losses;
mod places;
mod process;
mod strangers;
