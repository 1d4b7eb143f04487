//! Tests that need no DFT code.

mod command;
mod vasp;
