//! Tests of asking what became of an attempt.

use muster_api::id::TaskUid;

use super::{Context, Effect, Event, Fetch, STOP_AGAIN_MS, Workload};
use crate::desired::Desired;
use crate::event::Outcome;
use crate::time::{Boot, Now, Wall};

fn at(boot: u64) -> Context {
    Context { now: Now { boot: Boot(boot), wall: Wall(0) }, contact: Some(Boot(boot)) }
}

fn asks(task: &mut Workload, event: Event, boot: u64) -> usize {
    let effects = task.handle(event, at(boot)).effects;
    effects.iter().filter(|effect| matches!(effect, Effect::Find(_))).count()
}

#[test]
fn one_question_is_under_way_at_a_time() {
    let (uid, desired) = (TaskUid::new("t"), Desired::once(0));
    let (mut task, _) = Workload::assigned(uid, desired, Fetch::Nothing, at(0));
    assert_eq!(asks(&mut task, Event::Attempt(1, Outcome::LaunchUnclear), 10), 1);
    assert_eq!(asks(&mut task, Event::Attempt(1, Outcome::FindFailed), 20), 0);
    // The runtime is asked again after a moment; ticks come for all sorts of reasons.
    let asked = [5_000, 5_001, 5_002].map(|boot| asks(&mut task, Event::Tick, boot));
    assert_eq!(asked, [1, 0, 0]);
    assert_eq!(asks(&mut task, Event::Tick, 5_000 + STOP_AGAIN_MS), 1, "there was no answer");
}
