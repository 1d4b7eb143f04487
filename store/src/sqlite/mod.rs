//! A campaign in one SQLite file.

mod disk_space;
pub mod file;
mod file_identity;
pub mod open;

#[cfg(test)]
mod tests;
