//! Why a process exited.

use std::fmt;
use std::time::Duration;

/// Exit code of a program that panicked.
const PANIC: i32 = 101;

/// Why a process exited. `status` shows it as text.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum ExitReason {
    /// It exited with a code.
    Exit {
        /// 0 if it finished its work; 130 or 143 if it was interrupted and exited normally.
        code: i32,
        /// Last line of its standard error.
        last_line: Option<String>,
    },
    /// It was killed by a signal.
    Signal {
        /// Number of the signal.
        signal: i32,
        /// Last line of its standard error.
        last_line: Option<String>,
    },
    /// It sent no heartbeat for this time and was killed.
    Unresponsive(Duration),
    /// It did not exit within this time after it was asked to, and was killed.
    StopTimeout(Duration),
    /// It could not be started.
    StartFailed {
        /// The error.
        reason: String,
        /// Whether the host lacked file descriptors, processes or memory. The failure then says nothing about the
        /// child, and a later start may succeed.
        is_shortage: bool,
    },
    /// Unknown, because an adopted process is not a child of this process.
    Unknown,
}

impl ExitReason {
    /// Whether it finished its work.
    pub fn is_success(&self) -> bool {
        matches!(self, Self::Exit { code: 0, .. })
    }

    /// Whether it could not be started because of a shortage of resources on the host.
    pub(super) fn is_shortage(&self) -> bool {
        matches!(self, Self::StartFailed { is_shortage: true, .. })
    }

    /// Whether the process crashed, so that another process with the same work may crash as well. Otherwise the cause
    /// was external (SIGKILL by the kernel when out of memory, SIGTERM by a user, a host too busy for heartbeats), or
    /// the process itself reported why it exited.
    pub fn is_crash(&self) -> bool {
        match self {
            Self::Exit { code, .. } => *code == PANIC,
            Self::Signal { signal, .. } => {
                matches!(signal_name(*signal), "SIGSEGV" | "SIGABRT" | "SIGBUS" | "SIGILL" | "SIGFPE")
            }
            Self::Unresponsive(_) | Self::StopTimeout(_) | Self::StartFailed { .. } | Self::Unknown => false,
        }
    }

    /// Whether it is known what the process cannot go on without: it said so, or the system did when it was started.
    pub fn is_reported(&self) -> bool {
        match self {
            Self::StartFailed { .. } => true,
            Self::Exit { .. } => !self.is_crash(),
            Self::Signal { .. } | Self::Unresponsive(_) | Self::StopTimeout(_) | Self::Unknown => false,
        }
    }

    /// Whether this is the expected result of SIGTERM.
    pub(super) fn is_expected_after_stop(&self) -> bool {
        match self {
            Self::Exit { code, .. } => is_interrupted(*code),
            Self::Signal { signal, .. } => signal_name(*signal) == "SIGTERM",
            // Nothing else can be known about a process that is not our child.
            other => matches!(other, Self::Unknown),
        }
    }
}

impl fmt::Display for ExitReason {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Exit { code, last_line: Some(line) } => write!(f, "exit code {code}: {line}"),
            Self::Exit { code, last_line: None } => write!(f, "exit code {code}"),
            Self::Signal { signal, last_line } => {
                write!(f, "killed by signal {signal}")?;
                match signal_name(*signal) {
                    "" => {}
                    name => write!(f, " ({name})")?,
                }
                match last_line {
                    // If the cause is external, the last line is unrelated.
                    Some(line) if self.is_crash() => write!(f, ": {line}"),
                    _ => Ok(()),
                }
            }
            Self::Unresponsive(silence) => write!(f, "silent for {} s, killed", silence.as_secs_f64()),
            Self::StopTimeout(grace) => {
                write!(f, "killed: still running {} s after SIGTERM", grace.as_secs_f64())
            }
            Self::StartFailed { reason, .. } => write!(f, "could not be started: {reason}"),
            Self::Unknown => f.write_str("ended, it is not known how"),
        }
    }
}

/// Whether the exit code says that the process handled SIGINT or SIGTERM: 128 plus the signal number, as in shells.
fn is_interrupted(code: i32) -> bool {
    matches!(code, 130 | 143)
}

/// Name of a signal, or empty.
fn signal_name(signal: i32) -> &'static str {
    match signal {
        1 => "SIGHUP",
        2 => "SIGINT",
        3 => "SIGQUIT",
        4 => "SIGILL",
        5 => "SIGTRAP",
        6 => "SIGABRT",
        7 => "SIGBUS",
        8 => "SIGFPE",
        9 => "SIGKILL",
        11 => "SIGSEGV",
        13 => "SIGPIPE",
        14 => "SIGALRM",
        15 => "SIGTERM",
        24 => "SIGXCPU",
        25 => "SIGXFSZ",
        31 => "SIGSYS",
        _ => "",
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn signal(signal: i32) -> ExitReason {
        ExitReason::Signal { signal, last_line: Some("last words".to_owned()) }
    }

    #[test]
    fn crashes_and_external_causes_are_distinguished() {
        use rustix::process::Signal;
        for own in [Signal::SEGV, Signal::ABORT, Signal::BUS, Signal::ILL, Signal::FPE] {
            assert!(signal(own.as_raw()).is_crash(), "{own:?}");
        }
        for outside in [Signal::KILL, Signal::TERM, Signal::INT, Signal::HUP, Signal::XCPU] {
            assert!(!signal(outside.as_raw()).is_crash(), "{outside:?}");
        }
        assert!(ExitReason::Exit { code: PANIC, last_line: None }.is_crash());
        for not_own in [0, 1, 2, 130, 143] {
            assert!(!ExitReason::Exit { code: not_own, last_line: None }.is_crash(), "{not_own}");
        }
        assert!(!ExitReason::Unresponsive(Duration::from_secs(1)).is_crash());
        let not_started = ExitReason::StartFailed { reason: "no memory".to_owned(), is_shortage: true };
        assert!(!not_started.is_crash() && !ExitReason::Unknown.is_crash());
        let exit = |code| ExitReason::Exit { code, last_line: None };
        assert!(not_started.is_reported() && exit(1).is_reported());
        assert!(!exit(PANIC).is_reported() && !signal(9).is_reported() && !ExitReason::Unknown.is_reported());
    }

    #[test]
    fn signals_have_the_names_of_the_system() {
        let names = [
            (libc::SIGHUP, "SIGHUP"),
            (libc::SIGINT, "SIGINT"),
            (libc::SIGQUIT, "SIGQUIT"),
            (libc::SIGILL, "SIGILL"),
            (libc::SIGTRAP, "SIGTRAP"),
            (libc::SIGABRT, "SIGABRT"),
            (libc::SIGBUS, "SIGBUS"),
            (libc::SIGFPE, "SIGFPE"),
            (libc::SIGKILL, "SIGKILL"),
            (libc::SIGSEGV, "SIGSEGV"),
            (libc::SIGPIPE, "SIGPIPE"),
            (libc::SIGALRM, "SIGALRM"),
            (libc::SIGTERM, "SIGTERM"),
            (libc::SIGXCPU, "SIGXCPU"),
            (libc::SIGXFSZ, "SIGXFSZ"),
            (libc::SIGSYS, "SIGSYS"),
        ];
        for (signal, name) in names {
            assert_eq!(signal_name(signal), name);
        }
        assert_eq!(signal_name(libc::SIGUSR1), "");
    }

    #[test]
    fn exit_reasons_are_displayed() {
        let exit = |last_line: Option<&str>| {
            ExitReason::Exit { code: 2, last_line: last_line.map(str::to_owned) }.to_string()
        };
        assert_eq!(exit(Some("no model")), "exit code 2: no model");
        assert_eq!(exit(None), "exit code 2");
        assert_eq!(signal(9).to_string(), "killed by signal 9 (SIGKILL)");
        assert_eq!(signal(11).to_string(), "killed by signal 11 (SIGSEGV): last words");
        assert_eq!(signal(35).to_string(), "killed by signal 35");
        assert_eq!(
            ExitReason::Unresponsive(Duration::from_secs(120)).to_string(),
            "silent for 120 s, killed"
        );
    }
}
