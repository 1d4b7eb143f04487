//! Tests of arrays in files.

mod common;

mod arrays;
mod hostile;
mod written;
