//! Emergency stops from the controller, on a connection of their own: nothing that the agent says, and nothing else that it is
//! told, is ever before them.

use std::convert::Infallible;
use std::sync::Arc;
use std::time::Duration;

use muster_api::wire::agent::v1 as proto;
use tokio::sync::watch;
use tokio::time::Instant;

use super::dial::service::agent_service_client::AgentServiceClient;
use super::dial::{DialError, Dialer, PAUSE};
use crate::driver::chain;
use crate::gate::keeper::Keeper;

/// It begins within this, once there is a connection.
const BEGINS_WITHIN: Duration = Duration::from_secs(10);

/// Shorter than a session's: a connection that is gone without a word keeps a stop from the robot for so long.
const DEAF_AFTER: Duration = Duration::from_secs(2);

/// Why the stream ended.
#[derive(Debug, thiserror::Error)]
enum OrdersError {
    #[error(transparent)]
    Connect(#[from] DialError),
    #[error("the controller ended the stream")]
    Status(#[from] Box<tonic::Status>),
    #[error("the controller closed the stream")]
    Closed,
    #[error("nothing was heard for {} s", BEGINS_WITHIN.as_secs())]
    Deaf,
}

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
        let mut pause = PAUSE.0;
        loop {
            let begun = Instant::now();
            let Err(error) = self.follow().await;
            let was_heard = self.heard.send_replace(false);
            // One line a loss, not one a try.
            if was_heard || pause == PAUSE.0 {
                tracing::warn!(error = chain(&error), "emergency stops are not heard");
            }
            if begun.elapsed() > PAUSE.1 {
                pause = PAUSE.0;
            }
            tokio::time::sleep(pause).await;
            pause = (pause * 2).min(PAUSE.1);
        }
    }

    async fn follow(&self) -> Result<Infallible, OrdersError> {
        let (channel, _) = self.dialer.channel_with(DEAF_AFTER).await?;
        let mut client = AgentServiceClient::new(channel);
        let begun = tokio::time::timeout(BEGINS_WITHIN, client.orders(proto::OrdersRequest {}));
        let begun = begun.await.map_err(|_| OrdersError::Deaf)?.map_err(Box::new)?;
        let mut orders = begun.into_inner();
        while let Some(order) = orders.message().await.map_err(Box::new)? {
            self.gate.demand(order.estop_tier, order.estop_release);
            self.heard.send_replace(true);
        }
        Err(OrdersError::Closed)
    }
}
