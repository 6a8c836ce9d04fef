//! The clocks of this machine.

use muster_agent_core::time::{Boot, Now, Wall};

/// Time since boot, suspend included.
pub(crate) fn boot() -> Boot {
    let time = rustix::time::clock_gettime(rustix::time::ClockId::Boottime);
    Boot((time.tv_sec.unsigned_abs()) * 1_000 + time.tv_nsec.unsigned_abs() / 1_000_000)
}

/// The date.
pub(crate) fn wall() -> Wall {
    Wall(jiff::Timestamp::now().as_millisecond())
}

/// Nanoseconds since the Unix epoch, and since boot, read together.
pub(crate) fn stamp() -> (i64, u64) {
    use rustix::time::{ClockId, Timespec, clock_gettime};
    let nanos =
        |time: Timespec| time.tv_sec.saturating_mul(1_000_000_000).saturating_add(time.tv_nsec);
    let boot = nanos(clock_gettime(ClockId::Boottime));
    (nanos(clock_gettime(ClockId::Realtime)), boot.unsigned_abs())
}

pub(crate) fn now() -> Now {
    Now { boot: boot(), wall: wall() }
}

/// Which boot of the machine this is.
pub(crate) fn boot_id() -> String {
    std::fs::read_to_string("/proc/sys/kernel/random/boot_id")
        .map(|id| id.trim().to_owned())
        .unwrap_or_default()
}
