//! A task's output, on request. The outgoing queue is short and shared with everything else that the
//! session says, so a reader that is slow slows only the reading of files.

use futures::StreamExt;
use muster_api::wire::agent::v1 as proto;
use tokio::sync::mpsc;

use super::session::outgoing;
use crate::board::Board;
use crate::runtime::{AttemptId, LogQuery};

/// A chunk must leave room in a gRPC message and must not hold up a heartbeat for long.
const LARGEST_CHUNK: usize = 64 << 10;

/// Sends what `request` asks for, to its end.
pub(crate) async fn stream_logs(
    board: &Board,
    request: proto::LogRequest,
    out: mpsc::Sender<proto::AgentMessage>,
) {
    let id = request.id;
    let error = send_all(board, &request, &out).await.err().unwrap_or_default();
    let end = proto::LogChunk { id, data: Vec::new(), end: true, error };
    // Closed: the session is over, and with it whoever asked.
    let _ = out.send(outgoing(proto::agent_message::Body::Log(end))).await;
}

async fn send_all(
    board: &Board,
    request: &proto::LogRequest,
    out: &mpsc::Sender<proto::AgentMessage>,
) -> Result<(), String> {
    let Some((runtime, mut id)) = board.find(&request.uid) else {
        return Err("this node does not have the task".to_owned());
    };
    if request.previous {
        let attempt = id.attempt.checked_sub(1).filter(|attempt| *attempt > 0);
        let attempt = attempt.ok_or("the task has no earlier attempt")?;
        id = AttemptId { attempt, ..id };
    }
    let since = match &request.since {
        Some(since) => Some(
            jiff::Timestamp::new(since.seconds, since.nanos).map_err(|error| error.to_string())?,
        ),
        None => None,
    };
    let query = LogQuery {
        follow: request.follow,
        tail: request.tail_lines,
        timestamps: request.timestamps,
        since,
    };
    let mut lines = runtime.logs(&id, query);
    while let Some(part) = lines.next().await {
        let mut part = part.map_err(|error| format!("the log cannot be read: {error}"))?;
        while !part.is_empty() {
            let data = part.split_to(part.len().min(LARGEST_CHUNK));
            let chunk = proto::LogChunk {
                id: request.id,
                data: data.to_vec(),
                end: false,
                error: String::new(),
            };
            let message = outgoing(proto::agent_message::Body::Log(chunk));
            if out.send(message).await.is_err() {
                return Ok(());
            }
        }
    }
    Ok(())
}
