//! Cursors over the ring of events. A watcher holds no buffer: one that falls behind the ring is told so.

use std::sync::{Arc, PoisonError, RwLock};

use tokio::sync::watch;

use super::state::{Expired, State};
use super::{Event, Resource};

/// Events handed out at once, so that a watcher far behind does not copy the whole ring.
const CHUNK: usize = 1024;

/// Why a watch did not begin.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum WatchError {
    /// History no longer reaches back.
    #[error(transparent)]
    Expired(#[from] Expired),
    /// The revision is from another store, or from before a restore.
    #[error("revision {asked} is ahead of {current}")]
    Ahead {
        /// What was asked for.
        asked: u64,
        /// The last committed revision.
        current: u64,
    },
}

/// Why a watch ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum WatchEnd {
    /// The watcher fell behind the ring; list again.
    #[error(transparent)]
    Expired(#[from] Expired),
    /// The store is shutting down.
    #[error("the store is shutting down")]
    Closed,
}

/// A cursor over committed changes.
#[derive(Debug)]
pub struct Watcher {
    state: Arc<RwLock<State>>,
    published: watch::Receiver<u64>,
    resource: Option<Resource>,
    cursor: u64,
}

impl Watcher {
    pub(super) fn open(
        state: Arc<RwLock<State>>,
        published: watch::Receiver<u64>,
        resource: Option<Resource>,
        from: u64,
    ) -> Result<Self, WatchError> {
        {
            let state = state.read().unwrap_or_else(PoisonError::into_inner);
            let current = state.revision();
            if from > current {
                return Err(WatchError::Ahead { asked: from, current });
            }
            drop(state.since(from)?);
        }
        Ok(Self { state, published, resource, cursor: from })
    }

    /// Everything at or below this revision was handed out, or was about other resources.
    #[must_use]
    pub fn revision(&self) -> u64 {
        self.cursor
    }

    /// Goes back to `revision`: what came after it was handed out and not used, and is handed out again. Who cannot send
    /// what there is holds nothing of it meanwhile, and has fallen behind when it is gone.
    pub fn rewind(&mut self, revision: u64) {
        self.cursor = self.cursor.min(revision);
    }

    /// Waits for the next changes, in revision order; never empty. Cancel safe: what was not returned will be.
    ///
    /// # Errors
    /// [`WatchEnd`]; after it, every call ends the same way.
    pub async fn next(&mut self) -> Result<Vec<Event>, WatchEnd> {
        loop {
            // Seen before the ring is read: a change published in between wakes the wait below.
            let published = *self.published.borrow_and_update();
            while self.cursor < published {
                let events = self.take()?;
                if !events.is_empty() {
                    return Ok(events);
                }
            }
            if self.published.changed().await.is_err() {
                return Err(WatchEnd::Closed);
            }
        }
    }

    /// What is there now, without waiting; may be empty.
    ///
    /// # Errors
    /// [`WatchEnd::Expired`] when the watcher fell behind.
    pub fn take(&mut self) -> Result<Vec<Event>, Expired> {
        let state = self.state.read().unwrap_or_else(PoisonError::into_inner);
        let mut events = Vec::new();
        let mut cursor = state.revision();
        for event in state.since(self.cursor)? {
            if self.resource.is_none_or(|wanted| event.object.key.resource == wanted) {
                events.push(event.clone());
                if events.len() == CHUNK {
                    cursor = event.revision();
                    break;
                }
            }
        }
        self.cursor = cursor;
        Ok(events)
    }
}
