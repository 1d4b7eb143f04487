//! Tests of DFT codes that need none of them.

mod command;
mod vasp;
