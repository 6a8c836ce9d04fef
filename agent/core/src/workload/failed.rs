//! Attempts that fail: which those are, how many may, and starts that cannot be made.

use super::{Condemned, Context, Effect, Failure, Phase, Reason, State, Workload};
use crate::observed::{End, Exit, Loss};

impl Workload {
    pub(super) fn on_failure(
        &mut self,
        failure: &Failure,
        context: Context,
        effects: &mut Vec<Effect>,
    ) {
        let reason = Reason::Runtime(failure.reason.clone());
        self.unused = true;
        if self.forgotten || self.desired.stop.is_some() {
            return self.ended_unstarted(context, effects);
        }
        self.failed = self.failed.saturating_add(1);
        if failure.retry && !self.is_given_up() {
            self.failures = self.failures.saturating_add(1);
            self.wait(reason, &failure.message, context, effects);
        } else {
            self.ended_unable(reason, &failure.message, context);
        }
    }

    /// As many attempts have failed here as may.
    pub(super) fn is_given_up(&self) -> bool {
        self.desired.attempts.is_some_and(|attempts| self.failed >= attempts)
    }

    /// The end of a task that could not be started.
    pub(super) fn ended_unable(&mut self, reason: Reason, message: &str, context: Context) {
        self.state = State::Ended;
        let mut content = self.report_draft();
        content.phase = Phase::Failed;
        content.finished_at = Some(context.now.wall);
        content.reason = reason;
        message.clone_into(&mut content.message);
        self.report.update(content);
    }

    /// Counts the attempt that ended, if it failed by its own doing.
    pub(super) fn count_failure(&mut self, exit: &Exit) {
        if self.has_failed(exit) {
            self.failed = self.failed.saturating_add(1);
        }
    }

    /// Whether an attempt failed: not one that was ended by order, for another task, or by a reboot.
    pub(super) fn has_failed(&self, exit: &Exit) -> bool {
        if self.desired.stop.is_some() || exit.end == End::Lost(Loss::Reboot) {
            return false;
        }
        match &self.condemned {
            Some(Condemned::Dependency { .. }) => false,
            Some(Condemned::Probe { .. }) => true,
            None => !exit.succeeded(),
        }
    }
}
