//! The gRPC service by which a building's localisation publishes poses: a task a stream.

use std::pin::Pin;
use std::sync::Arc;

use futures::Stream;
use muster_api::wire::pose::v1 as wire;
use muster_api::wire::pose_stream::pose_of;
use muster_controller_core::poses::NotTaken;
use tokio::sync::mpsc;
use tokio_stream::wrappers::ReceiverStream;
use tokio_util::task::TaskTracker;
use tonic::{Request, Response, Status, Streaming};

use super::LivePoses;
use super::proto::pose_service_server::PoseService;
use crate::auth::{self, Asker};
use crate::context::Context;
use crate::session::status_of;

/// Replies that wait for a publisher to read them; more are dropped, because nobody may wait for a publisher.
const REPLIES: usize = 64;

/// The service.
#[derive(Debug, Clone)]
pub struct Service {
    context: Arc<Context>,
    poses: Arc<LivePoses>,
    tasks: TaskTracker,
}

impl Service {
    /// A service whose streams run on `tasks` and end with `context.stop`.
    #[must_use]
    pub fn new(context: Arc<Context>, poses: Arc<LivePoses>, tasks: TaskTracker) -> Self {
        Service { context, poses, tasks }
    }
}

type Replies = mpsc::Sender<Result<wire::PoseReply, Status>>;

#[tonic::async_trait]
impl PoseService for Service {
    type PublishStream = Pin<Box<dyn Stream<Item = Result<wire::PoseReply, Status>> + Send>>;

    async fn publish(
        &self,
        request: Request<Streaming<wire::PoseBatch>>,
    ) -> Result<Response<Self::PublishStream>, Status> {
        let asker = Asker::of(&self.context, request.extensions());
        asker
            .needs(&auth::stream(("poses", "stream"), None, None))
            .map_err(|failure| status_of(&failure))?;
        let (replies, outbound) = mpsc::channel(REPLIES);
        let (poses, context) = (Arc::clone(&self.poses), Arc::clone(&self.context));
        let inbound = request.into_inner();
        self.tasks.spawn(async move {
            let asked = auth::stream(("poses", "stream"), None, None);
            let ended = tokio::select! {
                () = context.stop.cancelled() => Err(Status::unavailable("the controller ends")),
                () = auth::until_revoked(&context, &asker.identity, &asked) => {
                    Err(Status::permission_denied("the right to publish poses was taken back"))
                }
                // Its publisher does not listen any more; it may be gone without a word.
                () = replies.closed() => Ok(()),
                ended = take_all(&poses, inbound, &replies) => ended,
            };
            if let Err(status) = ended {
                // A publisher that does not read need not be told.
                drop(replies.try_send(Err(status)));
            }
        });
        Ok(Response::new(Box::pin(ReceiverStream::new(outbound))))
    }
}

async fn take_all(
    poses: &LivePoses,
    mut inbound: Streaming<wire::PoseBatch>,
    replies: &Replies,
) -> Result<(), Status> {
    poses.ready().await;
    // A stream that breaks needs no answer: what it said counts until somebody says something newer.
    while let Ok(Some(batch)) = inbound.message().await {
        if batch.source.is_empty() {
            let text = "batch.source is missing; name what measures the poses, as in \"mocap\"";
            return Err(Status::invalid_argument(text));
        }
        let reply = take(poses, &batch);
        if batch.acknowledge || !reply.refused.is_empty() {
            drop(replies.try_send(Ok(reply)));
        }
    }
    Ok(())
}

fn take(poses: &LivePoses, batch: &wire::PoseBatch) -> wire::PoseReply {
    let refused: Vec<wire::Refused> = poses.write(|table, now| {
        let take = |one: &wire::NodePose| match pose_of(batch, one) {
            Ok(pose) => table.put(&one.node, pose, now).err().map(|why| {
                let message = match &why {
                    NotTaken::UnknownNode => why.to_string(),
                    _ => format!("{} {why}", one.node),
                };
                refusal(&one.node, reason(&why), message)
            }),
            Err(error) => Some(refusal(&one.node, wire::Reason::Invalid, error.to_string())),
        };
        batch.poses.iter().filter_map(take).collect()
    });
    let taken = batch.poses.len() - refused.len();
    metrics::counter!("muster_poses_total", "origin" => "building").increment(taken as u64);
    if !refused.is_empty() {
        metrics::counter!("muster_poses_refused_total").increment(refused.len() as u64);
    }
    let taken = u32::try_from(taken).unwrap_or(u32::MAX);
    wire::PoseReply { sequence: batch.sequence, taken, refused }
}

fn refusal(node: &str, reason: wire::Reason, message: String) -> wire::Refused {
    wire::Refused { node: node.to_owned(), reason: reason.into(), message }
}

fn reason(why: &NotTaken) -> wire::Reason {
    match why {
        NotTaken::UnknownNode => wire::Reason::UnknownNode,
        NotTaken::NotARobot => wire::Reason::NotARobot,
        NotTaken::OtherSource { .. } => wire::Reason::OtherSource,
        NotTaken::Older { .. } => wire::Reason::Older,
    }
}
