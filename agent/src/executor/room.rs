//! An executor's limits: its own resources and those of its live works.

use std::sync::Arc;

use muster_agent_core::desired::StopTimes;
use muster_api::id::TaskUid;
use tokio::sync::Mutex;

use crate::runtime::launch::{AttemptId, Limits};
use crate::runtime::{Runtime, RuntimeError};

/// One executor's.
#[derive(Debug)]
pub(super) struct Room {
    runtime: Arc<dyn Runtime>,
    own: Limits,
    /// What was last set, and for which attempt. Held while it is set, so that the last word is the
    /// newest sum.
    set: Mutex<Option<(u32, Limits)>>,
}

impl Room {
    pub(super) fn new(runtime: Arc<dyn Runtime>, own: Limits) -> Room {
        Room { runtime, own, set: Mutex::new(None) }
    }

    /// `works`: the executor's attempt and what its live works need, asked when it is this call's turn.
    pub(super) async fn fit(
        &self,
        executor: &TaskUid,
        works: impl Fn() -> Option<(u32, Vec<Limits>)>,
    ) -> Result<(), RuntimeError> {
        let mut set = self.set.lock().await;
        // Nothing runs: the next attempt begins with its own resources.
        let Some((attempt, works)) = works() else { return Ok(()) };
        let wanted = sum(self.own, &works);
        if *set == Some((attempt, wanted)) {
            return Ok(());
        }
        *set = None;
        let id = AttemptId { uid: executor.clone(), attempt };
        self.runtime.resize(&id, &wanted).await?;
        *set = Some((attempt, wanted));
        Ok(())
    }

    /// Ends the executor, with all that it runs.
    pub(super) async fn end(&self, id: &AttemptId) -> Result<(), RuntimeError> {
        self.runtime.stop(id, StopTimes { signal_ms: 0, kill_ms: 0 }).await
    }
}

/// What nobody names stays unlimited; I/O rates are the executor's own.
fn sum(own: Limits, works: &[Limits]) -> Limits {
    let add = |of: fn(&Limits) -> Option<u64>| {
        let named: Vec<u64> = std::iter::once(&own).chain(works).filter_map(of).collect();
        (!named.is_empty()).then(|| named.iter().fold(0, |all: u64, one| all.saturating_add(*one)))
    };
    Limits {
        cpu_millis: add(|limits| limits.cpu_millis),
        memory_bytes: add(|limits| limits.memory_bytes),
        pids: add(|limits| limits.pids),
        ..own
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sums() {
        let limits =
            |cpu_millis, memory_bytes| Limits { cpu_millis, memory_bytes, ..Limits::default() };
        let works = [limits(Some(200), None), limits(None, Some(5))];
        assert_eq!(sum(limits(Some(100), Some(1)), &works), limits(Some(300), Some(6)));
        assert_eq!(sum(limits(None, None), &[]), Limits::default());
    }
}
