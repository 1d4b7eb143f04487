//! Identifiers, messages and the transport between actors.
