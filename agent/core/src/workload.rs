//! One task on this node: its state, and what to do about it.
//!
//! ```text
//!    ┌──────────────── back-off ───────────────┐
//! Waiting → (Preparing ⇄) Launching → Running ─┤→ Ended → Removing → (forgotten)
//!                 any live state → Stopping ───┘
//! after a start of the agent: Launching|Running|Stopping → Recovering → one of them
//! ```
//!
//! Two rules make "nothing runs twice" hold at every crash: an attempt's number is durable before its
//! launch begins, and a number is used again only when a runtime has said that nothing of it was
//! ever started.

mod failed;
mod probed;
#[cfg(test)]
mod recovered;
#[cfg(test)]
mod standby;
mod waited;

use std::collections::BTreeMap;

use muster_api::id::TaskUid;
use serde::{Deserialize, Serialize};

use crate::depend::Standing;
use crate::desired::{Desired, StopOrder};
pub use crate::event::{Context, Effect, Event, Failure, Outcome, Response};
use crate::observed::{End, Exit, Loss, Observed, Started};
use crate::probe::Verdicts;
use crate::report::{Content, Phase, Reason, Report, explain};
use crate::restart;
use crate::time::Boot;
pub use probed::Condemned;

/// A stop that has not ended the task this long after its grace is asked for again: the runtime may
/// have lost it (an engine that was started anew, a shim that died).
pub const STOP_AGAIN_MS: u64 = 30_000;

/// How far a life of the agent may have told more than it had written down: the changes of one
/// event, with room.
const SEQUENCE_GAP: u64 = 16;

/// First and longest pause after an effect of ours (not of the task) failed.
const RETRY_MS: (u64, u64) = (1_000, 30_000);

/// Where a task is. Each variant says who moves it on.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub enum State {
    /// Nothing of it runs. A tick after `until` starts it, given contact if it needs contact.
    Waiting {
        /// Not before this.
        until: Boot,
    },
    /// Nothing of it runs; its runtime fetches what it needs (an image).
    Preparing,
    /// Its runtime was told to start the attempt; it may or may not have.
    Launching,
    /// Its main process runs; its runtime tells the end.
    Running {
        /// Since when.
        started: Started,
    },
    /// It is being ended; its runtime tells the end. A tick after `again` repeats the order.
    Stopping {
        /// Known when the program had begun.
        started: Option<Started>,
        /// When to repeat the order.
        again: Boot,
        /// How often the runtime refused the order, in a row.
        refused: u32,
    },
    /// The agent was started anew, or a launch had no clear answer: its runtime is being asked what
    /// became of the attempt. A tick after `again` asks once more.
    Recovering {
        /// The program is known to have begun before.
        began: bool,
        /// The machine was started anew since the attempt was launched.
        rebooted: bool,
        /// When to ask again.
        again: Boot,
        /// How often the runtime could not say, in a row.
        refused: u32,
    },
    /// It ended for good; nothing of it is left. The controller's release moves it on.
    Ended,
    /// Its directories and containers are being removed. A tick after `again` repeats that.
    Removing {
        /// When to try again.
        again: Boot,
        /// How often it failed, in a row.
        refused: u32,
    },
}

impl State {
    /// Whether a process of the task may exist.
    #[must_use]
    pub fn may_be_live(&self) -> bool {
        matches!(
            self,
            State::Launching
                | State::Running { .. }
                | State::Stopping { .. }
                | State::Recovering { .. }
        )
    }
}

/// Whether a task's runtime has something to fetch (an image).
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Fetch {
    /// Nothing, ever.
    Nothing,
    /// What a launch turns out to miss. Asking first would cost every start a question whose answer
    /// is nearly always no.
    Missing,
    /// Before every attempt.
    Always,
    /// Nothing, but before every attempt it waits for the executor that is to do it.
    Executor,
}

/// One task on this node. All of it is durable.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Workload {
    /// Which task.
    pub uid: TaskUid,
    /// What the controller wants.
    pub desired: Desired,
    /// Whether its runtime may have to fetch something before a launch.
    pub prepare: bool,
    /// It fetches before every attempt, not only when a launch says that something is missing.
    #[serde(default)]
    pub fetch_always: bool,
    /// An executor does it: the executor can be told to end it while it has not yet begun.
    #[serde(default)]
    pub work: bool,
    /// For the present try, it has.
    #[serde(default)]
    pub fetched: bool,
    /// It is to be removed as soon as nothing of it is left.
    pub forgotten: bool,
    /// Where it is.
    pub state: State,
    /// The current attempt; 0 before the first.
    pub attempt: u32,
    /// Nothing of the current attempt was ever started: its number is to be used again.
    pub unused: bool,
    /// How often it was started again.
    pub restarts: u32,
    /// Failures in a row.
    pub failures: u32,
    /// Attempts that failed, of all that there were.
    #[serde(default)]
    pub failed: u32,
    /// What its probes have found of the current attempt.
    #[serde(default)]
    pub verdicts: Verdicts,
    /// The current attempt is to be ended: a probe failed, or a task that it follows was started again.
    #[serde(default)]
    pub condemned: Option<Condemned>,
    /// How the tasks stand that it waits for; none: they are still to be looked at.
    #[serde(default)]
    pub standing: Option<Standing>,
    /// Uid and attempt of tasks that it follows, when the current attempt began.
    #[serde(default)]
    pub began_with: BTreeMap<String, (String, u32)>,
    /// What is told about it.
    pub report: Report,
}

impl Workload {
    /// A task that was just assigned, and the first things to do about it.
    pub fn assigned(
        uid: TaskUid,
        desired: Desired,
        fetch: Fetch,
        context: Context,
    ) -> (Workload, Response) {
        let state = State::Waiting { until: context.now.boot };
        let mut workload = Workload::new(uid, desired, fetch, state);
        let mut effects = Vec::new();
        workload.move_on(context, &mut effects);
        let response = workload.changed(effects);
        (workload, response)
    }

    /// A task whose assignment cannot be read: it ends before it begins, and says why. `message`
    /// names the field.
    pub fn unreadable(uid: TaskUid, message: String, context: Context) -> (Workload, Response) {
        let mut workload = Workload::new(uid, Desired::once(0), Fetch::Nothing, State::Ended);
        let mut content = workload.report_draft();
        content.phase = Phase::Failed;
        content.reason = Reason::AssignmentUnreadable;
        content.message = message;
        content.finished_at = Some(context.now.wall);
        workload.report.update(content);
        let response = workload.changed(Vec::new());
        (workload, response)
    }

    fn new(uid: TaskUid, desired: Desired, fetch: Fetch, state: State) -> Workload {
        Workload {
            uid,
            desired,
            prepare: fetch != Fetch::Nothing,
            fetch_always: matches!(fetch, Fetch::Always | Fetch::Executor),
            work: fetch == Fetch::Executor,
            fetched: false,
            forgotten: false,
            state,
            attempt: 0,
            unused: false,
            restarts: 0,
            failures: 0,
            failed: 0,
            verdicts: Verdicts::default(),
            condemned: None,
            standing: None,
            began_with: BTreeMap::new(),
            report: Report::accepted(),
        }
    }

    /// A task read back after the agent was started anew. `same_boot`: the machine was not.
    pub fn restored(&mut self, same_boot: bool, context: Context) -> Response {
        self.report.sequence += SEQUENCE_GAP;
        // The others may not have outlived the agent either.
        self.standing = None;
        let mut effects = Vec::new();
        match &mut self.state {
            State::Waiting { until } => {
                let limit = context.now.boot.plus(restart::delay_ms(self.failures));
                *until = if same_boot { (*until).min(limit) } else { context.now.boot };
                self.move_on(context, &mut effects);
            }
            State::Preparing => effects.push(Effect::Prepare(self.attempt)),
            State::Launching
            | State::Running { .. }
            | State::Stopping { .. }
            | State::Recovering { .. } => self.recover(!same_boot, context, &mut effects),
            State::Ended if self.forgotten => self.remove(context, &mut effects),
            State::Ended => {}
            State::Removing { .. } => self.remove(context, &mut effects),
        }
        self.changed(effects)
    }

    /// The one way in.
    pub fn handle(&mut self, event: Event, context: Context) -> Response {
        let before = self.clone();
        let mut effects = Vec::new();
        match event {
            Event::Assigned(desired) => self.on_assigned(desired, context, &mut effects),
            Event::Unassigned => self.end("no longer assigned", context, &mut effects),
            Event::Forgotten => {
                self.forgotten = true;
                self.end_if_wanted(context, &mut effects);
            }
            Event::Tick => self.on_tick(context, &mut effects),
            Event::Attempt(attempt, outcome) if attempt == self.attempt => {
                self.on_outcome(outcome, context, &mut effects);
            }
            // The answer to a question about an attempt that is over.
            Event::Attempt(..) => {}
            Event::Probed(attempt, verdict) if attempt == self.attempt => {
                self.on_verdict(verdict, context, &mut effects);
            }
            Event::Probed(..) => {}
            Event::Dependencies(standing) => self.on_dependencies(standing, context, &mut effects),
            Event::GivenBack => {
                let reason = "it drove and was silent for too long; the robot is given back";
                self.end(reason, context, &mut effects);
            }
            Event::Removed => {
                if matches!(self.state, State::Removing { .. }) {
                    return Response { effects: vec![Effect::Drop] };
                }
            }
            Event::RemoveFailed => {
                if let State::Removing { again, refused } = &mut self.state {
                    *refused += 1;
                    *again = context.now.boot.plus(pause(*refused));
                    effects.push(Effect::WakeAt(*again));
                }
            }
        }
        if *self == before { Response { effects } } else { self.changed(effects) }
    }

    /// Puts what makes a change durable and seen in front of what acts on it.
    fn changed(&mut self, effects: Vec<Effect>) -> Response {
        let mut all = vec![Effect::Persist];
        if !matches!(self.state, State::Removing { .. }) {
            let content = self.content();
            let begins =
                content.phase == Phase::Running && self.report.content.phase != Phase::Running;
            self.report.update(content);
            // "It runs" is told before it is written down, because somebody waits for it, and
            // because nothing depends on it: the launch is durable, and another life of the agent
            // finds what runs. Its sequence then begins above anything that was told (see
            // `restored`).
            let at = if begins { 0 } else { 1 };
            all.insert(at, Effect::Publish);
        }
        all.extend(effects);
        Response { effects: all }
    }

    fn on_assigned(&mut self, desired: Desired, context: Context, effects: &mut Vec<Effect>) {
        let before = self.desired.stop.take();
        let sooner = match (&before, &desired.stop) {
            (Some(old), Some(new)) => new.grace_ms < old.grace_ms,
            (None, Some(_)) => true,
            (_, None) => false,
        };
        // An order to stop is never taken back, nor given more time: part of the task may be gone already, and whoever
        // waits for its end was told when that is.
        let mut stop = if sooner { desired.stop.clone() } else { before };
        if matches!(self.state, State::Stopping { .. }) && self.condemned.is_some() {
            // It was being ended already, with the grace that it has itself.
            let grace_ms = self.desired.grace_ms;
            stop.iter_mut().for_each(|order| order.grace_ms = order.grace_ms.min(grace_ms));
        }
        let let_go = self.desired.standby_ms.is_some() && desired.standby_ms.is_none();
        self.desired = Desired { stop, ..desired };
        if sooner {
            self.end_if_wanted(context, effects);
        } else if let_go {
            self.move_on(context, effects);
        }
    }

    /// Ends it by this node's own decision. The controller gives this node's resources to somebody else only when it was told
    /// that nothing is left: the end must be heard before the task may be forgotten, so it waits for the release.
    fn end(&mut self, reason: &str, context: Context, effects: &mut Vec<Effect>) {
        if self.desired.stop.is_none() {
            let (grace_ms, reason) = (self.desired.grace_ms, reason.to_owned());
            self.desired.stop = Some(StopOrder { grace_ms, reason });
            self.end_if_wanted(context, effects);
        }
    }

    fn on_tick(&mut self, context: Context, effects: &mut Vec<Effect>) {
        let due = |again: Boot| context.now.boot >= again;
        match self.state {
            State::Waiting { .. } => self.move_on(context, effects),
            State::Stopping { again, .. } if due(again) => self.stop(context, effects),
            State::Recovering { began, rebooted, again, refused } if due(again) => {
                // Once: what is found out by a question that is still under way would void the launch that the first answer
                // brings about.
                let again = context.now.boot.plus(STOP_AGAIN_MS);
                self.state = State::Recovering { began, rebooted, again, refused };
                effects.extend([Effect::WakeAt(again), Effect::Find(self.attempt)]);
            }
            State::Removing { again, .. } if due(again) => effects.push(Effect::Remove),
            _ => {}
        }
    }

    fn on_outcome(&mut self, outcome: Outcome, context: Context, effects: &mut Vec<Effect>) {
        match (&self.state, outcome) {
            (State::Preparing, Outcome::Prepared) => {
                self.fetched = true;
                if self.waits_for_others() {
                    // One of them went down meanwhile.
                    self.unused = true;
                    self.state = State::Waiting { until: context.now.boot };
                } else {
                    self.launch(effects);
                }
            }
            // It will not be fetched for ever: what is still missing then is a failure.
            (State::Launching, Outcome::Unprepared(failure))
                if self.fetched || self.forgotten || self.desired.stop.is_some() =>
            {
                self.on_failure(&failure, context, effects);
            }
            (State::Launching, Outcome::Unprepared(_)) => self.prepare(effects),
            (State::Preparing, Outcome::PrepareFailed(failure))
            | (State::Launching | State::Stopping { .. }, Outcome::LaunchFailed(failure)) => {
                self.on_failure(&failure, context, effects);
            }
            (State::Launching, Outcome::Launched(started))
            | (State::Recovering { .. }, Outcome::Found(Observed::Running(started))) => {
                self.state = State::Running { started };
                effects.push(Effect::Watch(self.attempt));
                self.follow_others();
                self.end_if_wanted(context, effects);
            }
            (State::Launching, Outcome::LaunchUnclear) => {
                self.failures = self.failures.saturating_add(1);
                self.recover(false, context, effects);
            }
            (State::Recovering { began, rebooted, .. }, Outcome::Found(Observed::NeverStarted)) => {
                self.on_never_started(*began, *rebooted, context, effects)
            }
            (State::Recovering { .. }, Outcome::Found(Observed::Ended(exit)))
            | (
                State::Launching
                | State::Running { .. }
                | State::Stopping { .. }
                | State::Recovering { .. },
                Outcome::Exited(exit),
            ) => self.on_exit(&exit, context, effects),
            (State::Recovering { began, rebooted, refused, .. }, Outcome::FindFailed) => {
                let (began, rebooted, refused) = (*began, *rebooted, refused + 1);
                let again = context.now.boot.plus(pause(refused));
                self.state = State::Recovering { began, rebooted, again, refused };
                effects.push(Effect::WakeAt(again));
            }
            (State::Stopping { started, refused, .. }, Outcome::StopFailed) => {
                let (started, refused) = (*started, refused + 1);
                let again = context.now.boot.plus(pause(refused));
                self.state = State::Stopping { started, again, refused };
                effects.push(Effect::WakeAt(again));
            }
            // Late answers: the state that asked is over.
            _ => {}
        }
    }

    /// From `Waiting`: start, or end what never started, or wait on.
    fn move_on(&mut self, context: Context, effects: &mut Vec<Effect>) {
        if self.forgotten || self.desired.stop.is_some() {
            return self.end_if_wanted(context, effects);
        }
        let State::Waiting { until } = self.state else { return };
        if context.now.boot < until {
            effects.push(Effect::WakeAt(until));
        } else if let Some(due) = self.stands_by_until(context) {
            self.say(Reason::Standby, "stands by".to_owned());
            effects.push(Effect::WakeAt(due));
        } else if self.waits_for_others() {
            // Told anew when one of them has come farther.
        } else if self.in_contact(context) {
            if !std::mem::take(&mut self.unused) {
                self.attempt += 1;
            }
            self.fetched = false;
            if self.fetch_always {
                self.prepare(effects);
            } else {
                self.launch(effects);
            }
        } else {
            self.say(Reason::AwaitingContact, "waits for contact with the controller".to_owned());
            // It may be back, by a word that was on its way, without anybody saying so.
            effects.push(Effect::WakeAt(context.now.boot.plus(RETRY_MS.0)));
        }
    }

    /// Until when nothing of it begins, if there is no contact till then; none: it does not stand by, or no longer. What has
    /// begun once, on whosever word, goes on as other tasks do.
    fn stands_by_until(&self, context: Context) -> Option<Boot> {
        let after = self.desired.standby_ms.filter(|_| self.attempt == 0)?;
        // Without any contact since the machine started, it counts from there.
        let due = context.contact.unwrap_or(Boot(0)).plus(after);
        (due > context.now.boot).then_some(due)
    }

    fn in_contact(&self, context: Context) -> bool {
        let Some(limit) = self.desired.stop_after_ms else { return true };
        context.contact.is_some_and(|at| context.now.boot.0.saturating_sub(at.0) < limit)
    }

    fn prepare(&mut self, effects: &mut Vec<Effect>) {
        self.state = State::Preparing;
        if self.work {
            let message = "waits until its executor has registered".to_owned();
            self.say(Reason::AwaitingExecutor, message);
        }
        effects.push(Effect::Prepare(self.attempt));
    }

    fn launch(&mut self, effects: &mut Vec<Effect>) {
        self.state = State::Launching;
        self.forget_verdicts();
        let standing = self.standing.as_ref();
        self.began_with = standing.map(|s| s.attempts.clone()).unwrap_or_default();
        self.say(Reason::None, String::new());
        effects.push(Effect::Launch(self.attempt));
    }

    fn recover(&mut self, rebooted: bool, context: Context, effects: &mut Vec<Effect>) {
        let (began, rebooted) = match self.state {
            State::Recovering { began, rebooted: before, .. } => (began, before || rebooted),
            State::Launching => (false, rebooted),
            _ => (true, rebooted),
        };
        let again = context.now.boot.plus(STOP_AGAIN_MS);
        self.state = State::Recovering { began, rebooted, again, refused: 0 };
        effects.push(Effect::Find(self.attempt));
    }

    fn on_never_started(
        &mut self,
        began: bool,
        rebooted: bool,
        context: Context,
        effects: &mut Vec<Effect>,
    ) {
        // What a runtime wrote just before a power cut may be gone: after a boot, a launch that was
        // under way counts as one that happened.
        if began || rebooted {
            let end = End::Lost(match (rebooted, self.work, self.prepare) {
                (true, ..) => Loss::Reboot,
                (false, true, _) => Loss::Executor,
                (false, false, true) => Loss::Container,
                (false, false, false) => Loss::Shim,
            });
            let started_at = self.report.content.started_at;
            let exit = Exit {
                end,
                oom_killed: false,
                disconnected: false,
                started_at,
                finished_at: context.now.wall,
            };
            self.on_exit(&exit, context, effects);
        } else if self.forgotten || self.desired.stop.is_some() {
            self.ended_unstarted(context, effects);
        } else if self.failures > 0 {
            // A launch that dies before it says anything may do so every time: not in a tight loop.
            self.unused = true;
            self.failed = self.failed.saturating_add(1);
            let reason = Reason::Runtime("LaunchUnclear".to_owned());
            let message = "its launch ended without an answer";
            if self.is_given_up() {
                self.ended_unable(reason, message, context);
            } else {
                self.wait(reason, message, context, effects);
            }
        } else if self.in_contact(context) && self.desired.depends.is_empty() {
            // The same number: nothing of it ever ran.
            self.launch(effects);
        } else {
            self.unused = true;
            self.state = State::Waiting { until: context.now.boot };
            self.move_on(context, effects);
        }
    }

    fn on_exit(&mut self, exit: &Exit, context: Context, effects: &mut Vec<Effect>) {
        let mut content = self.report_draft();
        content.exit_code = exit.code();
        content.signal = exit.signal();
        content.started_at = exit.started_at.or(content.started_at);
        content.finished_at = Some(exit.finished_at);
        (content.reason, content.message) = explain(exit);
        // A program that ends well when it is asked to was not let finish either.
        let obeyed =
            content.reason == Reason::Completed && matches!(self.state, State::Stopping { .. });
        if let Some(order) = &self.desired.stop
            && (obeyed
                || matches!(content.reason, Reason::Error | Reason::StartError | Reason::Killed))
        {
            content.reason = Reason::Stopped;
            content.message.clone_from(&order.reason);
        }
        let by_itself =
            matches!(content.reason, Reason::Completed | Reason::Error | Reason::Killed);
        if let Some(failed) = self.condemned_for().filter(|_| by_itself) {
            (content.reason, content.message) = failed;
        }
        self.count_failure(exit);
        content.failed_attempts = self.failed;
        let again = self.runs_again(exit);
        let condemned = self.condemned.take();
        let follows = matches!(condemned, Some(Condemned::Dependency { .. }));
        if again {
            self.restarts += 1;
            content.restarts = self.restarts;
            if follows {
                // It was ended for another task, however its program took that.
                (content.exit_code, content.signal) = (None, None);
            }
        } else {
            let well = exit.succeeded() && condemned.is_none();
            content.phase = if well { Phase::Succeeded } else { Phase::Failed };
        }
        let (reason, message) = (content.reason.clone(), content.message.clone());
        self.report.update(content);
        if again {
            if !follows {
                self.failures = restart::failures_after(self.failures, exit);
            }
            if follows || exit.end == End::Lost(Loss::Reboot) {
                self.state = State::Waiting { until: context.now.boot };
                self.move_on(context, effects);
            } else {
                let why = if message.is_empty() { reason.to_string() } else { message };
                self.wait(Reason::BackOff, &why, context, effects);
            }
        } else {
            self.state = State::Ended;
            self.end_if_wanted(context, effects);
        }
    }

    fn wait(&mut self, reason: Reason, message: &str, context: Context, effects: &mut Vec<Effect>) {
        let delay = restart::delay_ms(self.failures);
        let until = context.now.boot.plus(delay);
        self.state = State::Waiting { until };
        self.say(reason, format!("{message}; starts again in {} s", delay.div_ceil(1_000)));
        effects.push(Effect::WakeAt(until));
    }

    /// Brings the task nearer to its end if it is to end.
    fn end_if_wanted(&mut self, context: Context, effects: &mut Vec<Effect>) {
        if !self.forgotten && self.desired.stop.is_none() && self.condemned.is_none() {
            return;
        }
        match self.state {
            State::Waiting { .. } => self.ended_unstarted(context, effects),
            State::Preparing => {
                effects.push(Effect::CancelPrepare);
                self.ended_unstarted(context, effects);
            }
            // Nobody may ever answer for it: an executor is free to take its time.
            State::Launching if self.work => {
                self.stop(context, effects);
                effects.push(Effect::Watch(self.attempt));
            }
            State::Running { .. } | State::Stopping { .. } => self.stop(context, effects),
            State::Ended if self.forgotten => self.remove(context, effects),
            // Their runtime's answer comes first; it leads back to here.
            State::Launching | State::Recovering { .. } | State::Ended | State::Removing { .. } => {
            }
        }
    }

    fn stop(&mut self, context: Context, effects: &mut Vec<Effect>) {
        let grace_ms =
            self.desired.stop.as_ref().map_or(self.desired.grace_ms, |order| order.grace_ms);
        let (started, refused) = match self.state {
            State::Running { started } => (Some(started), 0),
            State::Stopping { started, refused, .. } => (started, refused),
            _ => (None, 0),
        };
        let again = context.now.boot.plus(grace_ms.saturating_add(STOP_AGAIN_MS));
        self.state = State::Stopping { started, again, refused };
        let why = self.desired.stop.as_ref().map(|order| order.reason.clone()).unwrap_or_default();
        let (reason, why) = self.condemned_for().unwrap_or((Reason::Stopped, why));
        self.say(reason, why);
        effects.push(Effect::Stop { attempt: self.attempt, grace_ms });
        effects.push(Effect::WakeAt(again));
    }

    /// The end of a task of which nothing runs now; an earlier attempt's figures stay.
    fn ended_unstarted(&mut self, context: Context, effects: &mut Vec<Effect>) {
        self.state = State::Ended;
        let mut content = self.report_draft();
        content.phase = Phase::Failed;
        content.reason = Reason::Stopped;
        content.message = match &self.desired.stop {
            Some(order) => order.reason.clone(),
            None => "no longer assigned".to_owned(),
        };
        content.finished_at = content.finished_at.or(Some(context.now.wall));
        self.report.update(content);
        if self.forgotten {
            self.remove(context, effects);
        }
    }

    fn remove(&mut self, context: Context, effects: &mut Vec<Effect>) {
        self.state = State::Removing { again: context.now.boot.plus(STOP_AGAIN_MS), refused: 0 };
        effects.push(Effect::Remove);
    }

    fn report_draft(&self) -> Content {
        let mut content = self.report.content.clone();
        content.attempt = self.attempt;
        content.restarts = self.restarts;
        content.failed_attempts = self.failed;
        content
    }

    fn say(&mut self, reason: Reason, message: String) {
        let mut content = self.report_draft();
        content.reason = reason;
        content.message = message;
        self.report.update(content);
    }

    /// What the report must say in the present state.
    fn content(&self) -> Content {
        let mut content = self.report_draft();
        match &self.state {
            State::Waiting { .. } | State::Preparing | State::Launching => {
                content.phase = Phase::Starting;
            }
            State::Running { started } => {
                content.phase = Phase::Running;
                content.started_at = Some(started.at);
                (content.reason, content.message) = (Reason::None, String::new());
                (content.exit_code, content.signal, content.finished_at) = (None, None, None);
            }
            State::Stopping { .. } => content.phase = Phase::Stopping,
            // What was last said is still the best that is known.
            State::Recovering { .. } | State::Ended | State::Removing { .. } => {}
        }
        self.say_ready(&mut content);
        content
    }
}

fn pause(refused: u32) -> u64 {
    (RETRY_MS.0 << refused.saturating_sub(1).min(10)).min(RETRY_MS.1)
}
