//! One run of a source: until it ends by itself, or is told to. What it says goes into the channel, frame by frame.

mod device;
mod exec;
mod input;
mod ros1;
mod simulated;

use std::path::{Path, PathBuf};
use std::time::Duration;

use muster_ros1::NodeOptions;
use muster_ros1::name::plain;
use tokio::time::Instant;
use tokio_util::sync::CancellationToken;

use super::channel::Channel;
use crate::position::settings::PoseSettings;
use crate::sim;

/// What sources need to know of the node.
#[derive(Debug, Default)]
pub(super) struct Context {
    /// This node's name, as ROS takes it.
    name: String,
    master: Option<String>,
    host: Option<String>,
    namespace: Option<String>,
    /// The simulator's directory.
    simulator: PathBuf,
}

impl Context {
    pub(super) fn new(ros: &PoseSettings, node: &str, data_dir: &Path) -> Context {
        Context {
            name: plain(node),
            master: ros.master.clone(),
            host: ros.host.clone(),
            namespace: ros.namespace.clone(),
            simulator: data_dir.join(sim::DIR),
        }
    }

    /// A node of ROS of its own for each topic: the end of one is not another's.
    fn node(&self, channel: &Channel) -> NodeOptions {
        let function = plain(&channel.function().to_string());
        NodeOptions {
            name: format!("muster_sensor_{}_{function}", self.name),
            master: self.master.clone(),
            host: self.host.clone(),
            namespace: self.namespace.clone(),
            ..NodeOptions::default()
        }
    }
}

/// Reads it until it ends, or `end`: why.
pub(super) async fn run(channel: &Channel, context: &Context, end: CancellationToken) -> String {
    let settings = channel.settings();
    if let Some(topic) = &settings.ros1 {
        return ros1::run(topic, channel, context, end).await;
    }
    if let Some(path) = &settings.device {
        return device::run(path, channel, end).await;
    }
    if let Some(which) = settings.sim {
        return simulated::run(which, &context.simulator, channel, end).await;
    }
    exec::run(&settings.exec, channel, end).await
}

/// Lets so many frames a second through.
struct Pace {
    every: Option<Duration>,
    due: Instant,
}

impl Pace {
    fn new(max_hz: Option<f64>) -> Pace {
        let every = max_hz.and_then(|hz| Duration::try_from_secs_f64(hz.recip()).ok());
        Pace { every, due: Instant::now() }
    }

    /// Returns when the next one may be taken.
    async fn ready(&self) {
        if self.every.is_some() {
            tokio::time::sleep_until(self.due).await;
        }
    }

    /// One was. Those that come late do not hasten others.
    fn took(&mut self) {
        if let Some(every) = self.every {
            self.due = Instant::now() + every;
        }
    }
}
