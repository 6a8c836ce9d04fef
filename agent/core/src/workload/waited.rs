//! What the tasks that a task waits for change: when an attempt begins, and the end of one that began before they were
//! started again.

use super::{Condemned, Context, Effect, Reason, State, Workload};
use crate::depend::Standing;

impl Workload {
    pub(super) fn on_dependencies(
        &mut self,
        standing: Standing,
        context: Context,
        effects: &mut Vec<Effect>,
    ) {
        self.standing = Some(standing);
        match self.state {
            State::Waiting { .. } => self.move_on(context, effects),
            State::Launching | State::Running { .. } => {
                self.follow_others();
                self.end_if_wanted(context, effects);
            }
            // One that is being looked for follows when it is found to run.
            _ => {}
        }
    }

    /// Condemns an attempt that began before a task that it follows was started again. Work is its executor's to begin
    /// again.
    pub(super) fn follow_others(&mut self) {
        let standing = self.standing.as_ref().filter(|_| !self.work && self.condemned.is_none());
        let task = standing.and_then(|standing| standing.restarted_since(&self.began_with));
        if let Some(task) = task.map(str::to_owned) {
            self.condemned = Some(Condemned::Dependency { task });
        }
    }

    /// Whether an attempt must not begin yet; then it is said why.
    pub(super) fn waits_for_others(&mut self) -> bool {
        if self.desired.depends.is_empty() {
            return false;
        }
        match &self.standing {
            // They are looked at first.
            None => true,
            Some(Standing { unmet: None, .. }) => false,
            Some(Standing { unmet: Some(why), .. }) => {
                let why = why.clone();
                self.say(Reason::AwaitingDependency, why);
                true
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;

    use muster_api::id::TaskUid;
    use muster_api::kind::task::depend::DependencyCondition;

    use super::super::{Event, Fetch, Outcome};
    use super::*;
    use crate::depend::Dependency;
    use crate::desired::{Desired, RestartPolicy};
    use crate::observed::{End, Exit, Loss, Observed, Started};
    use crate::report::Phase;
    use crate::time::{Boot, Now, Wall};

    fn context() -> Context {
        Context { now: Now { boot: Boot(5), wall: Wall(5) }, contact: None }
    }

    fn standing(unmet: Option<&str>, attempt: u32) -> Standing {
        let attempts = BTreeMap::from([("camera".to_owned(), ("c".to_owned(), attempt))]);
        Standing { unmet: unmet.map(str::to_owned), attempts }
    }

    fn assigned(restart: RestartPolicy) -> (Workload, Vec<Effect>) {
        let camera = Dependency {
            task: "camera".to_owned(),
            uid: "c".to_owned(),
            condition: DependencyCondition::Ready,
            restart: true,
            unmet: None,
            attempt: 1,
        };
        let desired = Desired { restart, depends: vec![camera], ..Desired::once(7_000) };
        let (task, response) =
            Workload::assigned(TaskUid::new("t"), desired, Fetch::Nothing, context());
        (task, response.effects)
    }

    fn told(task: &mut Workload, standing: Standing) -> Vec<Effect> {
        task.handle(Event::Dependencies(standing), context()).effects
    }

    fn launched(task: &mut Workload) -> Vec<Effect> {
        let outcome = Outcome::Launched(Started { at: Wall(1) });
        task.handle(Event::Attempt(task.attempt, outcome), context()).effects
    }

    fn exited(task: &mut Workload, end: End) -> Vec<Effect> {
        let exit = Exit {
            end,
            oom_killed: false,
            disconnected: false,
            started_at: Some(Wall(1)),
            finished_at: Wall(2),
        };
        task.handle(Event::Attempt(task.attempt, Outcome::Exited(exit)), context()).effects
    }

    #[test]
    fn nothing_begins_before_the_others_have_come_so_far() {
        let (mut task, effects) = assigned(RestartPolicy::Never);
        assert!(!effects.contains(&Effect::Launch(1)), "{effects:?}");
        let effects =
            told(&mut task, standing(Some("waits for task camera, which is Starting"), 0));
        assert!(!effects.contains(&Effect::Launch(1)), "{effects:?}");
        let content = &task.report.content;
        assert_eq!(
            (content.phase, &content.reason),
            (Phase::Starting, &Reason::AwaitingDependency)
        );
        assert_eq!(content.message, "waits for task camera, which is Starting");
        assert!(told(&mut task, standing(None, 1)).contains(&Effect::Launch(1)));
        let _ = launched(&mut task);
        // One that goes down does not take this one with it.
        let effects = told(&mut task, standing(Some("is Starting"), 1));
        assert_eq!(effects, [Effect::Persist, Effect::Publish]);
        assert_eq!(task.report.content.phase, Phase::Running);
    }

    #[test]
    fn a_new_start_of_another_is_one_of_its_own_whatever_the_policy_and_without_back_off() {
        for policy in [RestartPolicy::Never, RestartPolicy::OnFailure, RestartPolicy::Always] {
            for end in [End::Exited(0), End::Signaled(9)] {
                let (mut task, _) = assigned(policy);
                let _ = told(&mut task, standing(None, 1));
                let _ = launched(&mut task);
                let stop = Effect::Stop { attempt: 1, grace_ms: 7_000 };
                assert!(told(&mut task, standing(Some("is Starting"), 2)).contains(&stop));
                assert_eq!(task.report.content.reason, Reason::DependencyRestarted);
                let effects = exited(&mut task, end);
                assert!(!effects.contains(&Effect::Launch(2)), "the camera is not ready yet");
                assert_eq!((task.report.content.phase, task.failures), (Phase::Starting, 0));
                assert!(told(&mut task, standing(None, 2)).contains(&Effect::Launch(2)));
                let _ = launched(&mut task);
                assert_eq!(told(&mut task, standing(None, 2)), [], "it began after that");
            }
        }
    }

    #[test]
    fn the_order_holds_again_after_a_reboot_and_for_another_life_of_the_agent() {
        let (mut task, _) = assigned(RestartPolicy::Always);
        let _ = told(&mut task, standing(None, 1));
        let _ = launched(&mut task);
        // Another life, the same attempt: nothing is started again for having looked again.
        let _ = task.restored(true, context());
        let found = Outcome::Found(Observed::Running(Started { at: Wall(1) }));
        let _ = task.handle(Event::Attempt(1, found), context());
        assert!(
            !told(&mut task, standing(None, 1)).iter().any(|e| matches!(e, Effect::Stop { .. }))
        );
        // A reboot: what was known before it does not count.
        let _ = task.restored(false, context());
        let effects = exited(&mut task, End::Lost(Loss::Reboot));
        assert!(!effects.contains(&Effect::Launch(2)), "{effects:?}");
        assert!(told(&mut task, standing(None, 2)).contains(&Effect::Launch(2)));
    }
}
