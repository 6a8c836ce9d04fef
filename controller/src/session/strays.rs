//! What an agent runs and should not, from Hello to the report of its end: the half of a session that
//! keeps two drivers apart when a robot comes back that was given up.
//!
//! Three rules. What lives is never released, because a released task is forgotten without a word.
//! While there is a stray the node is not ready, and the agent is sent no task that it does not know
//! already. When the last stray has ended, the whole page is sent again.

use std::collections::BTreeSet;
use std::sync::Arc;

use muster_api::id::TaskUid;
use muster_api::kind::task::Task;
use muster_api::wire::agent::v1 as wire;
use tokio::sync::Notify;
use wire::controller_message::Body as ToAgent;

use super::agents::{End, Session, internal};
use super::{board, nodes};
use crate::objects;

impl Session {
    /// Sends everything that the node should have; gives what wakes this session when that changes.
    /// Of `told`, what has ended and nobody asks for any more is released.
    pub(super) async fn send_page(
        &mut self,
        told: &[wire::TaskReport],
    ) -> Result<Arc<Notify>, End> {
        let (mut page, wake) = self.sessions.board().whole_page(&self.node);
        // A fence that seemed to fail may be found to be there while Hello is written.
        let given: BTreeSet<&str> =
            page.upserts.iter().filter(|a| !a.ended).map(|a| a.uid.as_str()).collect();
        if self.strays.given(|uid| given.contains(uid.as_str())) {
            self.tell_strays();
            self.write_strays().await?;
        }
        let named = |uid: &str| page.upserts.iter().any(|a| a.uid == uid);
        let over = told.iter().filter(|report| !lives(report) && !named(&report.uid));
        page.released = over.map(|report| report.uid.clone()).collect();
        self.hold_back(&mut page);
        self.send_assignments(page).await?;
        Ok(wake)
    }

    async fn send_assignments(&self, page: wire::Assignments) -> Result<(), End> {
        for part in board::split(page) {
            self.send(ToAgent::Assignments(part)).await?;
        }
        Ok(())
    }

    /// While something runs that should not, nothing new is sent.
    fn hold_back(&self, page: &mut wire::Assignments) {
        if !self.strays.is_empty() {
            page.upserts.retain(|a| a.ended || self.strays.lives(&TaskUid::new(a.uid.clone())));
        }
    }

    /// The store gives the task to this node and knows no end of it. The store is asked, not the board:
    /// the board may be a moment behind.
    pub(super) fn is_assigned(&self, uid: &TaskUid) -> bool {
        let Some((_, key)) = self.sessions.board().find(uid.as_str()) else { return false };
        let stored = self.context.store.get(&key).filter(|stored| *stored.uid == *uid.as_str());
        let status = stored.and_then(|s| objects::read::<Task>(&s)).and_then(|t| t.status);
        status
            .is_some_and(|s| s.phase.holds_node() && s.node.as_deref() == Some(self.node.as_str()))
    }

    /// The strays as people know them; by uid where no object is left.
    pub(super) fn stray_names(&self) -> Vec<String> {
        let board = self.sessions.board();
        let name = |uid: &TaskUid| match board.find(uid.as_str()) {
            Some((_, key)) => {
                format!("task {}/{}", key.namespace().unwrap_or_default(), key.name)
            }
            None => format!("a task that is not known any more, uid {uid}"),
        };
        self.strays.iter().map(name).collect()
    }

    pub(super) fn tell_strays(&self) {
        let names = self.stray_names().join(", ");
        tracing::warn!(node = %self.node, strays = names, "the agent runs what it should not; it is told to stop it");
        let message = format!("its agent runs what it should not, and is told to stop it: {names}");
        self.context.events.warn_node(self.node.as_str(), nodes::STRAY_TASKS, message);
    }

    /// After the strays changed: the node says so, and the agent gets the page that goes with it.
    async fn strays_changed(&mut self, appeared: bool) -> Result<(), End> {
        self.is_newest()?;
        if appeared {
            self.tell_strays();
        }
        self.write_strays().await?;
        if appeared || self.strays.is_empty() {
            self.send_page(&[]).await?;
        }
        Ok(())
    }

    async fn write_strays(&self) -> Result<(), End> {
        let (names, is_newest) =
            (self.stray_names(), || self.sessions.is_present(&self.node, self.id));
        nodes::write_strays(&self.context, &self.node, &names, is_newest).await.map_err(internal)
    }

    /// Sends what changed of the page, unless it makes a stray of something that lives.
    pub(super) async fn send_changed(&mut self) -> Result<(), End> {
        let Some(mut changed) = self.sessions.board().take_changed(&self.node) else {
            return Ok(());
        };
        let ended = changed.upserts.iter().filter(|a| a.ended).map(|a| &a.uid);
        let uids: Vec<TaskUid> =
            ended.chain(&changed.released).map(|uid| TaskUid::new(uid.clone())).collect();
        let strays = uids.iter().filter(|uid| self.strays.withdrawn(uid)).count();
        if strays > 0 {
            return self.strays_changed(true).await;
        }
        // What lives is not released: its end is still to be heard.
        changed.released.retain(|uid| !self.strays.lives(&TaskUid::new(uid.clone())));
        self.hold_back(&mut changed);
        self.send_assignments(changed).await
    }

    /// Takes a report, and what it says about strays.
    pub(super) async fn take_report(&mut self, report: &wire::TaskReport) -> Result<(), End> {
        self.apply_report(report).await?;
        self.acknowledge(report).await?;
        let (uid, lives) = (TaskUid::new(report.uid.clone()), lives(report));
        let placed = self.sessions.board().find(&report.uid);
        if !lives && placed.is_none_or(|(node, _)| node != self.node) {
            let released = vec![report.uid.clone()];
            let over = wire::Assignments { released, ..wire::Assignments::default() };
            self.send(ToAgent::Assignments(over)).await?;
        }
        let assigned = !lives || self.strays.lives(&uid) || self.is_assigned(&uid);
        if self.strays.told(&uid, lives, assigned) {
            self.strays_changed(lives).await?;
        }
        Ok(())
    }
}

/// A process of the task may live there.
pub(super) fn lives(report: &wire::TaskReport) -> bool {
    ![wire::TaskPhase::Succeeded, wire::TaskPhase::Failed].contains(&report.phase())
}
