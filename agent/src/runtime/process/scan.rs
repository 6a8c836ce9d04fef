//! Facts from `/proc`.

use std::collections::{BTreeMap, BTreeSet};
use std::ffi::OsString;
use std::fs;
use std::io;
use std::os::fd::OwnedFd;
use std::os::unix::ffi::OsStringExt as _;

use super::attempt::Process;

struct Stat {
    parent: i32,
    session: i32,
    start_time: u64,
    cpu_ticks: u64,
    rss_pages: u64,
    zombie: bool,
}

fn stat(pid: i32) -> Option<Stat> {
    let text = fs::read_to_string(format!("/proc/{pid}/stat")).ok()?;
    // The name may hold spaces and brackets; fields are counted after its last bracket.
    let fields: Vec<&str> = text.get(text.rfind(')')? + 1..)?.split_whitespace().collect();
    let number = |index: usize| fields.get(index)?.parse::<u64>().ok();
    Some(Stat {
        zombie: matches!(*fields.first()?, "Z" | "X"),
        parent: fields.get(1)?.parse().ok()?,
        session: fields.get(3)?.parse().ok()?,
        cpu_ticks: number(11)? + number(12)?,
        start_time: number(19)?,
        rss_pages: number(21)?,
    })
}

/// `pid` as a process that cannot be mistaken; `None`: there is none.
pub(crate) fn process(pid: i32) -> Option<Process> {
    Some(Process { pid, start_time: stat(pid)?.start_time })
}

/// Whether exactly this process exists (a zombie does not).
pub(crate) fn is_alive(process: Process) -> bool {
    stat(process.pid).is_some_and(|stat| stat.start_time == process.start_time && !stat.zombie)
}

/// A namespace that a process is in, `net` or `ipc`.
pub(crate) fn namespace(process: Process, which: &str) -> io::Result<OwnedFd> {
    let opened = fs::File::open(format!("/proc/{}/ns/{which}", process.pid))?;
    // Looked at after it was opened: it is this process's, and not that of a later one with its number.
    match is_alive(process) {
        true => Ok(opened.into()),
        false => Err(io::Error::new(io::ErrorKind::NotFound, "it does not run")),
    }
}

fn all() -> BTreeMap<i32, Stat> {
    let entries = fs::read_dir("/proc").into_iter().flatten().flatten();
    entries
        .filter_map(|entry| entry.file_name().to_str()?.parse().ok())
        .filter_map(|pid| Some((pid, stat(pid)?)))
        .filter(|(_, stat)| !stat.zombie)
        .collect()
}

/// The living processes of an attempt that has no group: descendants of its shim (which adopts
/// orphans), those in the session of its program, and those that carry its mark in their first
/// environment.
pub(crate) fn tree(shim: i32, session: Option<i32>, mark: &str) -> BTreeSet<i32> {
    let all = all();
    let descends = |mut pid: i32| {
        // Bounded: a process table read while it changes may show a loop.
        for _ in 0..all.len() {
            match all.get(&pid) {
                Some(stat) if stat.parent == shim => return true,
                Some(stat) => pid = stat.parent,
                None => return false,
            }
        }
        false
    };
    let me = std::process::id().cast_signed();
    all.iter()
        .filter(|(pid, stat)| {
            **pid != shim
                && **pid != me
                && (descends(**pid) || session == Some(stat.session) || marked(**pid, mark))
        })
        .map(|(pid, _)| *pid)
        .collect()
}

/// The living processes of the session that this process leads.
pub(crate) fn session(leader: i32) -> BTreeSet<i32> {
    let all = all();
    all.iter().filter(|(_, stat)| stat.session == leader).map(|(pid, _)| *pid).collect()
}

fn marked(pid: i32, mark: &str) -> bool {
    let environ = fs::read(format!("/proc/{pid}/environ")).unwrap_or_default();
    environ.split(|byte| *byte == 0).any(|variable| variable == mark.as_bytes())
}

/// The environment that a process was started with; nothing of one that has ended.
pub(crate) fn variables(process: Process) -> BTreeMap<OsString, OsString> {
    let environ = fs::read(format!("/proc/{}/environ", process.pid)).unwrap_or_default();
    if !is_alive(process) {
        return BTreeMap::new();
    }
    let variables = environ.split(|byte| *byte == 0).filter_map(|variable| {
        let middle = variable.iter().position(|byte| *byte == b'=')?;
        let text = |bytes: &[u8]| OsString::from_vec(bytes.to_vec());
        Some((text(&variable[..middle]), text(&variable[middle + 1..])))
    });
    variables.collect()
}

/// Cpu time (µs) and resident memory of living processes.
pub(crate) fn usage(pids: &BTreeSet<i32>) -> (u64, u64) {
    let tick_usec = 1_000_000 / rustix::param::clock_ticks_per_second().max(1);
    let page = rustix::param::page_size() as u64;
    pids.iter().filter_map(|pid| stat(*pid)).fold((0, 0), |(cpu, memory), stat| {
        (cpu + stat.cpu_ticks * tick_usec, memory + stat.rss_pages * page)
    })
}
