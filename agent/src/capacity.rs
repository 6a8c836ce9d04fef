//! CR of this machine: what the agent may use of it (affinity, its own control group's limits), what
//! the operator caps, what the system keeps; and what the machine uses now.

use std::path::PathBuf;

use muster_api::quantity::{Bytes, MilliCpu};
use muster_api::resource::Compute;

use crate::runtime::cgroup::hierarchy::{Version, enclosing};

/// What the system and the agent need for themselves: a twentieth of the cpu, at most 100 m …
const RESERVE_CPU: (u64, u64) = (20, 100);
/// … and a tenth of the memory, at most 256 MiB. A robot's ROS master and drivers live there.
const RESERVE_MEMORY: (u64, u64) = (10, 256 << 20);

/// Capacity and what of it tasks may reserve.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Capacity {
    pub(crate) capacity: Compute,
    pub(crate) allocatable: Compute,
}

/// What this machine has for this agent.
pub(crate) fn detect(cpu_cap: Option<MilliCpu>, memory_cap: Option<Bytes>) -> Capacity {
    offer(detect_cpu(), detect_memory(), cpu_cap, memory_cap)
}

fn offer(cpu: u64, memory: u64, cpu_cap: Option<MilliCpu>, memory_cap: Option<Bytes>) -> Capacity {
    let cpu_cap = cpu_cap.map_or(u64::MAX, |cap| cap.0);
    let memory_cap = memory_cap.map_or(u64::MAX, |cap| cap.0);
    let left = |all: u64, (part, most): (u64, u64)| all - (all / part).min(most);
    Capacity {
        capacity: Compute::new(MilliCpu(cpu.min(cpu_cap)), Bytes(memory.min(memory_cap))),
        allocatable: Compute::new(
            MilliCpu(left(cpu, RESERVE_CPU).min(cpu_cap)),
            Bytes(left(memory, RESERVE_MEMORY).min(memory_cap)),
        ),
    }
}

/// Millicores: processors that the agent may run on, and the quotas of the groups it is in.
fn detect_cpu() -> u64 {
    // Counts online processors within the affinity mask.
    let mut millis =
        std::thread::available_parallelism().map_or(1, std::num::NonZero::get) as u64 * 1_000;
    let (version, dirs) = enclosing("cpu");
    for dir in dirs {
        let quota = match version {
            Version::V1 => {
                let number = |file| read(dir.join(file))?.trim().parse::<i64>().ok();
                number("cpu.cfs_quota_us").zip(number("cpu.cfs_period_us"))
            }
            Version::V2 => read(dir.join("cpu.max")).and_then(|text| {
                let (quota, period) = text.trim().split_once(' ')?;
                Some((quota.parse().ok()?, period.parse().ok()?))
            }),
        };
        if let Some((quota, period)) = quota
            && quota > 0
            && period > 0
        {
            millis = millis.min(quota.unsigned_abs() * 1_000 / period.unsigned_abs());
        }
    }
    millis
}

fn detect_memory() -> u64 {
    let mut bytes = meminfo("MemTotal").unwrap_or(0);
    let (version, dirs) = enclosing("memory");
    let file = match version {
        Version::V1 => "memory.limit_in_bytes",
        Version::V2 => "memory.max",
    };
    for dir in dirs {
        // "max" is no number, and no limit.
        if let Some(limit) = read(dir.join(file)).and_then(|text| text.trim().parse().ok()) {
            bytes = bytes.min(limit);
        }
    }
    bytes
}

fn read(path: PathBuf) -> Option<String> {
    std::fs::read_to_string(path).ok()
}

fn meminfo(key: &str) -> Option<u64> {
    let text = read("/proc/meminfo".into())?;
    let line = text.lines().find_map(|line| line.strip_prefix(key)?.strip_prefix(':'))?;
    Some(line.trim().strip_suffix("kB")?.trim().parse::<u64>().ok()? * 1024)
}

/// The machine's usage, between two looks.
#[derive(Debug, Default)]
pub(crate) struct Machine {
    before: Option<(u64, u64)>,
}

impl Machine {
    /// Mean millicores since the last look, and memory that is not available.
    pub(crate) fn sample(&mut self) -> Option<(u64, u64)> {
        let text = read("/proc/stat".into())?;
        let fields: Vec<u64> = text
            .lines()
            .next()?
            .split_whitespace()
            .skip(1)
            .filter_map(|field| field.parse().ok())
            .collect();
        // user nice system idle iowait irq softirq steal; guest time is within user.
        let all: u64 = fields.iter().take(8).sum();
        let idle = fields.get(3)? + fields.get(4)?;
        let now = (all, all - idle);
        let before = self.before.replace(now).unwrap_or((0, 0));
        let cores = text.lines().filter(|line| line.starts_with("cpu")).count().max(2) as u64 - 1;
        let millis = (now.1 - before.1.min(now.1)) * cores * 1_000 / (now.0 - before.0).max(1);
        let memory = meminfo("MemTotal")?.saturating_sub(meminfo("MemAvailable")?);
        Some((millis, memory))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn caps_bound_what_is_offered() {
        let plain = offer(2_000, 4 << 30, None, None);
        assert_eq!(plain.capacity.cpu, MilliCpu(2_000));
        assert_eq!(plain.allocatable.cpu, MilliCpu(1_900));
        assert_eq!(plain.allocatable.memory, Bytes((4 << 30) - (256 << 20)));
        let capped = offer(2_000, 4 << 30, Some(MilliCpu(1_500)), Some(Bytes(1 << 30)));
        assert_eq!(capped.capacity, capped.allocatable);
        assert_eq!(capped.allocatable.cpu, MilliCpu(1_500));
        let small = offer(1_000, 512 << 20, Some(MilliCpu(9_000)), None);
        assert_eq!(small.allocatable.cpu, MilliCpu(950));
    }

    #[test]
    fn this_machine_has_something() {
        let found = detect(None, None);
        assert!(found.capacity.cpu.0 >= 100 && found.capacity.memory.0 > 64 << 20, "{found:?}");
        let mut machine = Machine::default();
        assert!(machine.sample().is_some_and(|(_, memory)| memory > 0));
    }
}
