//! What walkers and whoever decides say to each other, whatever carries it: how bytes become messages, and how far a
//! conversation has come. No port, no clock.

pub(crate) mod conversation;
pub(crate) mod dropped;
pub(crate) mod frame;
pub(crate) mod message;
