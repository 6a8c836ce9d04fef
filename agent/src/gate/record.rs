//! The gate's record on its way to the disk, beside everything else: a disk may be slow or full, and no stop waits for it. What
//! must not happen before the record is durable waits here.

use std::path::Path;
use std::sync::Arc;
use std::time::Duration;

use muster_agent_core::gate::Kept;
use muster_failpoint::Failpoint;
use tokio::task::JoinHandle;
use tokio::time::Instant;

use crate::driver::chain;
use crate::durable::{self, FileError, Keep};

/// What a gate that begins must know.
const KEPT: &str = "kept.json";

/// Between two tries to write it.
const AGAIN: Duration = Duration::from_secs(1);

/// Makes a record durable. Blocks.
pub(super) type Write = Arc<dyn Fn(&Kept) -> Result<(), FileError> + Send + Sync>;

/// What an earlier gate kept in `dir`.
pub(super) fn read(dir: &Path) -> Result<Kept, FileError> {
    durable::read_json(&dir.join(KEPT)).map(Option::unwrap_or_default)
}

/// Writes to `dir`.
pub(super) fn write_to(dir: &Path) -> Write {
    let path = dir.join(KEPT);
    Arc::new(move |kept| durable::write_json(Failpoint::GateRecord, &path, kept, Keep::PowerCut))
}

/// The record, and what waits for it.
pub(super) struct Record<W> {
    write: Write,
    state: State,
    /// Newer than what is being written, with what waits for that.
    next: Option<Kept>,
    waits: Vec<W>,
    waits_for_next: Vec<W>,
    /// Why the last write was in vain.
    error: Option<String>,
}

enum State {
    /// Everything is durable.
    Idle,
    Writing(Kept, JoinHandle<Result<(), FileError>>),
    /// It could not be written, and is tried again then.
    Failed(Kept, Instant),
}

impl<W> Record<W> {
    pub(super) fn new(write: Write) -> Record<W> {
        Record {
            write,
            state: State::Idle,
            next: None,
            waits: Vec::new(),
            waits_for_next: Vec::new(),
            error: None,
        }
    }

    /// Whether everything is durable.
    pub(super) fn is_idle(&self) -> bool {
        matches!(self.state, State::Idle)
    }

    /// Why it is not written, when it could not be.
    pub(super) fn error(&self) -> Option<&str> {
        self.error.as_deref()
    }

    /// Takes what is to be kept.
    pub(super) fn keep(&mut self, kept: Kept) {
        match self.state {
            State::Idle => self.begin(kept),
            State::Writing(..) | State::Failed(..) => self.next = Some(kept),
        }
    }

    /// Waits with this until all that was to be kept is durable.
    pub(super) fn wait(&mut self, waits: W) {
        if self.next.is_some() { &mut self.waits_for_next } else { &mut self.waits }.push(waits);
    }

    fn begin(&mut self, kept: Kept) {
        let (write, written) = (Arc::clone(&self.write), kept.clone());
        self.state = State::Writing(kept, tokio::task::spawn_blocking(move || write(&written)));
    }

    /// What need not wait any more; nothing when a write was in vain. Cancel-safe: what has ended is accounted for before the
    /// next wait.
    pub(super) async fn written(&mut self) -> Vec<W> {
        loop {
            match &mut self.state {
                State::Idle => std::future::pending().await,
                State::Writing(kept, writing) => {
                    let written = writing.await.map_err(|error| error.to_string());
                    let written = written.and_then(|w| w.map_err(|error| chain(&error)));
                    match written {
                        Ok(()) => return self.done(),
                        Err(error) => {
                            tracing::error!(error, "the gate's record is not written");
                            self.state = State::Failed(kept.clone(), Instant::now() + AGAIN);
                            self.error = Some(error);
                            return Vec::new();
                        }
                    }
                }
                State::Failed(kept, again) => {
                    tokio::time::sleep_until(*again).await;
                    let kept = kept.clone();
                    let kept = self.next.take().unwrap_or(kept);
                    self.waits.append(&mut self.waits_for_next);
                    self.begin(kept);
                }
            }
        }
    }

    fn done(&mut self) -> Vec<W> {
        (self.state, self.error) = (State::Idle, None);
        let waited = std::mem::take(&mut self.waits);
        if let Some(next) = self.next.take() {
            self.waits = std::mem::take(&mut self.waits_for_next);
            self.begin(next);
        }
        waited
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Mutex;

    use muster_agent_core::gate::Token;
    use muster_api::id::Epoch;

    use super::*;

    fn kept(epoch: u64) -> Kept {
        Kept { newest: Token::root(Epoch(epoch)), ..Kept::default() }
    }

    #[tokio::test]
    async fn what_waits_is_let_go_when_what_it_waits_for_is_durable() {
        let written = Arc::new(Mutex::new(Vec::new()));
        let full = Arc::new(Mutex::new(true));
        let write: Write = {
            let (written, full) = (Arc::clone(&written), Arc::clone(&full));
            Arc::new(move |kept| {
                if *full.lock().unwrap() {
                    let full = std::io::ErrorKind::StorageFull;
                    return Err(FileError::at("write", Path::new("kept.json"))(full.into()));
                }
                written.lock().unwrap().push(kept.newest.epoch.0);
                Ok(())
            })
        };
        let mut record = Record::new(write);
        assert!(record.is_idle());
        record.keep(kept(1));
        record.wait("a");
        record.keep(kept(2));
        record.wait("b");
        record.keep(kept(3));
        record.wait("c");
        assert!(record.written().await.is_empty());
        assert!(record.error().is_some() && !record.is_idle());
        *full.lock().unwrap() = false;
        // The newest is written for all of them.
        assert_eq!(record.written().await, ["a", "b", "c"]);
        assert_eq!(*written.lock().unwrap(), [3]);
        assert!(record.is_idle() && record.error().is_none());
        record.keep(kept(4));
        record.wait("d");
        record.keep(kept(5));
        record.wait("e");
        assert_eq!(record.written().await, ["d"]);
        assert_eq!(record.written().await, ["e"]);
        assert_eq!(*written.lock().unwrap(), [3, 4, 5]);
    }
}
