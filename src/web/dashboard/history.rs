//! The history of the campaign.

use axum::extract::State;
use monitor::history::CampaignHistory;
use store::unix_milliseconds;

use super::Dashboard;
use super::response::{self, ApiResult};

/// `GET /api/history`: samples since the beginning of the campaign, and its limits.
pub async fn history(State(dashboard): State<Dashboard>) -> ApiResult {
    response::json(&CampaignHistory::read(&dashboard.store, unix_milliseconds()).await?)
}
