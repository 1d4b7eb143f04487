//! The selector and what feeds it.
