//! Sensors: each source is read once, and every task that asked for its function gets what it says, over a socket of its own.
//! Who gets which frame, and when a source is read, is decided in `muster_agent_core::sensor`.
//!
//! ```text
//!  program, device, topic ──▶ source ──▶ channel: core decides ──┬──▶ seat of a task: its sockets ⇄ readers
//!                              (one run)   │ slots (memory)      └──▶ seat of another
//!                                          └──▶ standing: the node's condition, each task's status.json
//! ```
//!
//! | module | holds |
//! |---|---|
//! | [`settings`] | `sensors` of `agent.yaml` |
//! | `channel` | one function: its frames, its readers, how it stands |
//! | [`reading`] | one function as a topic of ROS, for a task with a graph of its own |
//! | `slot` | pieces of memory that tasks may see and not change |
//! | `source` | what is read, and how frames are kept apart |
//! | [`seat`] | one task's sockets |
//! | `talk` | one reader's connection |
//!
//! A frame of more than [`slot::INLINE`] bytes is written once, into shared memory, whoever reads it; what goes over a socket
//! is its number. The sockets end with the agent; its next life listens at the same places, and clients come again. Programs
//! that are read end with the agent.
//!
//! Only processes of the task itself are let in: the kernel names who connects, and the task's control group names who is the
//! task's. Without control groups (`--unenforced-quotas`) it is the token that counts.

mod channel;
pub(crate) mod reading;
pub(crate) mod seat;
pub(crate) mod settings;
mod slot;
mod source;
pub(crate) mod talk;

use std::collections::BTreeMap;
use std::sync::Arc;

use futures::future::join_all;
use muster_agent_core::sensor::source::Standing;
use muster_api::condition::{Condition, ConditionStatus, SENSORS_READY};
use muster_api::name::FunctionName;
use tokio_util::sync::CancellationToken;

use crate::config::Config;
use channel::Channel;
use source::Context;

/// The directory of a task in which its sockets are. Only the agent can write in it.
pub(crate) const DIR: &str = "sensors";
/// Where a task finds that.
pub(crate) const DIR_ENV: &str = "MUSTER_SENSORS_DIR";
/// What it shows there.
pub(crate) const TOKEN_ENV: &str = "MUSTER_SENSORS_TOKEN";

/// The sensors of this node that have a source.
#[derive(Debug, Default)]
pub(crate) struct Sensors {
    channels: BTreeMap<FunctionName, Arc<Channel>>,
    context: Context,
    /// Of the agent.
    life: String,
}

impl Sensors {
    /// Those of the settings; nothing is read yet.
    pub(crate) fn new(config: &Config, node: &str) -> Sensors {
        let channel = |source: &settings::Source| {
            (source.function.clone(), Arc::new(Channel::new(source.clone())))
        };
        Sensors {
            channels: config.sources.iter().map(channel).collect(),
            context: Context::new(&config.pose, node, &config.data_dir),
            life: uuid::Uuid::new_v4().simple().to_string(),
        }
    }

    /// Whether any of these has a source.
    pub(crate) fn serves(&self, functions: &[FunctionName]) -> bool {
        functions.iter().any(|function| self.channels.contains_key(function))
    }

    /// Those of a task that are topics.
    pub(crate) fn topics(
        &self,
        functions: &[FunctionName],
        namespace: Option<&str>,
    ) -> Vec<reading::Topic> {
        let asked = functions.iter().filter_map(|function| self.channels.get(function));
        asked.filter_map(|c| reading::Topic::of(c, namespace.unwrap_or("/"))).collect()
    }

    /// Reads what tasks want until `end`; returns when nothing is read any more.
    pub(crate) async fn run(&self, end: CancellationToken) {
        join_all(self.channels.values().map(|channel| channel.attend(&self.context, &end))).await;
    }

    /// How they stand; none: no sensor has a source.
    pub(crate) fn condition(&self) -> Option<Condition> {
        let standings =
            || self.channels.values().map(|channel| (channel.function(), channel.standing()));
        let (mut failing, mut starting) = (Vec::new(), Vec::new());
        for (function, standing) in standings() {
            match standing {
                Standing::Failing(why) => failing.push(format!("{function}: {why}")),
                Standing::Starting => starting.push(function.to_string()),
                Standing::Idle | Standing::Delivering => {}
            }
        }
        let condition = |status: ConditionStatus, reason, message| {
            Condition::new(SENSORS_READY, status, reason, message)
        };
        Some(match (failing.as_slice(), starting.as_slice()) {
            _ if self.channels.is_empty() => return None,
            ([_, ..], _) => condition(ConditionStatus::False, "SourceFailed", failing.join("; ")),
            ([], [_, ..]) => {
                let message = format!("nothing has come yet of {}", starting.join(", "));
                condition(ConditionStatus::Unknown, "Starting", message)
            }
            ([], []) => condition(ConditionStatus::True, "AsAsked", String::new()),
        })
    }
}
