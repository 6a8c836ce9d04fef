//! A group's share of the cpu, from the kernel's own accounts (cgroup v1).

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use super::until;

/// How far from its quota a spinning task may be found, cores.
const BAR: f64 = 0.03;

/// Thirty periods of the engine's quota: the one that is cut in two at each end is lost in the bar.
const WINDOW: Duration = Duration::from_secs(3);

/// A sleep of a few milliseconds that took longer than this: the machine stood meanwhile.
const STANDS: Duration = Duration::from_millis(50);

/// How much of that there may be in a window: of a task at half a core it takes half of what the bar allows.
const STOOD_AT_MOST: Duration = Duration::from_millis(100);

/// Where the accounts of a group are.
pub struct Accounts {
    pub cpuacct: PathBuf,
    pub cpu: PathBuf,
}

/// What they say.
struct Account {
    used: Duration,
    /// Periods of the quota in which it ran.
    ran: u64,
    /// Of these, those in which it came to its quota.
    full: u64,
}

impl Accounts {
    /// Those of the group that a process is in.
    pub fn of(pid: i32) -> Accounts {
        let text = std::fs::read_to_string(format!("/proc/{pid}/cgroup")).unwrap();
        let dir = |controller: &str| {
            let mut lines = text.lines().map(|line| line.splitn(3, ':').collect::<Vec<_>>());
            let line = lines.find(|line| line[1].split(',').any(|have| have == controller));
            let line = line.unwrap();
            PathBuf::from(format!("/sys/fs/cgroup/{}{}", line[1], line[2]))
        };
        Accounts { cpuacct: dir("cpuacct"), cpu: dir("cpu") }
    }

    fn read(&self) -> Account {
        let nanos = std::fs::read_to_string(self.cpuacct.join("cpuacct.usage")).unwrap();
        let text = std::fs::read_to_string(self.cpu.join("cpu.stat")).unwrap();
        let stat: BTreeMap<&str, &str> =
            text.lines().filter_map(|line| line.split_once(' ')).collect();
        Account {
            used: Duration::from_nanos(nanos.trim().parse().unwrap()),
            ran: stat["nr_periods"].parse().unwrap(),
            full: stat["nr_throttled"].parse().unwrap(),
        }
    }

    /// A task that spins gets `cores`, no more in any window, and no less in one in which the rest of
    /// the machine lets it: then the kernel stopped it at its quota in (nearly) every period.
    #[track_caller]
    pub fn assert_share(&self, cores: f64) {
        until("a window in which the task was not starved", || {
            let (before, first, begun) = (Instant::now(), self.read(), Instant::now());
            let stood = wait_until(begun + WINDOW);
            let (ended, second, after) = (Instant::now(), self.read(), Instant::now());
            // When between its two instants an account was read is not known.
            let used = (second.used - first.used).as_secs_f64();
            let least = used / (after - before).as_secs_f64();
            let most = used / (ended - begun).as_secs_f64();
            let (ran, full) = (second.ran - first.ran, second.full - first.full);
            let said =
                format!("{least:.3} to {most:.3} cores, at the quota in {full} of {ran} periods");
            assert!(least <= cores + BAR, "{said}");
            let starved = stood > STOOD_AT_MOST || (ran - full.min(ran)) * 30 > ran;
            assert!(starved || most >= cores - BAR, "{said}");
            (most >= cores - BAR).then_some(())
        });
    }
}

/// Waits, and says for how long the machine stood: nobody ran then, and the kernel still counts a period at its quota.
fn wait_until(end: Instant) -> Duration {
    let mut stood = Duration::ZERO;
    while Instant::now() < end {
        let slept = Instant::now();
        std::thread::sleep(Duration::from_millis(5));
        let gap = slept.elapsed();
        if gap > STANDS {
            stood += gap;
        }
    }
    stood
}

/// Lets a group weigh as much as the machine; dropped: as much as before. The engine's own group weighs
/// like one process of the host, and beside a build its containers would not come to their quotas.
pub struct Heavy {
    file: PathBuf,
    before: String,
}

impl Heavy {
    pub fn new(group: &Path) -> Heavy {
        let file = group.join("cpu.shares");
        let before = std::fs::read_to_string(&file).unwrap();
        std::fs::write(&file, "262144").unwrap();
        Heavy { file, before }
    }
}

impl Drop for Heavy {
    fn drop(&mut self) {
        let _ = std::fs::write(&self.file, &self.before);
    }
}
