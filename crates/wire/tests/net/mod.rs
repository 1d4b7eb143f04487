//! The transport between hosts, over loopback.

mod breaks;
mod exchange;
mod head;
mod link;
mod moves;
mod security;
