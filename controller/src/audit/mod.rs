//! The audit log: who changed what, when, and what came of it.
//!
//! ```text
//!   REST write ──▶ ready? ──no──▶ 503                       DIR/audit/audit.jsonl      the newest lines
//!                    │yes                                   DIR/audit/audit.jsonl.1 …  the ones before, 8 files in all
//!                    ▼                                      DIR/audit/refused.jsonl …  what was refused, 2 files
//!            carried out ──▶ a line ──▶ the answer          DIR/audit.missing          lines that are missing
//!                              │ queue
//!                              ▼
//!                        `writer`, a thread ──▶ files
//! ```
//!
//! A line is written after a write was carried out and before it is answered: what was acknowledged has its line, also when
//! the controller is killed the next moment. (A power loss may take the lines of the last moments, which the operating system
//! had not written yet; the objects are synced, the lines are not.) While lines cannot be written, writes are refused with 503
//! before they are carried out, but for those that only stop or take away (`entry` says which): nobody's robot goes on
//! because a disk is full. What was carried out is never answered as if it were not: where its line is missing, a `Warning`
//! says so, and the first line that can be written again says how many are missing, also after a restart.
//!
//! What was refused has files of its own: who may do nothing could push what was done out of the log otherwise.
//!
//! What a framework's session launches, changes and ends has its lines as well, under the name of who opened the session; those
//! of launches come a moment after their answer, because the scheduler waits for no disk. What agents tell of their nodes and
//! tasks has none, and neither has what the controller does by itself.
//!
//! A line has no bodies of objects, no query and no secrets. Reads have no lines, and neither have requests of those who did
//! not say who they are, unless they were let in.

pub(crate) mod entry;
mod writer;

use std::io;
use std::path::PathBuf;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::JoinHandle;
use std::time::Duration;

use jiff::Timestamp;
use muster_controller_core::access::Verb;
use serde::Serialize;
use tokio::sync::{mpsc, oneshot};

use crate::auth::Identity;
use writer::{Bound, Job, Writer};

/// With eight files half a gigabyte, some two million writes.
const DONE: Bound = Bound { name: "audit.jsonl", bytes: 64 << 20, files: 8 };
/// Enough to see who tries what.
const REFUSED: Bound = Bound { name: "refused.jsonl", bytes: 16 << 20, files: 2 };
/// Lines that wait for the disk; more are missing. Some megabytes.
const QUEUE: usize = 4096;
/// A line that is not written by then is answered as one that is missing. A disk that works takes a thousandth of it.
const PATIENCE: Duration = Duration::from_secs(if cfg!(test) { 60 } else { 2 });
/// Longest name in a line, bytes: none that is taken is longer, and what was refused may be a megabyte.
const LONGEST: usize = 253;

/// Something that was done, or refused.
#[derive(Debug, Clone, Default, Serialize)]
#[serde(rename_all = "camelCase")]
pub(crate) struct Line {
    /// When it was answered.
    pub(crate) time: Timestamp,
    /// The answer's `Audit-Id`.
    pub(crate) request_id: String,
    pub(crate) user: String,
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub(crate) groups: Vec<String>,
    /// The id of the token that was shown.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) token: Option<String>,
    /// The other end of the connection.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) from: Option<String>,
    pub(crate) verb: &'static str,
    pub(crate) group: &'static str,
    pub(crate) resource: &'static str,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) subresource: Option<&'static str>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) namespace: Option<String>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) name: Option<String>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) uid: Option<String>,
    /// The objects of a write of several; whom a token is for, who joined, from whom a lease was taken.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub(crate) objects: Vec<Named>,
    /// HTTP status; none: the client left before the answer, and it may have been carried out.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) code: Option<u16>,
    /// Why it was refused.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) reason: Option<String>,
}

impl Line {
    /// Of something that this identity does.
    pub(crate) fn of(identity: &Identity, verb: Verb, resource: &'static str) -> Self {
        Self {
            request_id: uuid::Uuid::new_v4().to_string(),
            user: identity.name(),
            groups: identity.groups(),
            token: match identity {
                Identity::User { token, .. } => token.clone(),
                Identity::Admin { .. } | Identity::Node { .. } | Identity::Anonymous => None,
            },
            verb: verb.as_str(),
            group: muster_api::GROUP,
            resource,
            ..Self::default()
        }
    }

    /// Nothing came of it, and whose fault that is.
    fn is_refused(&self) -> bool {
        self.objects.is_empty() && self.code.is_some_and(|code| (400..500).contains(&code))
    }

    /// With names that are no longer than names may be.
    fn bounded(mut self) -> Self {
        let names = [&mut self.namespace, &mut self.name].into_iter().flatten();
        for text in names.chain([&mut self.user]).chain(&mut self.groups) {
            text.truncate(text.floor_char_boundary(LONGEST));
        }
        self
    }
}

/// One of several objects. In the extensions of an answer: one that the answer itself does not name.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize)]
#[serde(rename_all = "camelCase")]
pub(crate) struct Named {
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) kind: Option<String>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) namespace: Option<String>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) name: Option<String>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) uid: Option<String>,
}

/// What the thread and those who ask it both see.
#[derive(Debug, Default)]
struct Shared {
    /// As far as is known.
    can_write: AtomicBool,
    /// Lines that found no place in the queue.
    lost: AtomicU64,
}

/// The log of one controller.
#[derive(Debug)]
pub struct Audit {
    /// None: it ends.
    queue: Option<mpsc::Sender<Job>>,
    thread: Option<JoinHandle<()>>,
    /// Instead of the thread.
    here: Option<Mutex<Writer>>,
    shared: Arc<Shared>,
}

impl Audit {
    /// A log in `dir`, which is made with its first line.
    #[must_use]
    pub fn in_dir(dir: PathBuf) -> Self {
        Self::bounded(dir, (DONE, REFUSED))
    }

    fn bounded(dir: PathBuf, bounds: (Bound, Bound)) -> Self {
        let (queue, jobs) = mpsc::channel(QUEUE);
        let shared = Arc::<Shared>::default();
        let writer = Writer::new(dir, bounds, Arc::clone(&shared));
        let thread =
            std::thread::Builder::new().name("audit".to_owned()).spawn(|| writer.run(jobs));
        if let Err(error) = &thread {
            // Its end of the queue is gone, so that no line can be written.
            tracing::error!(error = error as &dyn std::error::Error, "no thread for the audit log");
        }
        Self { queue: Some(queue), thread: thread.ok(), here: None, shared }
    }

    /// A log whose lines are written by whoever has them, and no thread: where time goes on when everybody waits, nobody may wait
    /// for what is not of that time.
    #[must_use]
    pub fn at_once(dir: PathBuf) -> Self {
        let shared = Arc::<Shared>::default();
        let writer = Writer::new(dir, (DONE, REFUSED), Arc::clone(&shared));
        Self { queue: None, thread: None, here: Some(Mutex::new(writer)), shared }
    }

    /// Whether lines can be written.
    ///
    /// # Errors
    /// Why not.
    pub(crate) async fn ready(&self, now: Timestamp) -> io::Result<()> {
        let room = self.queue.as_ref().map_or(0, mpsc::Sender::capacity);
        if self.shared.can_write.load(Ordering::Relaxed) && room > QUEUE / 2 {
            return Ok(());
        }
        let (answer, answered) = oneshot::channel();
        self.queue(Job::Open { now, answer })?;
        self.wait(answered).await
    }

    /// Writes a line. It is queued at once, and written also when nobody waits for it any more.
    ///
    /// # Errors
    /// When it is not written, or not yet.
    pub(crate) async fn write(&self, line: Line) -> io::Result<()> {
        let (answer, answered) = oneshot::channel();
        self.queue_line(line, Some(answer))?;
        self.wait(answered).await
    }

    /// Writes a line when its turn comes. For those who cannot wait; where it is not written, it counts as missing.
    pub(crate) fn post(&self, line: Line) {
        // Counted and logged.
        drop(self.queue_line(line, None));
    }

    fn queue_line(
        &self,
        line: Line,
        answer: Option<oneshot::Sender<io::Result<()>>>,
    ) -> io::Result<()> {
        let queued = self.queue(Job::Line { line: Box::new(line), answer });
        if let Err(error) = &queued {
            self.shared.lost.fetch_add(1, Ordering::Relaxed);
            metrics::counter!("muster_audit_failures_total").increment(1);
            tracing::error!(
                error = error as &dyn std::error::Error,
                "a line of the audit log is lost"
            );
        }
        queued
    }

    fn queue(&self, job: Job) -> io::Result<()> {
        if let Some(writer) = &self.here {
            writer.lock().unwrap_or_else(PoisonError::into_inner).take(job);
            return Ok(());
        }
        let queue = self.queue.as_ref().ok_or(io::ErrorKind::BrokenPipe)?;
        queue.try_send(job).map_err(|error| match error {
            mpsc::error::TrySendError::Full(_) => {
                io::Error::new(io::ErrorKind::TimedOut, "the disk does not keep up with it")
            }
            mpsc::error::TrySendError::Closed(_) => io::ErrorKind::BrokenPipe.into(),
        })
    }

    async fn wait(&self, answered: oneshot::Receiver<io::Result<()>>) -> io::Result<()> {
        match tokio::time::timeout(PATIENCE, answered).await {
            Ok(Ok(outcome)) => outcome,
            Ok(Err(_)) => Err(io::ErrorKind::BrokenPipe.into()),
            Err(_) => {
                // The thread says so when it can again.
                self.shared.can_write.store(false, Ordering::Relaxed);
                Err(io::Error::new(io::ErrorKind::TimedOut, "the disk does not answer"))
            }
        }
    }
}

impl Drop for Audit {
    fn drop(&mut self) {
        // The thread ends when it has written what is queued.
        drop(self.queue.take());
        if let Some(thread) = self.thread.take() {
            drop(thread.join());
        }
    }
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use serde_json::Value;

    use super::*;

    fn line(name: &str) -> Line {
        Line { user: "ada".to_owned(), name: Some(name.to_owned()), ..Line::default() }
    }

    fn lines(path: &Path) -> Vec<Value> {
        let text = std::fs::read_to_string(path).unwrap_or_default();
        text.lines().map(|line| serde_json::from_str(line).unwrap_or(Value::Null)).collect()
    }

    /// A log whose files hold a line each.
    fn short(dir: &Path) -> Audit {
        let short = |bound| Bound { bytes: 1, ..bound };
        Audit::bounded(dir.to_owned(), (short(DONE), short(REFUSED)))
    }

    #[tokio::test]
    async fn the_oldest_of_eight_files_goes() {
        let dir = tempfile::tempdir().unwrap();
        let place = dir.path().join("audit");
        let audit = short(&place);
        for number in 0..DONE.files + 2 {
            audit.write(line(&number.to_string())).await.unwrap();
        }
        let files = std::fs::read_dir(&place).unwrap();
        let mut kept: Vec<String> =
            files.map(|file| file.unwrap().file_name().into_string().unwrap()).collect();
        kept.sort();
        assert_eq!((kept.len(), kept[0].as_str()), (8, DONE.name));
        let name = |file: &str| lines(&place.join(file))[0]["name"].clone();
        assert_eq!((name(DONE.name), name("audit.jsonl.7")), ("9".into(), "2".into()));
    }

    #[tokio::test]
    async fn files_move_as_far_as_a_number_is_free() {
        let dir = tempfile::tempdir().unwrap();
        let place = dir.path().join("audit");
        let audit = short(&place);
        for number in 0..DONE.files {
            audit.write(line(&number.to_string())).await.unwrap();
        }
        // A crash has left it so.
        std::fs::remove_file(place.join("audit.jsonl.3")).unwrap();
        audit.write(line("next")).await.unwrap();
        let name =
            |number: u32| lines(&place.join(format!("{}.{number}", DONE.name)))[0]["name"].clone();
        let kept: Vec<Value> = (1..DONE.files).map(name).collect();
        assert_eq!(kept, ["7", "6", "5", "3", "2", "1", "0"]);
        assert_eq!(lines(&place.join(DONE.name))[0]["name"], "next");
    }

    #[tokio::test]
    async fn what_was_refused_pushes_out_nothing_that_was_done() {
        let dir = tempfile::tempdir().unwrap();
        let place = dir.path().join("audit");
        let audit = short(&place);
        audit.write(line("done")).await.unwrap();
        for _ in 0..20 {
            let long = "ä".repeat(100_000);
            let refused = Line { code: Some(403), namespace: Some(long.clone()), ..line(&long) };
            audit.write(refused).await.unwrap();
        }
        assert_eq!(lines(&place.join(DONE.name))[0]["name"], "done");
        let refused = std::fs::read_to_string(place.join(REFUSED.name)).unwrap();
        assert!(refused.len() < 1000, "{}", refused.len());
        assert_eq!(std::fs::read_dir(&place).unwrap().count(), 3, "two of what was refused");
        // A collection of which some were ended is no refusal.
        let some = Line { code: Some(409), objects: vec![Named::default()], ..line("some") };
        audit.write(some).await.unwrap();
        assert_eq!(lines(&place.join(DONE.name))[0]["name"], "some");
    }

    #[tokio::test]
    async fn a_torn_line_does_not_swallow_the_next() {
        let dir = tempfile::tempdir().unwrap();
        let place = dir.path().join("audit");
        std::fs::create_dir(&place).unwrap();
        std::fs::write(place.join(DONE.name), "{\"user\":\"a").unwrap();
        let audit = Audit::in_dir(place.clone());
        audit.write(line("x")).await.unwrap();
        let lines = lines(&place.join(DONE.name));
        assert_eq!((lines.len(), &lines[1]["name"]), (2, &"x".into()));
    }

    #[tokio::test]
    async fn what_is_missing_is_said_when_lines_can_be_written_again_also_after_a_restart() {
        let dir = tempfile::tempdir().unwrap();
        let place = dir.path().join("audit");
        // A file in the directory's place.
        std::fs::write(&place, "").unwrap();
        let audit = Audit::in_dir(place.clone());
        assert!(audit.ready(Timestamp::UNIX_EPOCH).await.is_err());
        assert!(audit.write(line("lost")).await.is_err());
        audit.post(line("lost"));
        drop(audit);
        std::fs::remove_file(&place).unwrap();
        let audit = Audit::in_dir(place.clone());
        audit.ready(Timestamp::UNIX_EPOCH).await.unwrap();
        audit.write(line("kept")).await.unwrap();
        drop(audit);
        Audit::in_dir(place.clone()).write(line("more")).await.unwrap();
        let lines = lines(&place.join(DONE.name));
        assert_eq!((&lines[0]["missing"], &lines[1]["name"]), (&2.into(), &"kept".into()));
        assert_eq!((lines.len(), &lines[2]["name"]), (3, &"more".into()), "it is said once");
    }
}
