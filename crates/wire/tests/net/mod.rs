//! The transport between hosts, over loopback.

mod breaks;
mod exchange;
mod link;
mod moves;
mod security;
mod test_server;
