//! `calmwalk agent`

use std::net::SocketAddr;
use std::path::PathBuf;
use std::time::Duration;

use orchestrator::launcher::raise_descriptor_limit;
use store::ProcessRecord;
use wire::net::{self, Address, Tls};

use super::{Ended, Failure, block_on};
use crate::actors::scratch::{self, Scratch};
use crate::actors::{agent, cores};
use crate::log::Options;
use crate::output::warn;
use crate::web::{self, agent::Watched};

/// Let this host take part in a campaign that `calmwalk run --listen` leads on another
///
/// Starts walkers here, holds one copy of the mixture for all of them, and carries what they find to the orchestrator. It
/// waits for an orchestrator that is not there yet, and goes on through breaks of the line. Ends when the campaign has no
/// more work (exit code 0), or on Ctrl-C or SIGTERM after its walks are checkpointed (130): a batch system's notice
/// before the end of a job is enough.
#[derive(Debug, clap::Args)]
pub struct Agent {
    /// Where the orchestrator listens, as tcp/head:7447; or @FILE, where FILE is that of its --announce and is looked at
    /// again whenever it does not answer
    #[arg(long, value_name = "ENDPOINT")]
    join: Address,
    /// Walkers to start here [default: as many as the cores allow]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=4096))]
    walkers: Option<u32>,
    /// Threads of each
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = clap::value_parser!(u32).range(1..=256))]
    threads: u32,
    /// Turns to take beyond one a walker: so many candidates may wait for their verdict before walkers have to. Only of
    /// use where a campaign has more walks than walkers
    #[arg(long, value_name = "N", default_value_t = 0, value_parser = clap::value_parser!(u32).range(0..=4096))]
    ahead: u32,
    /// Give up when there was no orchestrator, or no answer of it, for so long, min
    #[arg(long, value_name = "MINUTES", default_value_t = 60.0, value_parser = minutes)]
    patience: f64,
    /// Directory with authority.pem, certificate.pem and key.pem: needed for everything but loopback
    #[arg(long, value_name = "DIR")]
    tls: Option<PathBuf>,
    /// Serve metrics of this agent for Prometheus at this address of this host, as 127.0.0.1:9465 (docs/metrics.md)
    #[arg(long, value_name = "ADDRESS:PORT", value_parser = web::address)]
    metrics: Option<SocketAddr>,
    #[command(flatten)]
    log: Options,
}

impl Agent {
    pub fn run(self) -> Result<Ended, Failure> {
        self.log.begin("agent")?;
        let walkers = self.walkers.unwrap_or_else(|| (cores() / self.threads).max(1));
        let patience = Duration::from_secs_f64(60.0 * self.patience);
        let tls = self.tls.as_deref().map(Tls::from_directory);
        if let Some(tls) = &tls {
            let checked = tls.check_for_agent().map_err(Failure::input)?;
            checked.warnings.iter().for_each(|warning| warn(format_args!("WARNING: {warning}")));
        }
        raise_descriptor_limit();
        scratch::clean();
        let scratch = Scratch::new().map_err(|error| {
            Failure::Failed(format!("cannot make a directory in {}: {error}", std::env::temp_dir().display()))
        })?;
        let process =
            ProcessRecord::new(ProcessRecord::AGENT, None, std::process::id(), store::unix_milliseconds());
        let agent = net::Agent {
            // A host that was cloned has the same name, process numbers and clock.
            id: blake3::hash(format!("{process:?} {}", scratch.path().display()).as_bytes()).to_hex()[..32]
                .to_owned(),
            host: process.host,
            pid: process.pid,
            program_version: env!("CARGO_PKG_VERSION").to_owned(),
            walkers,
            prefetch: self.ahead,
        };
        let watched = Watched::default();
        block_on(async {
            if let Some(address) = self.metrics {
                web::serve_metrics(web::listen(address).await?, web::agent::router(watched.clone()))?;
            }
            let (tls, threads) = (tls.as_ref(), self.threads as usize);
            agent::work(&self.join, tls, agent, threads, patience, scratch.path(), &watched).await
        })?
    }
}

fn minutes(text: &str) -> Result<f64, String> {
    let minutes = text.parse().ok().filter(|minutes| (0.1..=1e6).contains(minutes));
    minutes.ok_or_else(|| "expected 0.1 to 1e6".to_owned())
}
