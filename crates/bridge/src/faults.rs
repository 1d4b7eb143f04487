//! What can go wrong with a server.

use serde::Deserialize;

/// A fault of a server or of a call.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) enum ServerFault {
    /// The process has exited, or cannot be reached.
    Exited(String),
    /// It has not answered in time.
    Timeout(String),
    /// What it says makes no sense.
    Nonsense(String),
    /// The device has too little memory for the batch.
    Memory(String),
    /// Shared memory of this host has too little room for the batch.
    Arena(String),
    /// The adapter reports an error of a call. The server goes on.
    Reported(String),
    /// The device was asked to stop.
    Stopped,
}

impl ServerFault {
    /// In words.
    pub fn message(&self) -> &str {
        match self {
            Self::Exited(message)
            | Self::Timeout(message)
            | Self::Nonsense(message)
            | Self::Memory(message)
            | Self::Arena(message)
            | Self::Reported(message) => message,
            Self::Stopped => "the device was asked to stop",
        }
    }
}

/// An answer of the server.
#[derive(Clone, Debug, Deserialize)]
pub(crate) struct ServerReply {
    pub status: String,
    #[serde(default)]
    pub id: Option<u64>,
    #[serde(default)]
    pub kind: Option<String>,
    #[serde(default)]
    pub message: Option<String>,
    #[serde(default)]
    pub traceback: Option<String>,
    #[serde(default)]
    pub compiled: bool,
    #[serde(default)]
    pub seconds: f64,
}

impl ServerReply {
    /// Reads a line that answers the call `id`.
    ///
    /// # Errors
    /// A line that does not, or an error that it reports.
    pub fn read(line: &str, id: Option<u64>, names: &str) -> Result<Self, ServerFault> {
        let excerpt = || line.chars().take(200).collect::<String>();
        let reply: Self = serde_json::from_str(line).map_err(|error| {
            ServerFault::Nonsense(format!("{names}: the answer '{}': {error}", excerpt()))
        })?;
        if reply.status == "error" {
            let message = reply.message.unwrap_or_else(|| "an error without a message".to_owned());
            // It begins with the adapter's name, as `names` does.
            let message = match message.strip_prefix("adapter ").and_then(|rest| rest.split_once(", ")) {
                Some((_, rest)) => rest.to_owned(),
                None => message,
            };
            let message = match reply.traceback.filter(|text| !text.is_empty()) {
                Some(traceback) => format!("{names}, {message}\n{}", traceback.trim_end()),
                None => format!("{names}, {message}"),
            };
            return Err(match reply.kind.as_deref() {
                Some("memory") => ServerFault::Memory(message),
                _ => ServerFault::Reported(message),
            });
        }
        if reply.status != "ok" || reply.id != id {
            let expected = id.map_or_else(String::new, |id| format!(" to call {id}"));
            return Err(ServerFault::Nonsense(format!("{names}: '{}' is no answer{expected}", excerpt())));
        }
        Ok(reply)
    }
}
