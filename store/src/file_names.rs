//! Names of files in the directory of a campaign.

/// The database.
pub const DATABASE: &str = "campaign.sqlite";

/// The lock file.
pub const LOCK: &str = "campaign.lock";
