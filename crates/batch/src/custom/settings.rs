//! `[launch.custom]`

use std::collections::BTreeSet;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::request::JobRequest;
use super::template::{self, TemplateFault};

/// A batch system: the shell commands that submit a job, ask for its state and cancel it, and the script of a job.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct CustomScheduler {
    /// Name of the batch system in messages.
    pub name: String,
    /// Shell command that submits a job. `{script}` is the file of the job's script, which the command also gets on its standard
    /// input; `{start_after}` is the text of that key, or nothing for a job that waits for no other.
    pub submit: String,
    /// Text that precedes the id of the job in the output of `submit`. Default: the id comes first.
    #[serde(default)]
    pub id_after: String,
    /// Option with which a job starts only after the job `{id}` has started. Default: jobs wait for no other.
    #[serde(default)]
    pub start_after: String,
    /// Texts in the output of `submit` that say that the batch system accepts no further job for now.
    #[serde(default)]
    pub queue_full: Vec<String>,
    /// Shell command that prints the state of the job `{id}`.
    pub poll: String,
    /// Text that precedes the word for the state in the output of `poll`. Default: the word comes first.
    #[serde(default)]
    pub state_after: String,
    /// Words for the states of a job. A job with any other word counts as running.
    pub states: StateWords,
    /// Texts in the output of `poll` and `cancel` that say that there is no such job. Such a job is over.
    pub vanished: Vec<String>,
    /// Shell command that cancels the job `{id}`.
    pub cancel: String,
    /// Script of a job, with placeholders.
    pub script: String,
    /// Texts in the output of a job that say why the batch system ended it.
    #[serde(default)]
    pub log: LogTexts,
}

/// The words of a batch system for the states of a job.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct StateWords {
    /// It waits.
    pub pending: Vec<String>,
    /// It has a node.
    pub running: Vec<String>,
    /// It has ended, well or, where the batch system does not say, in any way.
    pub completed: Vec<String>,
    /// It has ended with an error.
    #[serde(default)]
    pub failed: Vec<String>,
    /// It was cancelled.
    #[serde(default)]
    pub cancelled: Vec<String>,
}

/// Texts that a batch system writes into the output of a job that it ends.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct LogTexts {
    /// Its time limit was reached.
    pub time_limit: Vec<String>,
    /// It used more memory than it had asked for.
    pub out_of_memory: Vec<String>,
}

impl CustomScheduler {
    /// The first value that makes no sense: its key below `launch.custom`, what was found and what was expected.
    pub fn invalid_setting(&self) -> Option<(&'static str, String, String)> {
        let expected = |text: &str| text.to_owned();
        if self.name.trim().is_empty() {
            return Some((
                "name",
                expected("no name"),
                expected("the name of the batch system, such as \"PBS\""),
            ));
        }
        let start_after = (!self.start_after.is_empty()).then_some(("start_after", &self.start_after));
        let with_id = [("poll", &self.poll), ("cancel", &self.cancel)].into_iter().chain(start_after);
        for (key, command) in with_id {
            if !command.contains("{id}") {
                return Some((key, format!("{command:?}"), expected("a text with {id}, the id of the job")));
            }
            if let Err(fault) = self.with_id(command, "1") {
                return Some((key, fault.place(command), fault.expected()));
            }
        }
        if self.submit.trim().is_empty() {
            return Some(("submit", expected("no command"), expected("a command such as \"qsub {script}\"")));
        }
        if !self.start_after.is_empty() && !self.submit.contains("{start_after}") {
            let what = "a command with {start_after}, since that key has a value";
            return Some(("submit", format!("{:?}", self.submit), expected(what)));
        }
        if let Err(fault) = self.submit_command("1", Some("1")) {
            return Some(("submit", fault.place(&self.submit), fault.expected()));
        }
        self.invalid_answers().or_else(|| self.invalid_script())
    }

    /// The same for the words that the commands print.
    fn invalid_answers(&self) -> Option<(&'static str, String, String)> {
        let mut seen = BTreeSet::new();
        for (key, words) in self.states.lists() {
            for word in words {
                if word.is_empty() || word.contains(char::is_whitespace) {
                    return Some((key, format!("{word:?}"), "words without white space".to_owned()));
                }
                if !seen.insert(word) {
                    return Some((key, format!("{word:?}, as another state"), "each word once".to_owned()));
                }
            }
        }
        if self.states.running.is_empty() {
            let expected = "at least one word, such as [\"R\"]";
            return Some(("states.running", "an empty list".to_owned(), expected.to_owned()));
        }
        let LogTexts { time_limit, out_of_memory } = &self.log;
        let texts = [
            ("vanished", &self.vanished),
            ("queue_full", &self.queue_full),
            ("log.time_limit", time_limit),
            ("log.out_of_memory", out_of_memory),
        ];
        if let Some((key, _)) = texts.iter().find(|(_, texts)| texts.iter().any(|text| text.is_empty())) {
            return Some((key, "an empty text".to_owned(), "a part of what the command prints".to_owned()));
        }
        let expected = "what `poll` prints about a job that the batch system does not know";
        self.vanished.is_empty().then(|| ("vanished", "an empty list".to_owned(), expected.to_owned()))
    }

    fn invalid_script(&self) -> Option<(&'static str, String, String)> {
        if !self.script.contains("{command}") {
            let expected = "a script with {command}, what the job runs";
            return Some(("script", "a script without it".to_owned(), expected.to_owned()));
        }
        let fault = self.fill_script(&JobRequest::example()).err()?;
        Some(("script", fault.place(&self.script), fault.expected()))
    }

    /// The script of a job.
    pub(super) fn fill_script(&self, job: &JobRequest) -> Result<String, TemplateFault> {
        template::fill(&self.script, &job.values()?, &template::in_script)
    }

    /// The command that submits this script, of a job that starts after another one.
    pub(super) fn submit_command(&self, script: &str, after: Option<&str>) -> Result<String, TemplateFault> {
        let after = after.filter(|_| !self.start_after.is_empty());
        let after = after.map(|id| self.with_id(&self.start_after, id)).transpose()?.unwrap_or_default();
        let values = [("script", Some(script.to_owned())), ("start_after", Some(after))];
        template::fill(&self.submit, &values, &template::in_command)
    }

    /// A command about a job.
    pub(super) fn with_id(&self, command: &str, id: &str) -> Result<String, TemplateFault> {
        template::fill(command, &[("id", Some(id.to_owned()))], &template::in_command)
    }
}

impl StateWords {
    /// The words of each state, with its key.
    fn lists(&self) -> [(&'static str, &[String]); 5] {
        [
            ("states.pending", &self.pending),
            ("states.running", &self.running),
            ("states.completed", &self.completed),
            ("states.failed", &self.failed),
            ("states.cancelled", &self.cancelled),
        ]
    }
}
