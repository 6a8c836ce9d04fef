//! The gate's sockets: the tasks' and the agent's. They bring what is said to the hall, in order, and take back what it answers.

use std::io;
use std::time::Duration;

use muster_agent_core::gate::Conn;
use muster_api::wire::gate::v1 as proto;
use prost::Message;
use proto::call::Call as Said;
use tokio::net::{UnixListener, UnixStream};
use tokio::sync::{mpsc, oneshot};
use tokio::task::JoinSet;

use super::hall::Input;
use crate::executor::frame;

/// Who connects shows a token within this.
const SHOW_WITHIN: Duration = Duration::from_secs(5);

/// Connections at once. A robot has one holder and a few delegates.
const MOST: usize = 64;

/// Longest frame of a task, bytes.
const LONGEST_CALL: usize = 64 << 10;

/// Answers that may wait for a slow reader. It waits for each, or is not of good will.
pub(super) const ANSWERS: usize = 64;

/// A connection's way back. Dropped: the connection ends.
pub(super) type Back<M> = mpsc::Sender<M>;

/// Takes tasks in until dropped. That one is gone is `urgent`.
pub(super) async fn tasks(
    listener: UnixListener,
    inputs: mpsc::Sender<Input>,
    urgent: mpsc::Sender<Input>,
) {
    let mut talks = JoinSet::new();
    let mut next = 0;
    loop {
        // Cancel-safe: a listener and a join.
        tokio::select! {
            accepted = listener.accept() => match accepted {
                Ok((stream, _)) if talks.len() < MOST => {
                    next += 1;
                    talks.spawn(task(Conn(next), stream, inputs.clone(), urgent.clone()));
                }
                Ok(_) => tracing::warn!("too many connections of tasks"),
                Err(error) => {
                    tracing::warn!(%error, "the tasks' socket");
                    tokio::time::sleep(Duration::from_secs(1)).await;
                }
            },
            Some(_) = talks.join_next() => {}
        }
    }
}

async fn task(
    conn: Conn,
    mut stream: UnixStream,
    inputs: mpsc::Sender<Input>,
    urgent: mpsc::Sender<Input>,
) {
    let first = frame::read_within(LONGEST_CALL, &mut stream);
    let first = tokio::time::timeout(SHOW_WITHIN, first).await;
    let Ok(Ok(Some(proto::Call { call: Some(Said::Register(register)) }))) = first else { return };
    let (back, answers) = mpsc::channel(ANSWERS);
    let (admit, admitted) = oneshot::channel();
    let _ = inputs.send(Input::Opened { conn, token: register.token, back, admit }).await;
    if admitted.await.is_err() {
        tracing::warn!("a connection without a token that counts");
        return;
    }
    // Something newer than this gate is not answered, so whoever says it is not to go on.
    let input = move |call: proto::Call| call.call.map(|call| Input::Call(conn, call));
    if let Err(error) = talk(stream, LONGEST_CALL, answers, &inputs, input).await {
        tracing::info!(%error, "a task's connection");
    }
    // Before what others say, and before what is left of its own: nobody stands behind that any more. Closed: the gate ends,
    // and stops the robot.
    let _ = urgent.send(Input::Closed(conn)).await;
}

/// Takes agents in until dropped. The newest counts.
pub(super) async fn agents(listener: UnixListener, inputs: mpsc::Sender<Input>) {
    let mut talks = JoinSet::new();
    let mut life = 0;
    loop {
        // Cancel-safe: a listener and a join.
        tokio::select! {
            accepted = listener.accept() => match accepted {
                Ok((stream, _)) => {
                    life += 1;
                    talks.spawn(agent(life, stream, inputs.clone()));
                }
                Err(error) => {
                    tracing::warn!(%error, "the agent's socket");
                    tokio::time::sleep(Duration::from_secs(1)).await;
                }
            },
            Some(_) = talks.join_next() => {}
        }
    }
}

async fn agent(life: u64, stream: UnixStream, inputs: mpsc::Sender<Input>) {
    let (back, statuses) = mpsc::channel(ANSWERS);
    let _ = inputs.send(Input::AgentCame(life, back)).await;
    let input = move |wanted: proto::Wanted| Some(Input::Wanted(life, wanted));
    if let Err(error) = talk(stream, frame::FRAME_MAX, statuses, &inputs, input).await {
        tracing::info!(%error, "the agent's connection");
    }
    let _ = inputs.send(Input::AgentGone(life)).await;
}

/// Reads until the other side closes or says what is no input, and writes what comes back until nobody answers any more.
async fn talk<In, Out>(
    stream: UnixStream,
    longest: usize,
    mut back: mpsc::Receiver<Out>,
    inputs: &mpsc::Sender<Input>,
    input: impl Fn(In) -> Option<Input>,
) -> io::Result<()>
where
    In: Message + Default,
    Out: Message,
{
    let (mut from, mut to) = stream.into_split();
    let read = async {
        while let Some(message) = frame::read_within::<In, _>(longest, &mut from).await? {
            let Some(input) = input(message) else { break };
            if inputs.send(input).await.is_err() {
                break;
            }
        }
        Ok(())
    };
    let write = async {
        while let Some(message) = back.recv().await {
            frame::write(&mut to, &message).await?;
        }
        Ok(())
    };
    // Neither is polled again after the other has ended.
    tokio::select! {
        ended = read => ended,
        ended = write => ended,
    }
}
