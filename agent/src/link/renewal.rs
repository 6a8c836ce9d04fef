//! The node's certificate, renewed before it ends.
//!
//! It is due when between 60 and 80 % of its term are over, by the node's name: a fleet that joined in one hour does not come
//! back in one. Connections that are there go on with the one before, which counts until a newer one was renewed in turn.

use std::sync::Arc;
use std::time::Duration;

use jiff::{SignedDuration, Timestamp};
use rustls::{ClientConfig, ServerConfig};
use tokio::sync::watch;

use super::Address;
use super::join::{self, Credentials, JoinError};
use super::tls::{self, Term, sha256};
use crate::config::Kind;
use crate::driver::chain;

/// Between two looks at the clock: machines sleep, and clocks are set.
const LOOK: Duration = Duration::from_secs(3600);

/// After a try that failed, at least and at most.
const PAUSE: (Duration, Duration) = (Duration::from_secs(1), LOOK);

/// Who renews what.
#[derive(Debug)]
pub(crate) struct Renewal {
    pub(crate) address: Address,
    pub(crate) node: String,
    pub(crate) kind: Kind,
    pub(crate) credentials: Credentials,
    /// For connections to the controller that begin from now on.
    pub(crate) client: watch::Sender<Arc<ClientConfig>>,
    /// The same for those of frameworks.
    pub(crate) server: Option<watch::Sender<Arc<ServerConfig>>>,
    /// The certificate of both, as it is stored; empty at first.
    pub(crate) shown: Vec<u8>,
}

impl Renewal {
    /// Never ends.
    pub(crate) async fn run(mut self) {
        loop {
            let left = match self.look().await {
                Ok(left) => left,
                Err(error) => {
                    let pause = self.pause();
                    let again = pause.as_secs();
                    tracing::warn!(error = chain(&error), again, "the certificate was not renewed");
                    pause
                }
            };
            tokio::time::sleep(left.min(LOOK)).await;
        }
    }

    /// Renews it if it is due; how long there is nothing to do.
    async fn look(&mut self) -> Result<Duration, JoinError> {
        // Also one that was stored by a look that then failed.
        self.show()?;
        let term = tls::term(&self.shown)?;
        let left = Timestamp::now().duration_until(due(term, &self.node));
        if left.is_positive() {
            // Machines sleep: looked at some times before it ends, however short its term.
            let often = term.from.duration_until(term.to).unsigned_abs() / 20;
            return Ok(left.unsigned_abs().min(often));
        }
        join::renew(&self.address, (&self.node, self.kind), &self.credentials).await?;
        self.show()?;
        tracing::info!(until = %tls::term(&self.shown)?.to, "the certificate is renewed");
        // By a clock that is far ahead the new one is due as well.
        Ok(self.pause())
    }

    /// Has connections that begin from now on show what is stored.
    fn show(&mut self) -> Result<(), JoinError> {
        let stored = self.credentials.certificate()?;
        if stored == self.shown {
            return Ok(());
        }
        let client = self.credentials.tls()?;
        if let Some(server) = &self.server
            && let Some(config) = self.credentials.serving(&self.node)?
        {
            server.send_replace(Arc::new(config));
        }
        self.client.send_replace(Arc::new(client));
        self.shown = stored;
        Ok(())
    }

    /// A tenth of what is left, so that some tries remain.
    fn pause(&self) -> Duration {
        let end = tls::term(&self.shown).map(|term| term.to);
        let left = end.map_or(SignedDuration::ZERO, |end| Timestamp::now().duration_until(end));
        let left = if left.is_positive() { left.unsigned_abs() } else { PAUSE.1 * 10 };
        (left / 10).clamp(PAUSE.0, PAUSE.1)
    }
}

/// When the certificate of this node is to be renewed.
fn due(term: Term, node: &str) -> Timestamp {
    let share = 0.6 + 0.2 * f64::from(sha256(node.as_bytes())[0]) / 255.0;
    term.from + term.from.duration_until(term.to).mul_f64(share)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn fleets_are_spread_over_a_fifth_of_the_term() {
        let from: Timestamp = "2026-01-01T00:00:00Z".parse().expect("a time");
        let to = from + SignedDuration::from_hours(1000);
        let names = (0..200).map(|i| format!("robot-{i}"));
        let after = |name: String| from.duration_until(due(Term { from, to }, &name)).as_hours();
        let (mut low, mut high) = (i64::MAX, i64::MIN);
        for hours in names.map(after) {
            assert!((600..=800).contains(&hours), "{hours}");
            (low, high) = (low.min(hours), high.max(hours));
        }
        assert!(high - low > 150, "{low}..{high}");
    }
}
