//! What the kernel says of processes, independent of what muster says.

use std::fs;
use std::time::Duration;

use rustix::process::{Pid, Signal, kill_process};

/// A process, told from a later one with the same number by when it started.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub struct Process {
    /// Its number.
    pub pid: u32,
    /// When it started, clock ticks since boot.
    pub start: u64,
}

/// Every process whose environment holds `NAME=value`, the oldest first. Tasks are found by `MUSTER_UID`.
#[must_use]
pub fn with_env(name: &str, value: &str) -> Vec<Process> {
    let wanted = format!("{name}={value}");
    let mut found = Vec::new();
    for entry in fs::read_dir("/proc").expect("procfs is mounted").flatten() {
        let Some(pid) = entry.file_name().to_str().and_then(|n| n.parse::<u32>().ok()) else {
            continue;
        };
        // A process may end between the listing and the reading; then it is not there.
        let Ok(environment) = fs::read(format!("/proc/{pid}/environ")) else { continue };
        if environment.split(|b| *b == 0).any(|var| var == wanted.as_bytes())
            && let Some(start) = start_time(pid)
        {
            found.push(Process { pid, start });
        }
    }
    // Numbers wrap: an older process may have the larger one.
    found.sort_by_key(|process| (process.start, process.pid));
    found
}

/// Freezes a process (SIGSTOP) or lets it go on (SIGCONT).
///
/// # Panics
///
/// When there is no such process.
pub fn freeze(pid: u32, frozen: bool) {
    signal(pid, if frozen { Signal::STOP } else { Signal::CONT });
}

/// Interrupts a process (SIGINT), as Ctrl-C does.
///
/// # Panics
///
/// When there is no such process.
pub fn interrupt(pid: u32) {
    signal(pid, Signal::INT);
}

fn signal(pid: u32, signal: Signal) {
    let pid = i32::try_from(pid).ok().and_then(Pid::from_raw).expect("a process number");
    kill_process(pid, signal).expect("it is there");
}

/// Ends a process at once (SIGKILL); one that is gone already is no fault.
pub fn kill(pid: u32) {
    use rustix::process::{Pid, Signal, kill_process};
    if let Some(pid) = i32::try_from(pid).ok().and_then(Pid::from_raw) {
        let _ = kill_process(pid, Signal::KILL);
    }
}

/// When a live process started; none for one that is gone or a zombie.
#[must_use]
pub fn start_time(pid: u32) -> Option<u64> {
    let stat = fs::read_to_string(format!("/proc/{pid}/stat")).ok()?;
    // The name is in parentheses and may hold spaces; fields count from after it.
    let fields: Vec<&str> = stat.rsplit_once(')')?.1.split_whitespace().collect();
    if fields.first() == Some(&"Z") { None } else { fields.get(19)?.parse().ok() }
}

/// Processes whose command line holds `text`.
#[must_use]
pub fn with_command(text: &str) -> Vec<u32> {
    let mut found = Vec::new();
    for entry in fs::read_dir("/proc").expect("procfs is mounted").flatten() {
        let Some(pid) = entry.file_name().to_str().and_then(|n| n.parse::<u32>().ok()) else {
            continue;
        };
        let Ok(command) = fs::read(format!("/proc/{pid}/cmdline")) else { continue };
        if String::from_utf8_lossy(&command).contains(text) {
            found.push(pid);
        }
    }
    found
}

/// Cpu time that the cgroup (v1 `cpuacct` or v2) of a process has used.
#[must_use]
pub fn cgroup_cpu_time(pid: u32) -> Option<Duration> {
    let cgroups = fs::read_to_string(format!("/proc/{pid}/cgroup")).ok()?;
    for line in cgroups.lines() {
        let mut parts = line.splitn(3, ':');
        let (_, controllers, path) = (parts.next()?, parts.next()?, parts.next()?);
        if controllers.split(',').any(|c| c == "cpuacct") {
            let root = if controllers == "cpuacct" {
                "/sys/fs/cgroup/cpuacct".to_owned()
            } else {
                format!("/sys/fs/cgroup/{controllers}")
            };
            let usage = fs::read_to_string(format!("{root}{path}/cpuacct.usage")).ok()?;
            return Some(Duration::from_nanos(usage.trim().parse().ok()?));
        }
        if controllers.is_empty()
            && let Ok(stat) = fs::read_to_string(format!("/sys/fs/cgroup{path}/cpu.stat"))
        {
            let usec = stat.lines().find_map(|l| l.strip_prefix("usage_usec "))?;
            return Some(Duration::from_micros(usec.trim().parse().ok()?));
        }
    }
    None
}
