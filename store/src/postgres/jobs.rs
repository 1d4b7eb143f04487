//! Notifications of new label jobs.

use std::sync::Mutex;
use std::time::Duration;

use sqlx::postgres::{PgConnectOptions, PgListener, PgPoolOptions};
use tokio::sync::watch;
use tokio::task::JoinHandle;

/// Time between two tries to reach the server.
const RETRY_INTERVAL: Duration = Duration::from_secs(1);

/// The channel of the notifications, see `migrations/postgres`.
pub struct Jobs {
    options: PgConnectOptions,
    channel: String,
    /// Number of notifications received.
    heard: watch::Sender<u64>,
    /// Number of notifications that an earlier wait has seen.
    seen: Mutex<u64>,
    /// Listens from the first wait on.
    listener: Mutex<Option<JoinHandle<()>>>,
}

impl Jobs {
    pub fn new(options: PgConnectOptions, schema: &str) -> Self {
        let (channel, heard) = (format!("{schema}.jobs"), watch::Sender::new(0));
        Self { options, channel, heard, seen: Mutex::default(), listener: Mutex::default() }
    }

    /// Waits for a notification that arrived after the last wait ended, but no longer than `longest`.
    pub async fn wait(&self, longest: Duration) {
        self.listen();
        let mut heard = self.heard.subscribe();
        let seen = *lock(&self.seen);
        let news = heard.wait_for(|heard| *heard > seen);
        if let Ok(Ok(heard)) = tokio::time::timeout(longest, news).await {
            *lock(&self.seen) = *heard;
        }
    }

    fn listen(&self) {
        let mut listener = lock(&self.listener);
        if listener.is_none() {
            let task = listen(self.options.clone(), self.channel.clone(), self.heard.clone());
            *listener = Some(tokio::spawn(task));
        }
    }

    pub fn close(&self) {
        if let Some(task) = lock(&self.listener).take() {
            task.abort();
        }
    }
}

impl Drop for Jobs {
    fn drop(&mut self) {
        self.close();
    }
}

/// Never ends: reconnects after a break. Notifications before it listens are lost, so waiting callers are woken
/// then.
async fn listen(options: PgConnectOptions, channel: String, heard: watch::Sender<u64>) {
    loop {
        // Errors need no handling: without a listener, a wait lasts as long as it may.
        let _ = hear(options.clone(), &channel, &heard).await;
        tokio::time::sleep(RETRY_INTERVAL).await;
    }
}

async fn hear(
    options: PgConnectOptions,
    channel: &str,
    heard: &watch::Sender<u64>,
) -> Result<(), sqlx::Error> {
    let pool = PgPoolOptions::new().max_connections(1).connect_lazy_with(options);
    let mut listener = PgListener::connect_with(&pool).await?;
    listener.listen(channel).await?;
    heard.send_modify(|heard| *heard += 1);
    while listener.try_recv().await?.is_some() {
        heard.send_modify(|heard| *heard += 1);
    }
    Ok(())
}

/// A panic while the lock was held left a valid number or task.
fn lock<T>(mutex: &Mutex<T>) -> std::sync::MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(std::sync::PoisonError::into_inner)
}
