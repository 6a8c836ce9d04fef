//! What became of an attempt of an earlier life of the agent. The lock decides: held means that a
//! shim lives (or is between fork and its first file).

use std::path::Path;
use std::sync::Arc;
use std::time::Duration;

use muster_agent_core::observed::{End, Exit, Loss, Observed, Started};

use super::attempt::AttemptDir;
use super::{Live, ProcessRuntime, pidfd};
use crate::clock;
use crate::durable::FileError;
use crate::runtime::RuntimeError;
use crate::runtime::launch::Launch;

/// Between a fork and the shim's first files pass milliseconds; a machine that is starting up may
/// take far longer.
const LOOK_AGAIN: Duration = Duration::from_millis(5);
const PATIENCE: Duration = Duration::from_secs(30);

enum Look {
    Is(Observed),
    /// No shim lives, and nothing says how it ended.
    Lost,
    /// A shim is on its way.
    Soon,
}

pub(super) async fn find(
    runtime: &ProcessRuntime,
    launch: &Launch,
) -> Result<Observed, RuntimeError> {
    let dir = runtime.0.dir(&launch.id);
    let until = tokio::time::Instant::now() + PATIENCE;
    loop {
        match look(runtime, launch, &dir) {
            Ok(Look::Is(observed)) => return Ok(observed),
            Ok(Look::Lost) => {
                // A child of this life of the agent leaves the process table.
                runtime.reap(&launch.id).await;
                let exit = runtime.end_without_shim(&dir, launch, None).await;
                let failed = || RuntimeError::new("end what a lost shim left", "see the log");
                return exit.map(Observed::Ended).ok_or_else(failed);
            }
            Ok(Look::Soon) if tokio::time::Instant::now() < until => {
                tokio::time::sleep(LOOK_AGAIN).await;
            }
            Ok(Look::Soon) => {
                return Err(RuntimeError::new("find an attempt", "its shim says nothing"));
            }
            Err(error) => return Err(RuntimeError::new("find an attempt", error)),
        }
    }
}

fn look(runtime: &ProcessRuntime, launch: &Launch, dir: &AttemptDir) -> Result<Look, FileError> {
    if !Path::exists(dir.path()) {
        return Ok(Look::Is(Observed::NeverStarted));
    }
    // Before the record is read: a shim writes it, then lets go.
    let lock = dir.lock()?;
    if let Some(exit) = dir.exit()? {
        return Ok(Look::Is(Observed::Ended(exit)));
    }
    let begun = dir.begun()?;
    if lock.is_some() {
        let Some(begun) = begun else { return Ok(Look::Is(Observed::NeverStarted)) };
        if begun.boot_id == runtime.0.boot_id {
            return Ok(Look::Lost);
        }
        let started_at = dir.running()?.map(|running| running.at);
        return Ok(Look::Is(Observed::Ended(Exit {
            end: End::Lost(Loss::Reboot),
            oom_killed: false,
            disconnected: false,
            started_at,
            finished_at: clock::wall(),
        })));
    }
    let (Some(begun), Some(running), Some(order)) = (begun, dir.running()?, dir.order()?) else {
        return Ok(Look::Soon);
    };
    let fd = pidfd(begun.shim).map_err(FileError::at("find the shim of", dir.path()))?;
    // Gone between the look at the lock and here: the next look finds its record.
    let Some(fd) = fd else { return Ok(Look::Soon) };
    let reach = crate::shim::reach(&order, begun.shim.pid, Some(running.process.pid));
    runtime.set_live(&launch.id, Some(Live { shim: Arc::new(fd), reach }));
    Ok(Look::Is(Observed::Running(Started { at: running.at })))
}
