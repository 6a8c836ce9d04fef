//! Messages between executors and their frameworks through the controller: on a connection of their own, and only while there
//! are executors. They are large and a robot's link may be slow: no heartbeat waits behind them.
//!
//! At most once: with the connection goes what was under way, and with the session what still waited.

use std::collections::BTreeSet;
use std::convert::Infallible;
use std::future::pending;
use std::time::Duration;

use muster_api::id::TaskUid;
use muster_api::wire::agent::v1 as proto;
use tokio::sync::{mpsc, watch};
use tokio::time::Instant;
use tokio_stream::wrappers::ReceiverStream;

use super::dial::service::agent_service_client::AgentServiceClient;
use super::dial::{DEAF_AFTER, Dialer, Pauses, StreamError};
use crate::driver::chain;
use crate::executor::desk::Desks;
use crate::executor::frame::FRAME_MAX;

/// Messages under way to the connection. Each may be of 4 MiB; the rest waits where it is counted.
const QUEUE: usize = 1;

/// Longer than a session's: on a slow link what asks whether the other side is there waits behind a message.
const GONE_AFTER: Duration = Duration::from_secs(40);

/// What one session's are carried with.
#[derive(Debug)]
pub(super) struct Messages<'a> {
    pub(super) dialer: &'a Dialer,
    pub(super) desks: &'a Desks,
    /// The executors that the controller may know: those that messages reach. None: not known yet.
    pub(super) told: watch::Sender<Option<BTreeSet<TaskUid>>>,
}

impl Messages<'_> {
    /// Carries them until it is dropped.
    pub(super) async fn run(self) -> Infallible {
        let in_reach = self.desks.in_reach();
        let mut executors = self.desks.executors();
        let mut pauses = Pauses::default();
        loop {
            let there = executors.borrow_and_update().clone();
            if there.is_empty() {
                self.tell(there);
                // Closed: the agent goes down.
                if executors.changed().await.is_err() {
                    pending::<()>().await;
                }
                continue;
            }
            // One that has gone is not kept from the controller by a connection that fails.
            self.told.send_if_modified(|told| {
                let before = told.as_ref().map(BTreeSet::len);
                if let Some(told) = told {
                    told.retain(|uid| there.contains(uid));
                }
                told.as_ref().map(BTreeSet::len) != before
            });
            let begun = Instant::now();
            match self.carry(&mut executors).await {
                Ok(()) => pauses = Pauses::default(),
                Err(error) => {
                    in_reach.broke();
                    tracing::warn!(error = chain(&error), "messages of executors are not carried");
                    pauses.wait(begun).await;
                }
            }
        }
    }

    /// These are in reach.
    fn tell(&self, there: BTreeSet<TaskUid>) {
        self.told.send_if_modified(|told| told.replace(there.clone()) != Some(there));
    }

    /// Until there are no executors.
    async fn carry(
        &self,
        executors: &mut watch::Receiver<BTreeSet<TaskUid>>,
    ) -> Result<(), StreamError> {
        let (channel, _) = self.dialer.channel_with(GONE_AFTER).await?;
        let mut client = AgentServiceClient::new(channel)
            .max_decoding_message_size(FRAME_MAX)
            .max_encoding_message_size(FRAME_MAX);
        let (out, queue) = mpsc::channel::<proto::Message>(QUEUE);
        let begun = tokio::time::timeout(DEAF_AFTER, client.messages(ReceiverStream::new(queue)));
        let mut heard = begun.await.map_err(|_| StreamError::Deaf)?.map_err(Box::new)?.into_inner();
        let said = async {
            loop {
                let message = self.desks.said().await;
                if out.send(message).await.is_err() {
                    return StreamError::Closed;
                }
            }
        };
        tokio::pin!(said);
        executors.mark_changed();
        loop {
            // Cancel-safe: a stream's next message stays in the stream, a watch, and a future that is polled in place.
            tokio::select! {
                message = heard.message() => match message.map_err(Box::new)? {
                    Some(message) => self.desks.hear(message),
                    None => return Err(StreamError::Closed),
                },
                changed = executors.changed() => {
                    let there = executors.borrow_and_update().clone();
                    if there.is_empty() || changed.is_err() {
                        executors.mark_changed();
                        return Ok(());
                    }
                    self.tell(there);
                }
                ended = &mut said => return Err(ended),
            }
        }
    }
}
