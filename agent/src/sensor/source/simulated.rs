//! A sensor of the simulated robot: a socket of its simulator.

use std::os::fd::OwnedFd;
use std::path::Path;

use tokio::net::UnixStream;
use tokio_util::sync::CancellationToken;

use super::input::Input;
use crate::sensor::channel::Channel;
use crate::sensor::settings::Simulated;
use crate::sim;

pub(super) async fn run(
    which: Simulated,
    dir: &Path,
    channel: &Channel,
    end: CancellationToken,
) -> String {
    let (socket, message) = match which {
        Simulated::Laser => (sim::LASER, "LaserScan"),
        Simulated::Camera => (sim::CAMERA, "Image"),
    };
    let input = async {
        let stream = UnixStream::connect(dir.join(socket)).await?;
        Input::new(OwnedFd::from(stream.into_std()?))
    };
    let input = match input.await {
        Ok(input) => input,
        Err(error) => return format!("the simulator: {error}"),
    };
    channel.set_format(&format!("protobuf:muster.ros.v1.sensor_msgs.{message}"));
    // Nothing of it is read again after this.
    tokio::select! {
        () = end.cancelled() => "nobody wants it".to_owned(),
        why = input.frames(channel) => format!("the simulator: {}", why.as_deref().unwrap_or("it ended")),
    }
}
