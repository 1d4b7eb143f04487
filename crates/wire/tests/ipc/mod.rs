//! The transport between processes, with real ones.

mod exchange;
mod losses;
mod process;
mod rejected;
mod shm_dirs;
mod test_server;
