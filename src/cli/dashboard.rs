//! `calmwalk dashboard`

use std::net::SocketAddr;

use store::Store;

use super::{CampaignArgs, CommandError, ExitStatus, block_on};
use crate::log::LogArgs;
use crate::output::log_and_print;
use crate::web::{self, dashboard};

/// Serve a read-only dashboard of a campaign to a web browser
///
/// For a campaign that runs elsewhere, has ended or is a backup; use `calmwalk run --dashboard` for the campaign that it runs.
/// Stop with Ctrl-C. docs/dashboard.md describes the pages.
#[derive(Debug, clap::Args)]
pub struct DashboardArgs {
    #[command(flatten)]
    location: CampaignArgs,
    /// Address and port to listen on; port 0 selects a free port
    #[arg(long, value_name = "ADDRESS:PORT", default_value = "127.0.0.1:8080", value_parser = web::address)]
    address: SocketAddr,
    #[command(flatten)]
    log: LogArgs,
}

impl DashboardArgs {
    pub fn run(self) -> Result<ExitStatus, CommandError> {
        self.log.init("dashboard")?;
        block_on(async {
            let listener = web::listen(self.address).await?;
            let store = Store::open_read_only(&self.location.get()?).await?;
            let address = listener.local_addr().map_err(CommandError::failed)?;
            let serving =
                web::HttpServer::start(listener, dashboard::Dashboard::new(store, None, None).router());
            log_and_print(format_args!("dashboard at http://{address}/"));
            tokio::signal::ctrl_c().await.map_err(CommandError::failed)?;
            serving.end();
            Ok(ExitStatus::Done)
        })?
    }
}
