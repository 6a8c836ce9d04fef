//! Emergency stops from the controller, and whether a person holds the robot, on a connection of their own: nothing that the agent says, and nothing else that it is
//! told, is ever before them.

use std::convert::Infallible;
use std::sync::Arc;
use std::time::Duration;

use muster_api::wire::agent::v1 as proto;
use tokio::sync::watch;
use tokio::time::Instant;

use super::dial::service::agent_service_client::AgentServiceClient;
use super::dial::{DEAF_AFTER, Dialer, Pauses, StreamError};
use crate::driver::chain;
use crate::gate::keeper::Keeper;

/// Shorter than a session's: a connection that is gone without a word keeps a stop from the robot for so long.
const GONE_AFTER: Duration = Duration::from_secs(2);

/// What is needed to hear them.
#[derive(Debug)]
pub(crate) struct Orders {
    pub(crate) dialer: Dialer,
    pub(crate) gate: Arc<Keeper>,
    /// Whether they are heard.
    pub(crate) heard: watch::Sender<bool>,
}

impl Orders {
    /// Hears them until it is dropped.
    pub(crate) async fn run(self) {
        let mut pauses = Pauses::default();
        loop {
            let begun = Instant::now();
            let Err(error) = self.follow().await;
            let was_heard = self.heard.send_replace(false);
            // One line a loss, not one a try.
            if was_heard || pauses.is_first() {
                tracing::warn!(error = chain(&error), "emergency stops are not heard");
            }
            pauses.wait(begun).await;
        }
    }

    async fn follow(&self) -> Result<Infallible, StreamError> {
        let (channel, _) = self.dialer.channel_with(GONE_AFTER).await?;
        let mut client = AgentServiceClient::new(channel);
        let begun = tokio::time::timeout(DEAF_AFTER, client.orders(proto::OrdersRequest {}));
        let begun = begun.await.map_err(|_| StreamError::Deaf)?.map_err(Box::new)?;
        let mut orders = begun.into_inner();
        while let Some(order) = orders.message().await.map_err(Box::new)? {
            self.gate.order(&order);
            self.heard.send_replace(true);
        }
        Err(StreamError::Closed)
    }
}
