//! What all tasks show of themselves: to the link (reports to send), to heartbeats (usage), to log
//! readers (which attempt). Drivers write, everybody reads; the lock is never held across an await.

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Instant;

use muster_agent_core::depend::Seen;
use muster_agent_core::report::Report;
use muster_agent_core::workload::{State, Workload};
use muster_api::id::TaskUid;
use tokio::sync::{Notify, watch};

use crate::runtime::{AttemptId, Runtime, Used};

/// One task.
#[derive(Debug, Clone)]
pub(crate) struct Entry {
    pub(crate) report: Report,
    /// The newest sequence that the controller has acknowledged.
    pub(crate) acked: u64,
    pub(crate) attempt: u32,
    /// What the report says is known in this life of the agent, and not only remembered.
    pub(crate) known: bool,
    pub(crate) runtime: Arc<dyn Runtime>,
    /// `namespace/name`.
    pub(crate) title: String,
    /// Memory that its spec reserves, bytes.
    pub(crate) reserved: u64,
    /// The last usage that was told.
    pub(crate) sample: Option<(Instant, Used)>,
}

/// All tasks.
#[derive(Debug, Default)]
pub(crate) struct Board {
    entries: Mutex<BTreeMap<TaskUid, Entry>>,
    changed: Notify,
    /// For those who follow other tasks; any number of them.
    news: watch::Sender<()>,
}

/// Usage over the time since the last look.
#[derive(Debug, Clone)]
pub(crate) struct Usage {
    pub(crate) uid: TaskUid,
    pub(crate) cpu_millis: u64,
    pub(crate) used: Used,
}

impl Board {
    fn entries(&self) -> MutexGuard<'_, BTreeMap<TaskUid, Entry>> {
        self.entries.lock().unwrap_or_else(PoisonError::into_inner)
    }

    pub(crate) fn publish(
        &self,
        (workload, title): (&Workload, &str),
        runtime: &Arc<dyn Runtime>,
        reserved: u64,
    ) {
        let Workload { uid, report, attempt, .. } = workload;
        let (attempt, known) = (*attempt, !matches!(workload.state, State::Recovering { .. }));
        let mut entries = self.entries();
        match entries.get_mut(uid) {
            Some(entry) => {
                if entry.attempt != attempt {
                    entry.sample = None;
                }
                (entry.report, entry.attempt, entry.reserved) = (report.clone(), attempt, reserved);
                entry.known = known;
            }
            None => {
                let entry = Entry {
                    report: report.clone(),
                    acked: 0,
                    attempt,
                    known,
                    runtime: Arc::clone(runtime),
                    title: title.to_owned(),
                    reserved,
                    sample: None,
                };
                entries.insert(uid.clone(), entry);
            }
        }
        drop(entries);
        self.changed.notify_one();
        self.news.send_replace(());
    }

    pub(crate) fn withdraw(&self, uid: &TaskUid) {
        self.entries().remove(uid);
        self.news.send_replace(());
    }

    /// Says when something about any task is new.
    pub(crate) fn news(&self) -> watch::Receiver<()> {
        self.news.subscribe()
    }

    /// A task of this node, as another one that waits for it sees it.
    pub(crate) fn seen(&self, uid: &str) -> Option<Seen> {
        let entries = self.entries();
        let Entry { report, attempt, known, .. } = entries.get(uid)?;
        Some(Seen {
            phase: report.content.phase.into(),
            ready: report.content.ready,
            attempt: *attempt,
            known: *known,
        })
    }

    /// Resolves when nothing is only remembered of the tasks of an earlier life of the agent.
    pub(crate) async fn known(&self) {
        let mut news = self.news();
        // Closed: the agent goes down.
        while !self.entries().values().all(|entry| entry.known) && news.changed().await.is_ok() {}
    }

    pub(crate) fn acknowledged(&self, uid: &str, sequence: u64) {
        if let Some(entry) = self.entries().get_mut(uid) {
            entry.acked = entry.acked.max(sequence);
        }
    }

    /// Resolves after a publication; one that happened while nobody waited counts.
    pub(crate) async fn changed(&self) {
        self.changed.notified().await;
    }

    pub(crate) fn reports(&self) -> Vec<(TaskUid, Report, u64)> {
        self.entries()
            .iter()
            .map(|(uid, entry)| (uid.clone(), entry.report.clone(), entry.acked))
            .collect()
    }

    /// The tasks that have not ended, with their `namespace/name`.
    pub(crate) fn live(&self) -> Vec<(TaskUid, String)> {
        let entries = self.entries();
        let live = entries.iter().filter(|(_, entry)| !entry.report.content.phase.is_terminal());
        live.map(|(uid, entry)| (uid.clone(), entry.title.clone())).collect()
    }

    /// The task's runtime and present attempt.
    pub(crate) fn find(&self, uid: &str) -> Option<(Arc<dyn Runtime>, AttemptId)> {
        let entries = self.entries();
        let (uid, entry) = entries.get_key_value(uid)?;
        let id = AttemptId { uid: uid.clone(), attempt: entry.attempt };
        Some((Arc::clone(&entry.runtime), id))
    }

    /// Memory that the tasks on this node reserve, bytes.
    pub(crate) fn reserved(&self) -> u64 {
        let entries = self.entries();
        entries
            .values()
            .filter(|entry| !entry.report.content.phase.is_terminal())
            .map(|entry| entry.reserved)
            .sum()
    }

    /// Usage of the running tasks since the last call.
    pub(crate) fn sample(&self) -> Vec<Usage> {
        let mut entries = self.entries();
        let mut usage = Vec::new();
        for (uid, entry) in entries.iter_mut() {
            let id = AttemptId { uid: uid.clone(), attempt: entry.attempt };
            let Some(used) = entry.runtime.used(&id) else { continue };
            let now = Instant::now();
            let before = entry.sample.replace((now, used));
            let cpu_millis = before.map_or(0, |(at, before)| {
                let micros = now.duration_since(at).as_micros().max(1);
                let spent = u128::from(used.cpu_usec.saturating_sub(before.cpu_usec));
                u64::try_from(spent * 1_000 / micros).unwrap_or(u64::MAX)
            });
            usage.push(Usage { uid: uid.clone(), cpu_millis, used });
        }
        usage
    }
}
