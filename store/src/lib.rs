//! The database of a campaign.
