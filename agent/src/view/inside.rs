//! A thread in a task's network. A socket belongs to the network of the thread that makes it, and so do those of threads that it
//! starts: everything that the view says to the task's nodes is said from here.

use std::convert::Infallible;
use std::io;
use std::net::Ipv4Addr;
use std::os::fd::{AsFd as _, OwnedFd};
use std::sync::Arc;
use std::time::Duration;

use futures::future::{BoxFuture, FutureExt as _, select_all};
use muster_failpoint::Failpoint;
use muster_ros1::pace::Pace;
use muster_ros1::roscore::{Roscore, Save};
use muster_ros1::{Node, NodeOptions};
use rustix::thread::{LinkNameSpaceType, move_into_link_name_space};
use tokio::net::TcpListener;
use tokio_util::sync::CancellationToken;

use super::{Plan, relay};
use crate::driver::chain;
use crate::durable::{self, Keep};
use crate::ros::VIEW_PORT;

/// How often a task may call the master and the node, and how often at once: they are the agent's, whose time is nobody's. A launch of
/// a hundred nodes are some thousand calls.
const CALLS_EVERY: Duration = Duration::from_millis(2);
const CALLS_AT_ONCE: u32 = 4_000;

/// Its node, in every view.
const NODE: &str = "muster";

/// Serves the view in that network until dropped, or it cannot any more: why.
pub(super) async fn serve(network: OwnedFd, plan: Arc<Plan>) -> String {
    let over = CancellationToken::new();
    let _guard = over.clone().drop_guard();
    let (end, ended) = tokio::sync::oneshot::channel();
    let work = move || {
        let why = run(&network, &plan, &over).unwrap_or_else(|error| error.to_string());
        // Nobody waits any more.
        let _ = end.send(why);
    };
    match std::thread::Builder::new().name("view".to_owned()).spawn(work) {
        Ok(_) => ended.await.unwrap_or_else(|error| error.to_string()),
        Err(error) => error.to_string(),
    }
}

fn run(network: &OwnedFd, plan: &Arc<Plan>, over: &CancellationToken) -> io::Result<String> {
    move_into_link_name_space(network.as_fd(), Some(LinkNameSpaceType::Network))?;
    let runtime = tokio::runtime::Builder::new_current_thread()
        .enable_all()
        .max_blocking_threads(2)
        .build()?;
    let why = runtime.block_on(async {
        // Neither is polled again after the other has ended.
        tokio::select! {
            () = over.cancelled() => String::new(),
            why = view(plan) => why.map_or_else(|why| why, |never| match never {}),
        }
    });
    // A name that is being looked up holds nobody up.
    runtime.shutdown_background();
    Ok(why)
}

async fn view(plan: &Arc<Plan>) -> Result<Infallible, String> {
    let host = Ipv4Addr::LOCALHOST.to_string();
    let listener = TcpListener::bind((Ipv4Addr::LOCALHOST, VIEW_PORT)).await;
    let listener = listener.map_err(|error| format!("127.0.0.1:{VIEW_PORT}: {error}"))?;
    let pace = Pace::new(CALLS_EVERY, CALLS_AT_ONCE);
    let master = Roscore::resume(listener, &host, &known(plan), save(plan), pace.clone());
    let master = master.map_err(|error| error.to_string())?;
    let options = NodeOptions {
        name: NODE.to_owned(),
        master: Some(master.uri().to_string()),
        host: Some(host),
        namespace: Some("/".to_owned()),
        stays: true,
        pace: Some(pace),
        ..NodeOptions::default()
    };
    let node = Node::start(options).await.map_err(|error| chain(&error))?;
    master.keep(node.name(), node.api());
    let mut relays: Vec<BoxFuture<'_, String>> = vec![std::future::pending().boxed()];
    relays.extend(plan.sensors.iter().map(|sensor| relay::sensor(&node, sensor).boxed()));
    if let Some(right) = &plan.right {
        let actuator = |actuator| relay::actuator(&node, actuator, right).boxed();
        relays.extend(plan.actuators.iter().map(actuator));
    }
    // None is polled again after one has ended.
    Err(select_all(relays).await.0)
}

/// What the master of this attempt knew in an earlier life of the agent.
fn known(plan: &Plan) -> String {
    let text = std::fs::read_to_string(&plan.file).unwrap_or_default();
    let of = text.split_once('\n').filter(|(attempt, _)| *attempt == plan.attempt.to_string());
    of.map(|(_, known)| known.to_owned()).unwrap_or_default()
}

/// What the master knows must outlast the agent's process, and no more: after another boot none of the nodes lives.
fn save(plan: &Arc<Plan>) -> Save {
    let plan = Arc::clone(plan);
    Box::new(move |known| {
        let text = format!("{}\n{known}", plan.attempt);
        let bytes = text.as_bytes();
        let saved = durable::write(Failpoint::RosView, &plan.file, bytes, 0o600, Keep::Crash);
        saved.map_err(|error| io::Error::other(chain(&error)))
    })
}
