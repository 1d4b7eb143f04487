//! `calmwalk agent`

use std::net::SocketAddr;
use std::path::PathBuf;

use orchestrator::launcher::raise_descriptor_limit;
use store::ProcessRecord;
use wire::net::{self, Address, Tls};

use super::{CommandError, ExitStatus, block_on, duration_between};
use crate::duration::Duration;
use crate::log::LogArgs;
use crate::output::log_and_warn;
use crate::runtime::agent_model::HostPython;
use crate::runtime::scratch_dir::{self, ScratchDir};
use crate::runtime::{agent_host, cores};
use crate::web::{self, agent_metrics::AgentState};

/// Run walkers on this host for a campaign led by `calmwalk run --listen` on another host
///
/// Starts walkers that share one copy of the mixture, and sends the candidates they find to the orchestrator. Waits for an orchestrator
/// that has not started yet, and keeps working through connection losses. Exits when the campaign has no more work (exit code 0), or
/// on Ctrl-C or SIGTERM (exit code 130). Checkpoints its walks within seconds of SIGTERM, so the notice of a batch system suffices.
/// See docs/hosts.md.
#[derive(Debug, clap::Args)]
pub struct AgentArgs {
    /// Address of the orchestrator, such as tcp/head:7447, or @FILE of `calmwalk run --announce`. The agent reads FILE again when the
    /// orchestrator stops answering
    #[arg(long, value_name = "ENDPOINT")]
    join: Address,
    /// Number of walkers on this host [default: number of cores divided by --threads]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=4096))]
    walkers: Option<u32>,
    /// Number of threads per walker
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = clap::value_parser!(u32).range(1..=256))]
    threads: u32,
    /// Number of assignments to fetch in addition to one per walker, so that walkers keep working while candidates await a
    /// decision. Useful only in campaigns with more walks than walkers
    #[arg(long, value_name = "N", default_value_t = 0, value_parser = clap::value_parser!(u32).range(0..=4096))]
    prefetch: u32,
    /// Exit with an error after waiting this long for an orchestrator, or for an answer from it, such as 10m
    #[arg(long, value_name = "TIME", default_value_t = Duration::from_seconds(3600), value_parser = duration_between("6s", "10000h"))]
    wait_timeout: Duration,
    /// Directory with authority.pem, certificate.pem and key.pem; required unless the endpoint is a loopback address
    #[arg(long, value_name = "DIR")]
    tls: Option<PathBuf>,
    /// Python environment on this host [default: potential.python.environment of the configuration]
    #[arg(long, value_name = "DIR")]
    python_environment: Option<PathBuf>,
    /// Words before the Python program on this host, such as those of a container; repeat for each word. --python-environment is then
    /// the program inside [default: potential.python.launcher of the configuration]
    #[arg(long = "python-launcher", value_name = "WORD", allow_hyphen_values = true)]
    python_launcher: Vec<String>,
    /// Directory in which frameworks keep compiled programs on this host [default: potential.python.cache of the configuration]
    #[arg(long, value_name = "DIR")]
    python_cache: Option<PathBuf>,
    /// Device of this host that evaluates a model in Python, such as cuda:1; may be repeated [default: potential.python.device of the
    /// configuration]
    #[arg(long = "device", value_name = "NAME")]
    devices: Vec<String>,
    /// Serve this agent's metrics to Prometheus at this address, such as 127.0.0.1:9465 (docs/metrics.md)
    #[arg(long, value_name = "ADDRESS:PORT", value_parser = web::address)]
    metrics: Option<SocketAddr>,
    #[command(flatten)]
    log: LogArgs,
}

impl AgentArgs {
    pub fn run(self) -> Result<ExitStatus, CommandError> {
        self.log.init("agent")?;
        let walkers = self.walkers.unwrap_or_else(|| (cores() / self.threads).max(1));
        let tls = self.tls.as_deref().map(Tls::from_directory);
        if let Some(tls) = &tls {
            let checked = tls.check_for_agent().map_err(CommandError::input)?;
            checked.warnings.iter().for_each(|warning| log_and_warn(format_args!("WARNING: {warning}")));
        }
        raise_descriptor_limit();
        scratch_dir::clean();
        let scratch = ScratchDir::new().map_err(|error| {
            CommandError::Failed(format!(
                "cannot create a directory in {}: {error}",
                std::env::temp_dir().display()
            ))
        })?;
        let process =
            ProcessRecord::new(ProcessRecord::AGENT, None, std::process::id(), store::unix_milliseconds());
        let agent = net::AgentInfo {
            // The directory tells cloned hosts apart, which have the same name, process ids and clock.
            id: blake3::hash(format!("{process:?} {}", scratch.path().display()).as_bytes()).to_hex()[..32]
                .to_owned(),
            host: process.host,
            pid: process.pid,
            program_version: env!("CARGO_PKG_VERSION").to_owned(),
            walkers,
            prefetch: self.prefetch,
        };
        let python = HostPython {
            environment: self.python_environment,
            launcher: self.python_launcher,
            cache: self.python_cache,
            devices: self.devices,
        };
        let watched = AgentState::default();
        block_on(async {
            if let Some(address) = self.metrics {
                web::serve_metrics(web::listen(address).await?, web::agent_metrics::router(watched.clone()))?;
            }
            let settings = agent_host::AgentSettings {
                address: &self.join,
                tls: tls.as_ref(),
                agent,
                threads: self.threads as usize,
                timeout: self.wait_timeout.get(),
                directory: scratch.path(),
                python,
            };
            agent_host::run(&settings, &watched).await
        })?
    }
}
