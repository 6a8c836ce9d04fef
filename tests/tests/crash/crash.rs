//! A process that is to be killed at one point, and what starts it again.

use std::os::unix::process::ExitStatusExt as _;
use std::path::{Path, PathBuf};

use muster_failpoint::{Failpoint, Moment, VARIABLE};
use muster_tests::{Cluster, kernel, wait};

/// One process, killed once.
#[derive(Debug)]
pub(crate) struct Crash {
    daemon: String,
    moment: Moment,
    /// Made by the process that dies, with its number.
    file: PathBuf,
}

impl Crash {
    /// From its next start on, `daemon` or a process that it starts dies when it comes there for the n-th time.
    pub(crate) fn at(cluster: &mut Cluster, daemon: &str, moment: Moment, nth: u32) -> Crash {
        let file = cluster.dir().join(format!("{moment}.{nth}"));
        // Of a point that is come to again.
        drop(std::fs::remove_file(&file));
        let target = format!("{moment}:{nth}:{}", file.display());
        cluster.set_variable(daemon, VARIABLE, Some(&target));
        Crash { daemon: daemon.to_owned(), moment, file }
    }

    /// Waits until the process is dead, and gives its number.
    pub(crate) async fn happened(&self) -> u32 {
        wait::until(&format!("killed at {}", self.moment), async || {
            let text = std::fs::read_to_string(&self.file).map_err(|error| error.to_string())?;
            let pid = text.trim().parse().map_err(|_| format!("{text:?}"))?;
            if kernel::start_time(pid).is_some() { Err(format!("{pid} lives")) } else { Ok(pid) }
        })
        .await
    }

    /// The same for the daemon itself, which does not die again.
    pub(crate) async fn of_daemon(&self, cluster: &mut Cluster) {
        let pid = self.happened().await;
        let own = match &*self.daemon {
            "controller" => cluster.controller_pid(),
            agent => cluster.agent_pid(agent),
        };
        assert_eq!(pid, own, "{}", self.moment);
        let status = cluster.ended(&self.daemon).await;
        assert_eq!(status.signal(), Some(9), "{}: {status}", self.moment);
        cluster.set_variable(&self.daemon, VARIABLE, None);
    }

    /// Starts an agent again that was killed; who starts its other processes again is the agent.
    pub(crate) async fn nurse(&self, cluster: &mut Cluster) {
        if self.happened().await == cluster.agent_pid(&self.daemon) {
            self.of_daemon(cluster).await;
            cluster.spawn_agent(&self.daemon, None);
        }
        cluster.set_variable(&self.daemon, VARIABLE, None);
    }
}

/// Every step of each of these.
pub(crate) fn moments(points: &[Failpoint]) -> Vec<Moment> {
    let steps = |point: &Failpoint| {
        let point = *point;
        point.steps().iter().map(move |step| Moment(point, *step))
    };
    points.iter().flat_map(steps).collect()
}

/// Waits until there is no half of a file: one that was to take the place of another, or the key that a join asks with.
pub(crate) async fn nothing_half(dir: &Path) {
    let half = |path: &PathBuf| {
        let name = path.file_name().unwrap_or_default().to_string_lossy();
        name.ends_with(".tmp") || name.ends_with(".new") || name == "asked.key"
    };
    wait::until("nothing half", async || match files(dir).into_iter().find(half) {
        Some(left) => Err(left.display().to_string()),
        None => Ok(()),
    })
    .await;
}

/// Files and directories below this one.
pub(crate) fn files(dir: &Path) -> Vec<PathBuf> {
    below(dir, &|_| true)
}

/// Directories below this one.
pub(crate) fn directories(dir: &Path) -> Vec<PathBuf> {
    below(dir, &Path::is_dir)
}

fn below(dir: &Path, counts: &dyn Fn(&Path) -> bool) -> Vec<PathBuf> {
    let mut found = Vec::new();
    // What goes meanwhile is not there.
    for entry in std::fs::read_dir(dir).into_iter().flatten().flatten() {
        let path = entry.path();
        if entry.file_type().is_ok_and(|kind| kind.is_dir()) {
            found.extend(below(&path, counts));
        }
        if counts(&path) {
            found.push(path);
        }
    }
    found
}
