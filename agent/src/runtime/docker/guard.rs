//! The guard of a container that may not run without contact: a shim without a program of its own.
//! It ends the container's processes when the time has passed, with the agent frozen or dead.

use std::io;
use std::path::PathBuf;
use std::process::{Child, Stdio};

use super::DockerConfig;
use crate::durable;
use crate::runtime::cgroup::group::Group;
use crate::runtime::launch::{AttemptId, Launch};
use crate::runtime::process::attempt::{AttemptDir, LogBounds, Order};
use crate::runtime::process::{scan, spawn_shim};

fn dir(config: &DockerConfig, id: &AttemptId) -> PathBuf {
    config.tasks.join(id.uid.as_str()).join("attempts").join(id.attempt.to_string())
}

/// Starts the guard of a container whose first process is `pid`, if none stands already.
pub(super) async fn start(
    config: &DockerConfig,
    boot_id: &str,
    launch: &Launch,
    pid: i32,
    group: Group,
) -> io::Result<Option<Child>> {
    // The container is gone: there is nothing to guard.
    let Some(process) = scan::process(pid) else { return Ok(None) };
    let dir = AttemptDir::new(dir(config, &launch.id));
    let order = Order {
        launch: launch.clone(),
        group: Some(group),
        guarded: Some(process),
        work_dir: config.tasks.clone(),
        contact: config.contact.clone(),
        boot_id: boot_id.to_owned(),
        log: LogBounds::default(),
    };
    let reexec = config.reexec.clone();
    tokio::task::spawn_blocking(move || {
        std::fs::create_dir_all(dir.path())?;
        let failed = |error: durable::FileError| io::Error::other(crate::driver::chain(&error));
        // Held: a guard of an earlier life of the agent still stands.
        let Some(lock) = dir.lock().map_err(failed)? else { return Ok(None) };
        dir.write_order(&order).map_err(failed)?;
        let null = std::fs::File::options().write(true).open("/dev/null")?;
        spawn_shim(&reexec, &dir, &lock, (Stdio::null(), null.into())).map(Some)
    })
    .await?
}

/// Whether a guard ended the attempt.
pub(super) fn ended_it(config: &DockerConfig, id: &AttemptId) -> bool {
    AttemptDir::new(dir(config, id)).was_disconnected()
}
