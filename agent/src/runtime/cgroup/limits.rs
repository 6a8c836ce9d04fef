//! Limits → kernel files, each one read back. A limit that the kernel did not take is an error: a
//! task never runs with less enforcement than it was promised.

use std::io;
use std::path::{Path, PathBuf};

use cgroups_rs::fs::MaxValue;
use cgroups_rs::fs::blkio::BlkIoController;
use cgroups_rs::fs::cpu::CpuController;
use cgroups_rs::fs::memory::MemController;
use cgroups_rs::fs::pid::PidController;

use super::Controller;
use super::device::{Disk, disk_of};
use super::group::Group;
use super::hierarchy::Version;
use crate::runtime::Limits;

/// Length of one bandwidth period. Short, because a task that used up its share stands still for
/// the rest of the period, and a control loop at 30 Hz must not notice; not shorter, because the
/// kernel hands out time in slices of 5 ms.
const PERIOD_US: u64 = 20_000;

/// The kernel takes no quota below this.
const MIN_QUOTA_US: u64 = 1_000;

/// The kernel takes no period above this.
const MAX_PERIOD_US: u64 = 1_000_000;

/// v1 weight of a task without a cpu reservation: the least there is.
const MIN_SHARES: u64 = 2;

/// Why a group could not be limited as asked.
#[derive(Debug, thiserror::Error)]
pub(crate) enum LimitError {
    #[error("the control group {name} could not be made")]
    Create {
        name: String,
        #[source]
        source: io::Error,
    },
    #[error("the kernel did not take {what} = {wanted}")]
    Write {
        what: &'static str,
        wanted: String,
        #[source]
        source: cgroups_rs::fs::error::Error,
    },
    #[error("the kernel was given {what} = {wanted} and shows {shown}")]
    NotTaken { what: &'static str, wanted: String, shown: String },
    #[error("{file} could not be used")]
    File {
        file: PathBuf,
        #[source]
        source: io::Error,
    },
    #[error("controller {0:?} is not available on this node")]
    NoController(Controller),
    #[error(
        "{dir} is on a file system without a block device of its own: an I/O rate cannot be enforced"
    )]
    NoDisk { dir: PathBuf },
}

/// Writes `limits` into a new, empty group. `disk` is a directory on the disk that I/O rates are for.
pub(super) fn apply(group: &Group, limits: &Limits, disk: &Path) -> Result<(), LimitError> {
    let v2 = group.version() == Version::V2;
    cpu(group, limits.cpu_millis, v2)?;
    if let Some(bytes) = limits.memory_bytes {
        memory(group, bytes, v2)?;
    }
    if let Some(count) = limits.pids {
        pids(group, count, v2)?;
    }
    if limits.read_bps.is_some() || limits.write_bps.is_some() {
        let Some(device) =
            disk_of(disk).map_err(|source| LimitError::File { file: disk.to_owned(), source })?
        else {
            return Err(LimitError::NoDisk { dir: disk.to_owned() });
        };
        io_rates(group, limits, device, v2)?;
    }
    Ok(())
}

/// Writes other limits into a group in use. I/O rates stay. Memory that is in use and cannot be
/// reclaimed stays allowed: nothing is killed for a limit that shrinks.
pub(super) fn resize(group: &Group, limits: &Limits) -> Result<(), LimitError> {
    let v2 = group.version() == Version::V2;
    cpu(group, limits.cpu_millis, v2)?;
    if limits.cpu_millis.is_none() {
        lift_cpu(group, v2)?;
    }
    if let Some(count) = limits.pids {
        pids(group, count, v2)?;
    }
    let Some(bytes) = limits.memory_bytes else { return Ok(()) };
    let dir = dir(group, Controller::Memory)?;
    let file = |name: &str| dir.join(name);
    if v2 {
        let what = "the memory limit";
        let used = stat(&file("memory.stat"), "anon")?;
        if used > bytes {
            let (wanted, shown) = (bytes.to_string(), format!("{used} in use"));
            return Err(LimitError::NotTaken { what, wanted, shown });
        }
        return memory(group, bytes, v2);
    }
    // Memory and swap together may never be below memory: a limit that grows, grows there first.
    let both = file("memory.memsw.limit_in_bytes");
    if both.exists() && read_number(&both)? < bytes {
        let write = std::fs::write(&both, bytes.to_string());
        write.map_err(|source| LimitError::File { file: both, source })?;
    }
    memory(group, bytes, v2)
}

fn lift_cpu(group: &Group, v2: bool) -> Result<(), LimitError> {
    let (name, text) = if v2 { ("cpu.max", "max") } else { ("cpu.cfs_quota_us", "-1") };
    let file = dir(group, Controller::Cpu)?.join(name);
    std::fs::write(&file, text).map_err(|source| LimitError::File { file, source })
}

/// A line of a `key value` file; 0 when it has none.
fn stat(file: &Path, key: &str) -> Result<u64, LimitError> {
    let text = std::fs::read_to_string(file)
        .map_err(|source| LimitError::File { file: file.to_owned(), source })?;
    let value =
        text.lines().find_map(|line| line.strip_prefix(key)?.strip_prefix(' ')?.parse().ok());
    Ok(value.unwrap_or(0))
}

/// Quota and period for a share of a core, microseconds.
pub(crate) fn bandwidth(cpu_millis: u64) -> (u64, u64) {
    let quota = cpu_millis * PERIOD_US / 1_000;
    if quota >= MIN_QUOTA_US {
        return (quota, PERIOD_US);
    }
    // A smaller share needs a longer period, up to the kernel's longest (1 millicore).
    let period = (MIN_QUOTA_US * 1_000 / cpu_millis.max(1)).min(MAX_PERIOD_US);
    (MIN_QUOTA_US, period)
}

fn cpu(group: &Group, millis: Option<u64>, v2: bool) -> Result<(), LimitError> {
    let controller = CpuController::new(dir(group, Controller::Cpu)?, PathBuf::new(), v2);
    let shares = millis.map_or(MIN_SHARES, |m| (m * 1024 / 1000).max(MIN_SHARES));
    let weight = if v2 { weight_of(shares) } else { shares };
    let what = if v2 { "cpu.weight" } else { "cpu.shares" };
    controller.set_shares(weight).map_err(write(what, weight))?;
    check(what, weight, controller.shares().map_err(write(what, weight))?)?;

    let Some(millis) = millis else { return Ok(()) };
    let (quota, period) = bandwidth(millis);
    let what = "the cpu quota";
    let signed = i64::try_from(quota).unwrap_or(i64::MAX);
    if v2 {
        controller
            .set_cfs_quota_and_period(Some(signed), Some(period))
            .map_err(write(what, quota))?;
    } else {
        // The kernel checks each file against the other: without a quota any period is taken.
        controller.set_cfs_quota(-1).map_err(write(what, quota))?;
        controller.set_cfs_period(period).map_err(write("the cpu period", period))?;
        controller.set_cfs_quota(signed).map_err(write(what, quota))?;
    }
    check(what, signed, controller.cfs_quota().map_err(write(what, quota))?)?;
    check("the cpu period", period, controller.cfs_period().map_err(write(what, period))?)
}

/// v1 shares as a v2 weight, the conversion that OCI runtimes use.
fn weight_of(shares: u64) -> u64 {
    1 + (shares.clamp(2, 262_144) - 2) * 9_999 / 262_142
}

fn memory(group: &Group, bytes: u64, v2: bool) -> Result<(), LimitError> {
    let dir = dir(group, Controller::Memory)?;
    let controller = MemController::new(dir.clone(), PathBuf::new(), v2);
    let what = "the memory limit";
    let limit = i64::try_from(bytes).unwrap_or(i64::MAX);
    controller.set_limit(limit).map_err(write(what, bytes))?;
    let file = dir.join(if v2 { "memory.max" } else { "memory.limit_in_bytes" });
    check(what, page_floor(bytes), read_number(&file)?)?;
    // Swap would make the limit soft. The files are absent on a kernel without swap accounting.
    let (swap, wanted) = if v2 {
        (dir.join("memory.swap.max"), 0)
    } else {
        (dir.join("memory.memsw.limit_in_bytes"), page_floor(bytes))
    };
    if swap.exists() {
        let value = if v2 { 0 } else { limit };
        controller.set_memswap_limit(value).map_err(write("the swap limit", wanted))?;
        check("the swap limit", wanted, read_number(&swap)?)?;
    }
    let together = dir.join("memory.oom.group");
    if v2 && together.exists() {
        // Half a program is of no use: it dies as a whole.
        std::fs::write(&together, "1")
            .map_err(|source| LimitError::File { file: together, source })?;
    }
    Ok(())
}

fn pids(group: &Group, count: u64, v2: bool) -> Result<(), LimitError> {
    let controller = PidController::new(dir(group, Controller::Pids)?, PathBuf::new(), v2);
    let what = "the limit of processes";
    let wanted = i64::try_from(count).unwrap_or(i64::MAX);
    controller.set_pid_max(MaxValue::Value(wanted)).map_err(write(what, count))?;
    match controller.get_pid_max().map_err(write(what, count))? {
        MaxValue::Value(shown) if shown == wanted => Ok(()),
        shown => {
            Err(LimitError::NotTaken { what, wanted: count.to_string(), shown: shown.to_string() })
        }
    }
}

fn io_rates(group: &Group, limits: &Limits, disk: Disk, v2: bool) -> Result<(), LimitError> {
    let dir = dir(group, Controller::Blkio)?;
    let controller = BlkIoController::new(dir.clone(), PathBuf::new(), v2);
    let Disk { major, minor } = disk;
    let device = format!("{major}:{minor}");
    if let Some(bps) = limits.read_bps {
        let what = "the read rate";
        controller.throttle_read_bps_for_device(major, minor, bps).map_err(write(what, bps))?;
        check_rate(&dir, v2, what, &device, ("rbps", "blkio.throttle.read_bps_device"), bps)?;
    }
    if let Some(bps) = limits.write_bps {
        let what = "the write rate";
        controller.throttle_write_bps_for_device(major, minor, bps).map_err(write(what, bps))?;
        check_rate(&dir, v2, what, &device, ("wbps", "blkio.throttle.write_bps_device"), bps)?;
    }
    Ok(())
}

fn check_rate(
    dir: &Path,
    v2: bool,
    what: &'static str,
    device: &str,
    (key, v1_file): (&str, &str),
    bps: u64,
) -> Result<(), LimitError> {
    let file = dir.join(if v2 { "io.max" } else { v1_file });
    let text =
        std::fs::read_to_string(&file).map_err(|source| LimitError::File { file, source })?;
    let wanted = if v2 { format!("{key}={bps}") } else { bps.to_string() };
    let line = text.lines().find_map(|line| line.strip_prefix(device)).unwrap_or_default();
    if line.split_whitespace().any(|word| word == wanted) {
        Ok(())
    } else {
        Err(LimitError::NotTaken { what, wanted, shown: line.trim().to_owned() })
    }
}

fn dir(group: &Group, controller: Controller) -> Result<PathBuf, LimitError> {
    group.dir(controller).map(Path::to_owned).ok_or(LimitError::NoController(controller))
}

fn write<T: ToString>(
    what: &'static str,
    wanted: T,
) -> impl FnOnce(cgroups_rs::fs::error::Error) -> LimitError {
    let wanted = wanted.to_string();
    move |source| LimitError::Write { what, wanted, source }
}

fn check<T: PartialEq + ToString>(
    what: &'static str,
    wanted: T,
    shown: T,
) -> Result<(), LimitError> {
    if wanted == shown {
        return Ok(());
    }
    Err(LimitError::NotTaken { what, wanted: wanted.to_string(), shown: shown.to_string() })
}

/// The kernel keeps memory limits in whole pages.
fn page_floor(bytes: u64) -> u64 {
    let page = rustix::param::page_size() as u64;
    bytes / page * page
}

fn read_number(file: &Path) -> Result<u64, LimitError> {
    let text = std::fs::read_to_string(file)
        .map_err(|source| LimitError::File { file: file.to_owned(), source })?;
    text.trim().parse().map_err(|_| LimitError::NotTaken {
        what: "a limit",
        wanted: "a number".to_owned(),
        shown: text.trim().to_owned(),
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bandwidth_keeps_the_share_and_the_kernels_bounds() {
        assert_eq!(bandwidth(500), (10_000, 20_000));
        assert_eq!(bandwidth(1_500), (30_000, 20_000));
        assert_eq!(bandwidth(10), (1_000, 100_000));
        for millis in 1..5_000_u64 {
            let (quota, period) = bandwidth(millis);
            assert!(quota >= MIN_QUOTA_US && period <= MAX_PERIOD_US, "{millis}");
            let share = quota as f64 / period as f64 * 1_000.0;
            assert!((share - millis as f64).abs() <= millis as f64 * 0.01, "{millis}: {share}");
        }
    }

    #[test]
    fn weights_span_the_range() {
        assert_eq!(weight_of(2), 1);
        assert_eq!(weight_of(262_144), 10_000);
    }
}
