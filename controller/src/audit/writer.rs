//! The thread that writes lines, so that nobody else waits for a disk: not the runtime, and not the scheduler's loop.
//!
//! It has the files to itself. Lines come in the order in which they were queued, and whoever wants to know hears what came of
//! theirs. How many lines are missing is kept in a file that has its full length from the first moment on, so that it can be
//! written also when the disk is full.

use std::fs::{DirBuilder, File, OpenOptions};
use std::io::{self, Read as _, Seek as _, SeekFrom, Write as _};
use std::os::unix::fs::{DirBuilderExt as _, FileExt as _, OpenOptionsExt as _};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::thread::JoinHandle;

use jiff::Timestamp;
use muster_failpoint::{Failpoint, Step, reach};
use serde::Serialize;
use tokio::sync::{mpsc, oneshot};

use super::{Line, Shared};

/// What was asked of the thread.
pub(super) enum Job {
    /// To write a line.
    Line { line: Box<Line>, answer: Option<oneshot::Sender<io::Result<()>>> },
    /// To see to it that lines can be written.
    Open { now: Timestamp, answer: oneshot::Sender<io::Result<()>> },
}

/// Files of lines: the present one, and numbered ones before it.
#[derive(Debug, Clone, Copy)]
pub(super) struct Bound {
    pub(super) name: &'static str,
    /// Bytes of a file, about.
    pub(super) bytes: u64,
    /// Files that are kept, the present one included.
    pub(super) files: u32,
}

/// Lines that are missing before this one.
#[derive(Serialize)]
struct Gap {
    time: Timestamp,
    missing: u64,
}

/// What the thread has.
#[derive(Debug)]
pub(super) struct Writer {
    dir: PathBuf,
    done: Log,
    refused: Log,
    missing: Missing,
    shared: Arc<Shared>,
    /// Of the last full file.
    syncing: Option<JoinHandle<()>>,
}

impl Writer {
    pub(super) fn new(dir: PathBuf, (done, refused): (Bound, Bound), shared: Arc<Shared>) -> Self {
        let missing = Missing::beside(&dir);
        let log = |bound| Log { dir: dir.clone(), bound, open: None };
        Self { done: log(done), refused: log(refused), missing, shared, syncing: None, dir }
    }

    /// Until nobody can ask for anything any more.
    pub(super) fn run(mut self, mut jobs: mpsc::Receiver<Job>) {
        while let Some(job) = jobs.blocking_recv() {
            self.take(job);
        }
        if let Some(syncing) = self.syncing.take() {
            drop(syncing.join());
        }
    }

    /// Does what was asked.
    pub(super) fn take(&mut self, job: Job) {
        self.missing.add(self.shared.lost.swap(0, Ordering::Relaxed));
        let (full, answer, outcome) = match job {
            Job::Open { now, answer } => (None, Some(answer), self.open(now)),
            Job::Line { line, answer } => {
                let (full, written) = self.write(*line);
                (full, answer, written)
            }
        };
        if let Some(answer) = answer {
            // Who asked may have left.
            drop(answer.send(outcome));
        }
        if let Some(full) = full {
            self.sync(full);
        }
    }

    fn open(&mut self, now: Timestamp) -> io::Result<()> {
        let opened = self.done.open().map(drop).and_then(|()| self.tell_missing(now));
        self.shared.can_write.store(opened.is_ok(), Ordering::Relaxed);
        opened
    }

    /// The file that is full now, and what came of the line.
    fn write(&mut self, line: Line) -> (Option<File>, io::Result<()>) {
        let (now, refused) = (line.time, line.is_refused());
        let mut full = None;
        let written = bytes_of(&line.bounded()).and_then(|bytes| match refused {
            true => self.refused.append(&bytes, &mut full),
            false => {
                self.open(now)?;
                reach(Failpoint::AuditLine, Step::Before);
                let written = self.done.append(&bytes, &mut full);
                reach(Failpoint::AuditLine, Step::After);
                written
            }
        });
        if let Err(error) = &written {
            self.missing.add(1);
            if !refused {
                self.shared.can_write.store(false, Ordering::Relaxed);
            }
            metrics::counter!("muster_audit_failures_total").increment(1);
            tracing::error!(error = error as &dyn std::error::Error, dir = %self.dir.display(), "a line of the audit log cannot be written: until it can, nothing is done that does not stop or take away");
        }
        (full, written)
    }

    fn tell_missing(&mut self, now: Timestamp) -> io::Result<()> {
        if self.missing.count == 0 {
            return Ok(());
        }
        let gap = bytes_of(&Gap { time: now, missing: self.missing.count })?;
        self.done.open()?.append(&gap)?;
        self.missing.set(0);
        Ok(())
    }

    /// Syncs a file that is full, while lines are written to the next one. One at a time: who fills a file before the last one
    /// is on the disk waits for it.
    fn sync(&mut self, full: File) {
        if let Some(before) = self.syncing.take() {
            drop(before.join());
        }
        let sync = move || {
            if let Err(error) = full.sync_data() {
                tracing::warn!(
                    error = &error as &dyn std::error::Error,
                    "a full audit file is not synced"
                );
            }
        };
        self.syncing = std::thread::Builder::new().name("audit-sync".to_owned()).spawn(sync).ok();
    }
}

fn bytes_of<T: Serialize>(line: &T) -> io::Result<Vec<u8>> {
    let mut bytes = serde_json::to_vec(line)?;
    bytes.push(b'\n');
    Ok(bytes)
}

#[derive(Debug)]
struct Log {
    dir: PathBuf,
    bound: Bound,
    /// None: it was not opened yet, or a line could not be written.
    open: Option<Open>,
}

impl Log {
    fn open(&mut self) -> io::Result<&mut Open> {
        let open = match self.open.take() {
            Some(open) => open,
            None => Open::at(&self.dir, self.bound.name)?,
        };
        Ok(self.open.insert(open))
    }

    fn append(&mut self, bytes: &[u8], full: &mut Option<File>) -> io::Result<()> {
        let limit = self.bound.bytes;
        let open = self.open()?;
        if open.size > 0 && open.size + bytes.len() as u64 > limit {
            *full = self.open.take().map(|open| open.file);
            self.rotate()?;
        }
        let written = self.open()?.append(bytes);
        if written.is_err() {
            self.open = None;
        }
        written
    }

    /// Gives every file the next number; the last one goes. Where a number is free, as after a crash in the middle of this, no
    /// file behind it is moved.
    fn rotate(&self) -> io::Result<()> {
        reach(Failpoint::AuditRotation, Step::Before);
        let last = self.bound.files - 1;
        let mut free = 1;
        while free < last && self.numbered(free).try_exists()? {
            free += 1;
        }
        for number in (0..free).rev() {
            if number == 0 {
                reach(Failpoint::AuditRotation, Step::Half);
            }
            match std::fs::rename(self.numbered(number), self.numbered(number + 1)) {
                // Somebody has taken it away.
                Err(error) if error.kind() != io::ErrorKind::NotFound => return Err(error),
                _ => {}
            }
        }
        reach(Failpoint::AuditRotation, Step::After);
        Ok(())
    }

    fn numbered(&self, number: u32) -> PathBuf {
        let name = self.bound.name;
        match number {
            0 => self.dir.join(name),
            _ => self.dir.join(format!("{name}.{number}")),
        }
    }
}

#[derive(Debug)]
struct Open {
    file: File,
    size: u64,
}

impl Open {
    fn at(dir: &Path, name: &str) -> io::Result<Self> {
        DirBuilder::new().recursive(true).mode(0o700).create(dir)?;
        let mut options = OpenOptions::new();
        options.read(true).append(true).create(true).mode(0o600);
        let mut file = options.open(dir.join(name))?;
        let size = file.seek(SeekFrom::End(0))?;
        let mut open = Self { file, size };
        if !open.ends_whole()? {
            // The machine stopped in the middle of a line; the next one begins anew.
            open.append(b"\n")?;
        }
        Ok(open)
    }

    fn ends_whole(&mut self) -> io::Result<bool> {
        if self.size == 0 {
            return Ok(true);
        }
        let mut last = [0];
        self.file.seek(SeekFrom::End(-1))?;
        self.file.read_exact(&mut last)?;
        Ok(last == *b"\n")
    }

    /// All of it, or nothing.
    fn append(&mut self, bytes: &[u8]) -> io::Result<()> {
        if let Err(error) = self.file.write_all(bytes) {
            // What is left of the line would be taken for one; should that fail too, opening it again ends the line.
            drop(self.file.set_len(self.size));
            return Err(error);
        }
        self.size += bytes.len() as u64;
        Ok(())
    }
}

/// How many lines could not be written and are not told of yet, over the controller's lives.
#[derive(Debug)]
struct Missing {
    path: PathBuf,
    file: Option<File>,
    count: u64,
}

impl Missing {
    /// Beside the log's directory: what ails that one need not ail its parent.
    fn beside(dir: &Path) -> Self {
        let path = dir.with_extension("missing");
        let kept = std::fs::read_to_string(&path).ok();
        let count = kept.and_then(|text| text.trim().parse().ok()).unwrap_or_default();
        let mut missing = Self { path, file: None, count };
        missing.set(count);
        missing
    }

    fn add(&mut self, lines: u64) {
        if lines > 0 {
            self.set(self.count + lines);
        }
    }

    fn set(&mut self, count: u64) {
        self.count = count;
        if let Err(error) = self.keep() {
            tracing::warn!(error = &error as &dyn std::error::Error, path = %self.path.display(), "how many audit lines are missing is not kept over a restart");
        }
    }

    /// In place, always as long: it needs no room on the disk after the first time.
    fn keep(&mut self) -> io::Result<()> {
        let file = match self.file.take() {
            Some(file) => file,
            None => {
                let mut options = OpenOptions::new();
                options.write(true).create(true).truncate(false).mode(0o600).open(&self.path)?
            }
        };
        let file = self.file.insert(file);
        file.write_all_at(format!("{:020}\n", self.count).as_bytes(), 0)
    }
}
