//! The protocol between walkers and server, independent of the transport: message encoding, sequence tracking and the
//! server's end of the conversation. Uses no ports and no clock.

pub mod datagram;
pub(crate) mod frame;
pub(crate) mod message;
pub(crate) mod rejected;
pub(crate) mod sequence;
pub(crate) mod server_session;
