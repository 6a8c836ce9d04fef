//! Follows the tasks that a task waits for.

use muster_agent_core::depend::{Dependency, Standing, standing};
use tokio::sync::watch;

use crate::board::Board;

/// What was told of them last.
#[derive(Debug)]
pub(crate) struct Others {
    news: watch::Receiver<()>,
    told: Option<Standing>,
}

impl Others {
    pub(crate) fn new(board: &Board) -> Self {
        Others { news: board.news(), told: None }
    }

    /// How they stand, when that is something else than what was told last. Never, for a task that waits for nobody. Cancel
    /// safe: it counts as told when it is given.
    pub(crate) async fn news(&mut self, board: &Board, all: &[Dependency]) -> Standing {
        if all.is_empty() {
            return std::future::pending().await;
        }
        loop {
            // Seen before the look: what is published in between wakes the wait below.
            self.news.mark_unchanged();
            let now = standing(all, |uid| board.seen(uid));
            if self.told.as_ref() != Some(&now) {
                self.told = Some(now.clone());
                return now;
            }
            if self.news.changed().await.is_err() {
                // The board is gone: the agent ends.
                return std::future::pending().await;
            }
        }
    }
}
