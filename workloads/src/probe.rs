//! Programs that do one thing, for tests of quotas, of the end of tasks and of exit codes.

use std::fs::{File, OpenOptions};
use std::io::{Read, Seek, Write};
use std::os::unix::fs::OpenOptionsExt;
use std::path::PathBuf;
use std::process::Command;
use std::time::{Duration, Instant};

use serde_json::json;

use super::clock::{Stop, cpu_time, listen};
use super::run::rounded;
use crate::exit;

/// Flags of `muster workload spin`.
#[derive(Debug, clap::Args)]
pub(super) struct Spin {
    /// Threads that spin
    #[arg(long, value_name = "N", default_value_t = 1)]
    threads: u32,
    /// End after this long, 10s; default: never
    #[arg(long, value_name = "TIME", value_parser = span)]
    duration: Option<Duration>,
}

/// Flags of `muster workload allocate`.
#[derive(Debug, clap::Args)]
pub(super) struct Allocate {
    /// Mebibytes to touch
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=1 << 20))]
    mib: u32,
}

/// Flags of `muster workload ignore-term`.
#[derive(Debug, clap::Args)]
pub(super) struct IgnoreTerm {
    /// Without the child
    #[arg(long)]
    alone: bool,
}

/// Flags of `muster workload exit`.
#[derive(Debug, clap::Args)]
pub(super) struct Exit {
    /// How long it runs, 2s
    #[arg(long, value_name = "TIME", default_value = "0s", value_parser = span)]
    after: Duration,
    /// The exit code
    #[arg(long, value_name = "N", default_value_t = 0)]
    code: u8,
}

/// Flags of `muster workload io`.
#[derive(Debug, clap::Args)]
pub(super) struct Io {
    /// Mebibytes to write and to read
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=1 << 20))]
    mib: u32,
    /// The file; removed at the end
    #[arg(long, value_name = "FILE", default_value = "muster-io")]
    file: PathBuf,
    /// Through the page cache: quotas of cgroup v1 do not count such writes
    #[arg(long)]
    buffered: bool,
}

/// Parses `2s`, `500ms`, `1m`, or a number of seconds.
fn span(text: &str) -> Result<Duration, String> {
    let (digits, scale) = if let Some(digits) = text.strip_suffix("ms") {
        (digits, 1e-3)
    } else if let Some(digits) = text.strip_suffix('s') {
        (digits, 1.0)
    } else if let Some(digits) = text.strip_suffix('m') {
        (digits, 60.0)
    } else {
        (text, 1.0)
    };
    let seconds = digits.parse::<f64>().ok().filter(|n| *n >= 0.0);
    seconds
        .and_then(|n| Duration::try_from_secs_f64(n * scale).ok())
        .ok_or_else(|| "not a time; try 2s or 500ms".to_owned())
}

fn say(value: &serde_json::Value) {
    // Nobody has to read it.
    let _ = writeln!(std::io::stdout().lock(), "{value}");
}

pub(super) fn spin(args: &Spin) -> u8 {
    let end = args.duration.map(|d| Instant::now() + d);
    let spinning = move || {
        while end.is_none_or(|end| Instant::now() < end) {
            for _ in 0..100_000 {
                std::hint::spin_loop();
            }
        }
    };
    let others: Vec<_> = (1..args.threads).map(|_| std::thread::spawn(spinning)).collect();
    spinning();
    for other in others {
        // A thread that spins does not panic.
        let _ = other.join();
    }
    say(&json!({"workload": "spin", "cpu_seconds": cpu_time().as_secs_f64()}));
    exit::OK
}

/// The kernel gives memory by pages of at least this many bytes.
const PAGE: usize = 4096;

pub(super) fn allocate(args: &Allocate) -> u8 {
    let stop = Stop::on_signals();
    let mut memory: Vec<Vec<u8>> = Vec::new();
    for done in 1..=args.mib {
        let mut block = vec![0_u8; 1 << 20];
        // Zeroed memory is not there before it is written to.
        block.iter_mut().step_by(PAGE).for_each(|byte| *byte = 1);
        memory.push(block);
        if done % 16 == 0 || done == args.mib {
            say(&json!({"workload": "allocate", "mib": done}));
        }
    }
    stop.wait();
    drop(std::hint::black_box(memory));
    exit::OK
}

pub(super) fn ignore_term(args: &IgnoreTerm) -> u8 {
    let child = if args.alone { None } else { spawn_child() };
    let (listening, ready) = std::sync::mpsc::channel();
    let pid = std::process::id();
    std::thread::spawn(move || {
        let _ = ready.recv();
        let child = child.map(|child| child.id());
        say(&json!({"workload": "ignore-term", "pid": pid, "child": child, "ready": true}));
    });
    listen(&listening, |signal| {
        say(&json!({"workload": "ignore-term", "pid": pid, "ignored": signal}));
        false
    });
    // Only reached when signals cannot be listened to.
    exit::FAILURE
}

fn spawn_child() -> Option<std::process::Child> {
    let program = std::env::current_exe().ok()?;
    let spawned = Command::new(program).args(["workload", "ignore-term", "--alone"]).spawn();
    spawned.inspect_err(|error| eprintln!("error: no child: {error}")).ok()
}

pub(super) fn exit(args: &Exit) -> u8 {
    std::thread::sleep(args.after);
    args.code
}

pub(super) fn io(args: &Io) -> u8 {
    match write_and_read(args) {
        Ok((write, read, direct)) => {
            let speed = |time: Duration| rounded(f64::from(args.mib) / time.as_secs_f64(), 2);
            say(&json!({
                "workload": "io", "mib": args.mib, "direct": direct,
                "write_seconds": write.as_secs_f64(), "write_mib_per_s": speed(write),
                "read_seconds": read.as_secs_f64(), "read_mib_per_s": speed(read),
            }));
            exit::OK
        }
        Err(error) => {
            eprintln!("error: {}: {error}", args.file.display());
            exit::FAILURE
        }
    }
}

/// Disks want whole blocks of memory at whole blocks of addresses for what passes the cache by.
const ALIGNMENT: usize = 4096;
const CHUNK: usize = 1 << 20;

fn write_and_read(args: &Io) -> std::io::Result<(Duration, Duration, bool)> {
    let mut memory = vec![0x5a_u8; CHUNK + ALIGNMENT];
    let offset = memory.as_ptr().align_offset(ALIGNMENT);
    let chunk = &mut memory[offset..offset + CHUNK];
    let (mut file, direct) = open(args)?;
    let done = pass(args.mib, &mut file, chunk);
    drop(file);
    std::fs::remove_file(&args.file)?;
    done.map(|(write, read)| (write, read, direct))
}

fn pass(mib: u32, file: &mut File, chunk: &mut [u8]) -> std::io::Result<(Duration, Duration)> {
    let begin = Instant::now();
    for _ in 0..mib {
        file.write_all(chunk)?;
    }
    file.sync_data()?;
    let write = begin.elapsed();
    file.rewind()?;
    let begin = Instant::now();
    for _ in 0..mib {
        file.read_exact(chunk)?;
    }
    Ok((write, begin.elapsed()))
}

/// Past the page cache where the file system can do that (tmpfs cannot).
fn open(args: &Io) -> std::io::Result<(File, bool)> {
    let mut options = OpenOptions::new();
    options.read(true).write(true).create(true).truncate(true);
    if !args.buffered {
        let direct = rustix::fs::OFlags::DIRECT.bits().cast_signed();
        if let Ok(file) = options.clone().custom_flags(direct).open(&args.file) {
            return Ok((file, true));
        }
    }
    Ok((options.open(&args.file)?, false))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn times_have_units() {
        for (text, millis) in [("2s", 2000), ("500ms", 500), ("1m", 60_000), ("1.5", 1500)] {
            assert_eq!(span(text), Ok(Duration::from_millis(millis)), "{text}");
        }
        assert!(span("-1s").is_err() && span("soon").is_err());
    }

    #[test]
    fn a_file_is_written_and_read() {
        let file = std::env::temp_dir().join(format!("muster-io-{}", std::process::id()));
        let args = Io { mib: 2, file: file.clone(), buffered: false };
        write_and_read(&args).unwrap();
        assert!(!file.exists());
    }
}
