//! Tests of tasks that stand by.

use muster_api::id::TaskUid;

use super::{Context, Effect, Event, Fetch, Workload};
use crate::desired::{Desired, StopOrder};
use crate::report::{Phase, Reason};
use crate::time::{Boot, Now, Wall};

const AFTER: u64 = 5_000;

fn at(boot: u64, contact: Option<u64>) -> Context {
    Context { now: Now { boot: Boot(boot), wall: Wall(0) }, contact: contact.map(Boot) }
}

fn standing_by() -> Desired {
    Desired { standby_ms: Some(AFTER), ..Desired::once(0) }
}

fn begun() -> Workload {
    let (uid, context) = (TaskUid::new("t"), at(10_000, Some(9_900)));
    let (task, response) = Workload::assigned(uid, standing_by(), Fetch::Nothing, context);
    assert!(response.effects.contains(&Effect::WakeAt(Boot(14_900))), "{response:?}");
    let content = &task.report.content;
    assert_eq!((content.phase, &content.reason), (Phase::Starting, &Reason::Standby));
    task
}

fn tick(task: &mut Workload, context: Context) -> Vec<Effect> {
    task.handle(Event::Tick, context).effects
}

#[test]
fn it_begins_when_there_was_no_contact_for_so_long_and_not_before() {
    let mut task = begun();
    // There was contact meanwhile.
    assert_eq!(tick(&mut task, at(14_900, Some(12_000))), [Effect::WakeAt(Boot(17_000))]);
    assert_eq!(tick(&mut task, at(16_999, Some(12_000))), [Effect::WakeAt(Boot(17_000))]);
    assert!(tick(&mut task, at(17_000, Some(12_000))).contains(&Effect::Launch(1)));
    // There is contact again, and another attempt is the task's own affair.
    let again = task.handle(Event::Assigned(standing_by()), at(18_000, Some(17_900)));
    assert!(!again.effects.iter().any(|e| matches!(e, Effect::Stop { .. })), "{again:?}");
}

#[test]
fn it_begins_when_it_is_let_go() {
    let mut task = begun();
    let context = at(11_000, Some(10_900));
    let effects = task.handle(Event::Assigned(Desired::once(0)), context).effects;
    assert!(effects.contains(&Effect::Launch(1)), "{effects:?}");
}

#[test]
fn it_is_told_to_end_without_ever_having_begun() {
    let mut task = begun();
    let stop = Some(StopOrder { grace_ms: 0, reason: "Deleted".to_owned() });
    let order = Event::Assigned(Desired { stop, ..standing_by() });
    let effects = task.handle(order, at(11_000, Some(10_900))).effects;
    assert!(!effects.contains(&Effect::Launch(1)), "{effects:?}");
    assert_eq!((task.report.content.phase, task.attempt), (Phase::Failed, 0));
}

#[test]
fn a_machine_that_was_never_in_contact_counts_from_its_start() {
    let (uid, desired) = (TaskUid::new("t"), standing_by());
    let (mut task, response) = Workload::assigned(uid, desired, Fetch::Nothing, at(4_000, None));
    assert!(response.effects.contains(&Effect::WakeAt(Boot(AFTER))), "{response:?}");
    assert!(tick(&mut task, at(AFTER, None)).contains(&Effect::Launch(1)));
}
