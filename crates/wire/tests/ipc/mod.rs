//! The transport between real processes.

mod calls;
mod exchange;
mod losses;
mod process;
mod rejected;
mod shm_dirs;
mod test_server;
