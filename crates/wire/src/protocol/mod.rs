//! The protocol between walkers and server, independent of the transport: message encoding and sequence tracking. Uses
//! no ports and no clock.

pub(crate) mod frame;
pub(crate) mod message;
pub(crate) mod rejected;
pub(crate) mod sequence;
