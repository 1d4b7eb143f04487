//! The transport between real processes.

mod exchange;
mod losses;
mod process;
mod rejected;
mod shm_dirs;
mod test_server;
