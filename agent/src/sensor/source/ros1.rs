//! A topic of ROS 1, of whatever type it is: a frame is a message as it is serialised, without its length.

use std::time::Duration;

use muster_ros1::Node;
use muster_ros1::node::{Incoming, MasterState, SubscribeOptions, Subscriber};
use tokio::time::MissedTickBehavior;
use tokio_util::sync::CancellationToken;

use super::{Context, Pace};
use crate::driver::chain;
use crate::sensor::channel::Channel;

/// Messages that may wait here; the channel has a line for each reader.
const QUEUE: usize = 4;

/// Whoever published may be gone without a word.
const LOOK: Duration = Duration::from_millis(500);

pub(super) async fn run(
    topic: &str,
    channel: &Channel,
    context: &Context,
    end: CancellationToken,
) -> String {
    let node = tokio::select! {
        () = end.cancelled() => return "nobody wants it".to_owned(),
        node = Node::start(context.node(channel)) => match node {
            Ok(node) => node,
            Err(error) => return chain(&error),
        },
    };
    let why = follow(&node, topic, channel, &end).await;
    node.shut_down().await;
    why
}

async fn follow(node: &Node, topic: &str, channel: &Channel, end: &CancellationToken) -> String {
    let options = SubscribeOptions { queue: QUEUE, largest: channel.settings().longest() };
    let mut topic = match node.subscribe_any(topic, options) {
        Ok(topic) => topic,
        Err(error) => return chain(&error),
    };
    let mut pace = Pace::new(channel.settings().max_hz);
    let mut looks = tokio::time::interval(LOOK);
    looks.set_missed_tick_behavior(MissedTickBehavior::Delay);
    looks.tick().await;
    let ended = node.ended();
    tokio::pin!(ended);
    loop {
        // Cancel-safe: a token, a watch, a sleep before a queue, and a tick.
        tokio::select! {
            () = end.cancelled() => return "nobody wants it".to_owned(),
            why = &mut ended => return why,
            incoming = next(&pace, &mut topic) => {
                pace.took();
                if let Err(why) = publish(channel, &incoming) {
                    channel.trouble(&format!("{}: {why}", topic.topic()));
                }
            }
            _ = looks.tick() => {
                if let Some(why) = trouble(node, &topic) {
                    channel.trouble(&why);
                }
            }
        }
    }
}

async fn next(pace: &Pace, topic: &mut Subscriber<Incoming>) -> Incoming {
    pace.ready().await;
    topic.next().await
}

fn publish(channel: &Channel, incoming: &Incoming) -> Result<(), String> {
    let mut blank = channel.blank(incoming.body.len())?;
    blank.bytes().copy_from_slice(&incoming.body);
    channel.set_kind(&incoming.from);
    channel.publish(blank);
    Ok(())
}

/// Why nothing can come. A connection outlives the master that arranged it.
fn trouble(node: &Node, topic: &Subscriber<Incoming>) -> Option<String> {
    let (status, name) = (topic.status(), topic.topic());
    if status.connected > 0 {
        return None;
    }
    Some(match (&*node.state().borrow(), status.trouble) {
        (MasterState::Gone { why }, _) => format!("{name}: the ROS master does not answer: {why}"),
        (_, Some(why)) => format!("{name}: its publisher cannot be reached: {why}"),
        (MasterState::Unknown, None) => return None,
        (MasterState::Registered, None) => format!("nobody publishes {name}"),
    })
}
