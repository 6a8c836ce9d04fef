//! Publishing where robots are: for a building's localisation (motion capture, UWB, cameras).
//!
//! ```no_run
//! # async fn example() -> Result<(), Box<dyn std::error::Error>> {
//! use muster_sdk::poses::{NodePose, PoseBatch, Publisher};
//! let (publisher, mut replies) = Publisher::connect(None).await?;
//! let robot = NodePose { node: "turtlebot-1".into(), x: 3.0, y: 4.0, ..Default::default() };
//! let batch = PoseBatch { source: "mocap".into(), poses: vec![robot], ..Default::default() };
//! publisher.publish(batch).await?;
//! while let Some(reply) = replies.next().await? {
//!     eprintln!("not taken: {:?}", reply.refused);
//! }
//! # Ok(()) }
//! ```
//!
//! A publisher is one connection: when it breaks, connect again and go on with what is measured next.

use std::path::Path;
use std::sync::Arc;

pub use muster_api::wire::pose::v1::{NodePose, PoseBatch, PoseReply, Reason, Refused};
use tokio::sync::mpsc;
use tokio_stream::wrappers::ReceiverStream;
use tonic::{Status, Streaming};

use crate::ConnectError;
use crate::link::{kubeconfig, tls};

/// The publisher's side of the service.
mod service {
    #![allow(
        clippy::all,
        clippy::allow_attributes,
        clippy::allow_attributes_without_reason,
        missing_debug_implementations,
        missing_docs,
        unreachable_pub,
        reason = "generated"
    )]
    include!(concat!(env!("OUT_DIR"), "/muster.pose.v1.rs"));
}
use service::pose_service_client::PoseServiceClient;

/// Batches under way. Poses that wait are old poses: who measures faster than the connection takes should skip a frame.
const QUEUE: usize = 4;

/// Why nothing can be published.
#[derive(Debug, thiserror::Error)]
pub enum PublishError {
    /// The kubeconfig or its credentials cannot be used.
    #[error(transparent)]
    Config(#[from] ConnectError),
    /// The controller cannot be reached.
    #[error("failed to connect")]
    Connect(#[source] tonic::transport::Error),
    /// The controller ended the stream.
    #[error("the controller ended the stream: {}", .0.message())]
    Ended(Box<Status>),
    /// The stream is over.
    #[error("the stream is over")]
    Closed,
}

impl PublishError {
    /// The controller will not have it: it is no use to connect again as before.
    #[must_use]
    pub fn is_final(&self) -> bool {
        use tonic::Code;
        let code = match self {
            PublishError::Config(_) => return true,
            PublishError::Ended(status) => status.code(),
            PublishError::Connect(_) | PublishError::Closed => return false,
        };
        matches!(code, Code::Unauthenticated | Code::PermissionDenied | Code::InvalidArgument)
    }
}

/// A stream of poses to the controller.
#[derive(Debug, Clone)]
pub struct Publisher {
    batches: mpsc::Sender<PoseBatch>,
}

/// What the controller says of what was published.
#[derive(Debug)]
pub struct Replies {
    heard: Streaming<PoseReply>,
}

impl Publisher {
    /// Opens a stream to the controller of `kubeconfig`, or of `MUSTER_CONFIG`, `KUBECONFIG` or `~/.muster/config`,
    /// whichever is found first. The credentials must be those of an `operator` or `admin`.
    ///
    /// # Errors
    ///
    /// When there is no usable kubeconfig, no controller, or the controller refuses.
    pub async fn connect(kubeconfig: Option<&Path>) -> Result<(Publisher, Replies), PublishError> {
        let target =
            kubeconfig::load(&kubeconfig::files(kubeconfig)).map_err(ConnectError::from)?;
        let tls = target.tls().map_err(ConnectError::Credentials)?;
        let channel = tls::dial(&target.address, &Arc::new(tls)).await;
        let mut client = PoseServiceClient::new(channel.map_err(PublishError::Connect)?);
        let (batches, queue) = mpsc::channel(QUEUE);
        let answer = client
            .publish(kubeconfig::authorized(
                ReceiverStream::new(queue),
                target.authorization.as_ref(),
            ))
            .await;
        let heard = answer.map_err(|status| PublishError::Ended(Box::new(status)))?.into_inner();
        Ok((Publisher { batches }, Replies { heard }))
    }

    /// Hands a batch over; waits while the connection is behind.
    ///
    /// # Errors
    ///
    /// When the stream is over; [`Replies::next`] says why.
    pub async fn publish(&self, batch: PoseBatch) -> Result<(), PublishError> {
        self.batches.send(batch).await.map_err(|_| PublishError::Closed)
    }
}

impl Replies {
    /// The next reply: to a batch of which something was refused, or that asked for it. None: the stream is over.
    ///
    /// # Errors
    ///
    /// When the controller ended the stream, and why.
    pub async fn next(&mut self) -> Result<Option<PoseReply>, PublishError> {
        self.heard.message().await.map_err(|status| PublishError::Ended(Box::new(status)))
    }
}
