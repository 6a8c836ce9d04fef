//! A program's output, from its pipes to rotated files.
//!
//! One line of a file is `2026-01-31T12:00:00.000000000Z stdout F text`, the format that container
//! runtimes use: time, stream, `F` for a full line or `P` for a part of one, text.

use std::fs::{self, File, OpenOptions};
use std::io::{self, Write};
use std::os::fd::{AsFd, BorrowedFd, OwnedFd};
use std::os::unix::fs::OpenOptionsExt;
use std::path::PathBuf;

use rustix::io::Errno;

use crate::runtime::process::attempt::LogBounds;

/// A longer line is cut into parts, so that a program that never ends a line cannot fill memory.
const LONGEST_LINE: usize = 16 << 10;

/// What is read at once: the size of a pipe.
const CHUNK: usize = 64 << 10;

/// The files of one attempt: `log` is the newest, `log.1` the one before it.
#[derive(Debug)]
pub(super) struct Log {
    path: PathBuf,
    bounds: LogBounds,
    file: Option<File>,
    size: u64,
}

impl Log {
    /// A log that cannot be opened is tried again at every write: output is lost meanwhile, the
    /// program is not.
    pub(super) fn open(path: PathBuf, bounds: LogBounds) -> Log {
        let mut log = Log { path, bounds, file: None, size: 0 };
        log.reopen();
        log
    }

    fn reopen(&mut self) {
        let file = OpenOptions::new().append(true).create(true).mode(0o600).open(&self.path);
        self.file = file.ok();
        let metadata = self.file.as_ref().and_then(|file| file.metadata().ok());
        self.size = metadata.map_or(0, |metadata| metadata.len());
    }

    fn write(&mut self, bytes: &[u8]) {
        if self.file.is_none() {
            self.reopen();
        }
        if self.size > 0 && self.size + bytes.len() as u64 > self.bounds.bytes {
            self.rotate();
        }
        let Some(file) = &mut self.file else { return };
        match file.write_all(bytes) {
            Ok(()) => self.size += bytes.len() as u64,
            // A full disk must not stop a robot: the output is lost.
            Err(_) => self.file = None,
        }
    }

    fn rotate(&mut self) {
        let name = |n: u32| match n {
            0 => self.path.clone(),
            n => self.path.with_extension(n.to_string()),
        };
        let last = self.bounds.files.max(1) - 1;
        if last == 0 {
            let _ = fs::remove_file(name(0));
        }
        for n in (0..last).rev() {
            let _ = fs::rename(name(n), name(n + 1));
        }
        self.reopen();
    }
}

/// One stream of the program.
#[derive(Debug)]
pub(super) struct Pump {
    fd: Option<OwnedFd>,
    stream: &'static str,
    /// The beginning of a line whose end has not come yet.
    line: Vec<u8>,
    buffer: Vec<u8>,
}

impl Pump {
    pub(super) fn new(fd: OwnedFd, stream: &'static str) -> io::Result<Pump> {
        rustix::io::ioctl_fionbio(&fd, true)?;
        Ok(Pump { fd: Some(fd), stream, line: Vec::new(), buffer: Vec::new() })
    }

    pub(super) fn fd(&self) -> Option<BorrowedFd<'_>> {
        self.fd.as_ref().map(AsFd::as_fd)
    }

    /// Takes what is there, without waiting.
    pub(super) fn drain(&mut self, log: &mut Log) {
        // Allocated at the first output: most of a fleet's tasks are silent most of the time.
        self.buffer.resize(CHUNK, 0);
        while let Some(fd) = &self.fd {
            match rustix::io::read(fd, &mut self.buffer) {
                Ok(0) => self.fd = None,
                Ok(size) => {
                    let taken = std::mem::take(&mut self.buffer);
                    self.take(&taken[..size], log);
                    self.buffer = taken;
                }
                Err(Errno::INTR) => {}
                Err(Errno::AGAIN) => break,
                Err(_) => self.fd = None,
            }
        }
        self.buffer.truncate(0);
        self.buffer.shrink_to_fit();
    }

    fn take(&mut self, mut bytes: &[u8], log: &mut Log) {
        let stamp = format!("{:.9} {}", jiff::Timestamp::now(), self.stream);
        let mut out = Vec::with_capacity(bytes.len() + 64);
        while !bytes.is_empty() {
            let end = bytes.iter().position(|byte| *byte == b'\n');
            let room = LONGEST_LINE - self.line.len();
            match end {
                Some(end) if end <= room => {
                    self.line.extend_from_slice(&bytes[..end]);
                    bytes = &bytes[end + 1..];
                    put(&mut out, &stamp, b'F', &mut self.line);
                }
                None if bytes.len() < room => {
                    self.line.extend_from_slice(bytes);
                    bytes = &[];
                }
                _ => {
                    self.line.extend_from_slice(&bytes[..room]);
                    bytes = &bytes[room..];
                    put(&mut out, &stamp, b'P', &mut self.line);
                }
            }
            // Rotation looks between writes: one must not be much larger than a line.
            if out.len() >= LONGEST_LINE {
                log.write(&out);
                out.clear();
            }
        }
        if !out.is_empty() {
            log.write(&out);
        }
    }

    /// Writes the last line of a program that did not end it.
    pub(super) fn finish(&mut self, log: &mut Log) {
        if !self.line.is_empty() {
            let stamp = format!("{:.9} {}", jiff::Timestamp::now(), self.stream);
            let mut out = Vec::new();
            put(&mut out, &stamp, b'P', &mut self.line);
            log.write(&out);
        }
    }
}

fn put(out: &mut Vec<u8>, stamp: &str, tag: u8, line: &mut Vec<u8>) {
    out.extend_from_slice(stamp.as_bytes());
    out.extend_from_slice(&[b' ', tag, b' ']);
    out.append(line);
    out.push(b'\n');
}

#[cfg(test)]
mod tests {
    use super::*;

    fn pump() -> Pump {
        let (read, _write) = rustix::pipe::pipe().unwrap();
        Pump::new(read, "stdout").unwrap()
    }

    #[test]
    fn lines_parts_and_rotation() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("log");
        let mut log = Log::open(path.clone(), LogBounds { bytes: 20 << 10, files: 2 });
        let mut pump = pump();
        pump.take(b"one\ntw", &mut log);
        pump.take(b"o\n", &mut log);
        let text = fs::read_to_string(&path).unwrap();
        let lines: Vec<&str> = text.lines().collect();
        assert!(lines[0].ends_with("Z stdout F one") && lines[1].ends_with("Z stdout F two"));
        pump.take(&vec![b'x'; LONGEST_LINE + 5], &mut log);
        pump.finish(&mut log);
        let first = fs::read_to_string(&path).unwrap();
        assert!(first.lines().nth(2).unwrap().contains(" P xxx"));
        for _ in 0..4 {
            pump.take(&[&[b'y'; LONGEST_LINE - 1][..], b"\n"].concat(), &mut log);
        }
        let mut names: Vec<_> =
            fs::read_dir(dir.path()).unwrap().map(|e| e.unwrap().file_name()).collect();
        names.sort();
        assert_eq!(names, ["log", "log.1"]);
        assert!(fs::metadata(&path).unwrap().len() <= 20 << 10);
    }
}
