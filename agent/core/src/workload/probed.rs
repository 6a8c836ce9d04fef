//! What a task's probes change: whether it is said to be ready, and the end of an attempt that failed them.

use serde::{Deserialize, Serialize};

use super::{Content, Context, Effect, Reason, State, Workload};
use crate::desired::RestartPolicy;
use crate::observed::Exit;
use crate::probe::{Role, Verdict};
use crate::restart;

/// Why an attempt is ended.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub enum Condemned {
    /// A probe of it failed.
    Probe {
        /// Which.
        role: Role,
        /// Its words.
        why: String,
    },
    /// A task that it depends on was started again.
    Dependency {
        /// The task's name.
        task: String,
    },
}

impl Workload {
    /// What was found of an attempt that has ended, or is being ended, says nothing.
    pub(super) fn on_verdict(
        &mut self,
        verdict: Verdict,
        context: Context,
        effects: &mut Vec<Effect>,
    ) {
        if !matches!(self.state, State::Running { .. }) {
            return;
        }
        match verdict {
            Verdict::Failed { role, why } => {
                self.condemned = Some(Condemned::Probe { role, why });
                self.end_if_wanted(context, effects);
            }
            verdict => self.verdicts.take(&verdict),
        }
    }

    /// Nothing is known of an attempt that is about to begin.
    pub(super) fn forget_verdicts(&mut self) {
        (self.verdicts, self.condemned) = Default::default();
    }

    /// Puts into a report whether the task is ready, and of a running one why not.
    pub(super) fn say_ready(&self, content: &mut Content) {
        let probes = &self.desired.probes;
        match self.state {
            State::Running { .. } => {
                let missing = self.verdicts.missing(probes);
                content.ready = probes.tell_ready().then_some(missing.is_none());
                let reason = match missing {
                    None => return,
                    Some(Role::Startup) => Reason::StartingUp,
                    Some(Role::Readiness | Role::Liveness) => Reason::NotReady,
                };
                let said = &self.verdicts.why;
                content.reason = reason;
                content.message = match missing.filter(|_| said.is_empty()) {
                    Some(role) => format!("its {role} has not succeeded yet"),
                    None => format!("its {said}"),
                };
            }
            // It may run on: what was last said stands until something new is found.
            State::Recovering { .. } => {}
            _ => content.ready = probes.tell_ready().then_some(false),
        }
    }

    /// Why an attempt is being ended that nobody ordered to end.
    pub(super) fn condemned_for(&self) -> Option<(Reason, String)> {
        let condemned = self.condemned.as_ref().filter(|_| self.desired.stop.is_none())?;
        Some(match condemned {
            Condemned::Probe { role, why } => (Reason::failed(*role), format!("its {why}")),
            Condemned::Dependency { task } => {
                (Reason::DependencyRestarted, format!("task {task} was started again"))
            }
        })
    }

    /// Whether another attempt follows. One that was ended for its probe has failed, however its program took that; one
    /// that was ended for another task follows it in any case.
    pub(super) fn runs_again(&self, exit: &Exit) -> bool {
        let policy = match (self.desired.restart, &self.condemned) {
            (RestartPolicy::OnFailure, Some(_)) | (_, Some(Condemned::Dependency { .. })) => {
                RestartPolicy::Always
            }
            (policy, _) => policy,
        };
        let may = self.desired.stop.is_none() && !self.forgotten;
        may && !(self.has_failed(exit) && self.is_given_up()) && restart::restarts(policy, exit)
    }
}

#[cfg(test)]
mod tests {
    use muster_api::id::TaskUid;

    use super::super::{Event, Fetch, Outcome};
    use super::*;
    use crate::desired::{Desired, StopOrder};
    use crate::observed::{End, Observed, Started};
    use crate::probe::{Probes, Timing};
    use crate::report::Phase;
    use crate::time::{Boot, Now, Wall};

    const TIMING: Timing =
        Timing { initial_delay_ms: 0, period_ms: 1, success_threshold: 1, failure_threshold: 1 };

    fn context() -> Context {
        Context { now: Now { boot: Boot(5), wall: Wall(5) }, contact: None }
    }

    fn desired(restart: RestartPolicy) -> Desired {
        let probes =
            Probes { startup: Some(TIMING), readiness: Some(TIMING), liveness: Some(TIMING) };
        Desired { restart, probes, ..Desired::once(7_000) }
    }

    fn running(restart: RestartPolicy) -> Workload {
        let (mut task, _) =
            Workload::assigned(TaskUid::new("t"), desired(restart), Fetch::Nothing, context());
        assert_eq!(task.report.content.ready, Some(false));
        let _ = launched(&mut task);
        task
    }

    fn launched(task: &mut Workload) -> Vec<Effect> {
        let outcome = Outcome::Launched(Started { at: Wall(1) });
        task.handle(Event::Attempt(task.attempt, outcome), context()).effects
    }

    fn say(task: &mut Workload, verdict: Verdict) -> Vec<Effect> {
        task.handle(Event::Probed(task.attempt, verdict), context()).effects
    }

    fn failed() -> Verdict {
        Verdict::Failed { role: Role::Liveness, why: "liveness probe failed: no".to_owned() }
    }

    fn exit(end: End) -> Exit {
        Exit {
            end,
            oom_killed: false,
            disconnected: false,
            started_at: Some(Wall(1)),
            finished_at: Wall(2),
        }
    }

    fn told(task: &Workload) -> (Option<bool>, String, String) {
        let content = task.report.content.clone();
        (content.ready, content.reason.to_string(), content.message)
    }

    #[test]
    fn it_is_ready_when_its_probes_say_so_and_says_why_not() {
        let mut task = running(RestartPolicy::Never);
        let word = |text: &str| text.to_owned();
        let (ready, reason, message) = told(&task);
        assert_eq!((ready, reason), (Some(false), word("StartingUp")));
        assert_eq!(message, "its start-up probe has not succeeded yet");
        let effects = say(&mut task, Verdict::Started);
        assert_eq!(effects, [Effect::Persist, Effect::Publish], "durable before it is told");
        assert_eq!(told(&task).1, "NotReady");
        let _ = say(&mut task, Verdict::Ready);
        assert_eq!(told(&task), (Some(true), String::new(), String::new()));
        let why = word("readiness probe failed: exited with code 1");
        let _ = say(&mut task, Verdict::NotReady { why });
        let message = word("its readiness probe failed: exited with code 1");
        assert_eq!(told(&task), (Some(false), word("NotReady"), message));
        let stale = Event::Probed(task.attempt - 1, Verdict::Ready);
        assert_eq!(task.handle(stale, context()).effects, [], "of an earlier attempt");
    }

    #[test]
    fn another_life_of_the_agent_keeps_what_was_said() {
        let mut task = running(RestartPolicy::Never);
        let _ = say(&mut task, Verdict::Started);
        let _ = say(&mut task, Verdict::Ready);
        let _ = task.restored(true, context());
        assert_eq!(told(&task).0, Some(true));
        let found = Outcome::Found(Observed::Running(Started { at: Wall(1) }));
        let _ = task.handle(Event::Attempt(1, found), context());
        assert_eq!(told(&task).0, Some(true));
        let order = StopOrder { grace_ms: 1, reason: "Deleted".to_owned() };
        let desired = Desired { stop: Some(order), ..desired(RestartPolicy::Never) };
        let _ = task.handle(Event::Assigned(desired), context());
        assert_eq!((task.report.content.phase, told(&task).0), (Phase::Stopping, Some(false)));
        assert_eq!(say(&mut task, Verdict::Ready), [], "it is being ended");
    }

    #[test]
    fn a_failed_probe_ends_the_attempt_by_the_ladder_and_counts_as_a_failure() {
        for (policy, phase) in [
            (RestartPolicy::Never, Phase::Failed),
            (RestartPolicy::OnFailure, Phase::Starting),
            (RestartPolicy::Always, Phase::Starting),
        ] {
            // A program that ends well when it is asked to has failed all the same.
            for end in [End::Exited(0), End::Exited(3), End::Signaled(9)] {
                let mut task = running(policy);
                let stop = Effect::Stop { attempt: 1, grace_ms: 7_000 };
                assert!(say(&mut task, failed()).contains(&stop));
                assert_eq!(told(&task).1, "LivenessFailed");
                let _ = task.handle(Event::Attempt(1, Outcome::Exited(exit(end))), context());
                let content = &task.report.content;
                assert_eq!((content.phase, content.ready), (phase, Some(false)), "{policy:?}");
                assert!(
                    content.message.starts_with("its liveness probe failed: no"),
                    "{content:?}"
                );
                if policy == RestartPolicy::Never {
                    assert_eq!(content.reason, Reason::LivenessFailed);
                } else {
                    assert_eq!((&content.reason, task.failures), (&Reason::BackOff, 1));
                    let State::Waiting { until } = task.state else { panic!("{:?}", task.state) };
                    assert_eq!(until, Boot(5 + restart::BASE_MS), "as after a crash");
                }
            }
        }
    }

    #[test]
    fn an_attempt_that_failed_is_ended_by_another_life_too_and_the_next_begins_anew() {
        let mut task = running(RestartPolicy::Always);
        let _ = say(&mut task, Verdict::Started);
        let _ = say(&mut task, failed());
        let _ = task.restored(true, context());
        let found = Outcome::Found(Observed::Running(Started { at: Wall(1) }));
        let effects = task.handle(Event::Attempt(1, found), context()).effects;
        assert!(effects.contains(&Effect::Stop { attempt: 1, grace_ms: 7_000 }), "{effects:?}");
        assert_eq!(told(&task).1, "LivenessFailed");
        let lost = Outcome::Exited(exit(End::Signaled(9)));
        let _ = task.handle(Event::Attempt(1, lost), context());
        let later = Now { boot: Boot(90_000), wall: Wall(90_000) };
        let _ = task.handle(Event::Tick, Context { now: later, contact: None });
        let _ = launched(&mut task);
        assert_eq!((task.attempt, told(&task).1.as_str()), (2, "StartingUp"));
    }

    #[test]
    fn an_order_and_an_end_of_its_own_go_before_the_probe() {
        let mut task = running(RestartPolicy::Always);
        let _ = say(&mut task, failed());
        let order = StopOrder { grace_ms: 1, reason: "Deleted".to_owned() };
        let desired = Desired { stop: Some(order), ..desired(RestartPolicy::Always) };
        let _ = task.handle(Event::Assigned(desired), context());
        let ended = Outcome::Exited(exit(End::Signaled(9)));
        let _ = task.handle(Event::Attempt(1, ended), context());
        assert_eq!(told(&task).1, "Stopped");
        let mut task = running(RestartPolicy::Never);
        let _ = say(&mut task, failed());
        let oom = Exit { oom_killed: true, ..exit(End::Signaled(9)) };
        let _ = task.handle(Event::Attempt(1, Outcome::Exited(oom)), context());
        assert_eq!(told(&task).1, "OOMKilled");
    }
}
