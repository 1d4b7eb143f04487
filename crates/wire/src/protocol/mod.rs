//! What walkers and whoever decides say to each other, whatever carries it: how bytes become messages, and how far a
//! entry has come. No port, no clock.

pub(crate) mod frame;
pub(crate) mod message;
pub(crate) mod rejected;
pub(crate) mod sequence;
