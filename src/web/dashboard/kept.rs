//! Answers that take long: reckoned when somebody asks, and kept for the others who ask.

use std::sync::Arc;
use std::time::{Duration, Instant};

use tokio::sync::Mutex;

use super::answer::{Answer, Refusal, json_text};

/// What was reckoned is given out again for so many times as long as it took …
const PART: u32 = 50;
/// … and for so long at least.
const LEAST: Duration = Duration::from_secs(2);

/// What was reckoned last. Whoever asks while it is being reckoned waits for it.
#[derive(Clone, Debug, Default)]
pub struct Kept(Arc<Mutex<Option<Reckoned>>>);

#[derive(Debug)]
struct Reckoned {
    text: String,
    until: Instant,
}

impl Kept {
    /// The JSON that is kept, or what `reckon` comes to.
    pub async fn answer(&self, reckon: impl Future<Output = Result<String, Refusal>>) -> Answer {
        let mut kept = self.0.lock().await;
        if let Some(reckoned) = kept.as_ref().filter(|reckoned| Instant::now() < reckoned.until) {
            return Ok(json_text(reckoned.text.clone()));
        }
        let begun = Instant::now();
        let text = reckon.await?;
        let until = Instant::now() + (begun.elapsed() * PART).max(LEAST);
        *kept = Some(Reckoned { text: text.clone(), until });
        Ok(json_text(text))
    }
}
