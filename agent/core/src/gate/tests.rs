use proptest::prelude::*;

use super::*;

const A: Conn = Conn(1);
const B: Conn = Conn(2);

fn uid(name: &str) -> TaskUid {
    TaskUid::new(name)
}

fn grant(epoch: u64, holder: &str) -> Event {
    Event::Granted(Some(Grant { epoch: Epoch(epoch), holder: uid(holder) }))
}

fn token(text: &str) -> Token {
    text.parse().unwrap()
}

/// A gate with its agent, `a` and `b` connected, the robot granted to `a` with epoch 6.
fn gate() -> Gate {
    let (mut gate, response) = Gate::start(Settings::default(), Kept::default());
    assert_eq!(response.effects, [Effect::Stop(StopReason::GateStarts)]);
    for event in [Event::Opened(A, uid("a")), Event::Opened(B, uid("b")), grant(6, "a")] {
        let _ = gate.handle(&event, Boot(0));
    }
    gate
}

fn verdict(gate: &mut Gate, conn: Conn, text: &str) -> Verdict {
    let response = gate.handle(&Event::Command(conn, token(text)), Boot(0));
    let forwarded = response.effects.contains(&Effect::Forward);
    let Some(Effect::Answer(verdict)) = response.effects.last() else { panic!("{response:?}") };
    assert_eq!(forwarded, *verdict == Verdict::Ok);
    *verdict
}

fn stops(response: &Response) -> Vec<StopReason> {
    let stop = |effect: &Effect| match effect {
        Effect::Stop(why) => Some(*why),
        _ => None,
    };
    response.effects.iter().filter_map(stop).collect()
}

#[test]
fn only_the_holder_drives() {
    let mut gate = gate();
    assert_eq!(verdict(&mut gate, A, "6"), Verdict::Ok);
    assert_eq!(verdict(&mut gate, B, "6"), Verdict::NotHolder);
    assert_eq!(verdict(&mut gate, B, "7"), Verdict::Unknown);
    assert_eq!(verdict(&mut gate, A, "5"), Verdict::Older);
    assert_eq!(verdict(&mut gate, Conn(9), "6"), Verdict::NotHolder);
}

#[test]
fn a_grant_that_is_taken_back_counts_at_once_and_stops_the_robot() {
    let mut gate = gate();
    assert_eq!(verdict(&mut gate, A, "6"), Verdict::Ok);
    let response = gate.handle(&grant(7, "b"), Boot(1));
    let kept = Kept { newest: token("7"), estop: EStop::default() };
    assert_eq!(
        response.effects,
        [Effect::Stop(StopReason::Revoked), Effect::Keep(kept), Effect::Report]
    );
    assert_eq!(verdict(&mut gate, A, "6"), Verdict::Revoked);
    assert_eq!(verdict(&mut gate, A, "7"), Verdict::NotHolder);
    assert_eq!(verdict(&mut gate, B, "7"), Verdict::Ok);
    // Said again, it changes nothing.
    assert!(stops(&gate.handle(&grant(7, "b"), Boot(2))).is_empty());
    assert_eq!(stops(&gate.handle(&Event::Granted(None), Boot(3))), [StopReason::Revoked]);
    assert_eq!(verdict(&mut gate, B, "7"), Verdict::Revoked);
    // An older grant does not come back, and a number has one task.
    for event in [grant(6, "a"), grant(7, "a")] {
        let _ = gate.handle(&event, Boot(4));
        assert_eq!(gate.holder(), None);
    }
    let _ = gate.handle(&grant(7, "b"), Boot(5));
    assert_eq!(verdict(&mut gate, B, "7"), Verdict::Ok);
    // While the newer holder is gone and the older one still ends, nobody holds it.
    assert_eq!(stops(&gate.handle(&grant(6, "a"), Boot(6))), [StopReason::Revoked]);
    assert_eq!(gate.holder(), None);
}

#[test]
fn delegates_are_outranked_by_who_delegated() {
    let mut gate = gate();
    let delegate = |conn, text: &str, to: &str| Event::Delegate(conn, token(text), uid(to));
    let answer = |response: Response| response.effects.last().cloned();
    assert_eq!(verdict(&mut gate, A, "6,0"), Verdict::Ok);
    assert_eq!(verdict(&mut gate, A, "6"), Verdict::Older, "a super-lease of what was used");
    let of_nothing = gate.handle(&delegate(B, "6,1", "b"), Boot(0));
    assert_eq!(answer(of_nothing), Some(Effect::Answer(Verdict::NotHolder)));
    let handed = gate.handle(&delegate(A, "6,1", "b"), Boot(0));
    assert_eq!(answer(handed), Some(Effect::Answer(Verdict::Ok)));
    assert_eq!(verdict(&mut gate, A, "6,0"), Verdict::Older);
    assert_eq!(verdict(&mut gate, B, "6,1"), Verdict::Ok);
    assert_eq!(verdict(&mut gate, B, "6,1,4"), Verdict::Ok);
    assert_eq!(verdict(&mut gate, B, "6,2"), Verdict::NotHolder);
    let all = gate.handle(&delegate(B, "6,1,4", "c"), Boot(0));
    assert_eq!(answer(all), Some(Effect::Answer(Verdict::Ok)), "a part of what it has");
    assert_eq!(verdict(&mut gate, A, "6,2"), Verdict::Ok);
    assert_eq!(verdict(&mut gate, B, "6,1,5"), Verdict::Older);
}

#[test]
fn who_drove_and_is_gone_leaves_a_robot_that_stands() {
    let mut gate = gate();
    assert!(stops(&gate.handle(&Event::Closed(B), Boot(0))).is_empty(), "it did not drive");
    assert_eq!(verdict(&mut gate, A, "6"), Verdict::Ok);
    assert_eq!(stops(&gate.handle(&Event::Closed(A), Boot(1))), [StopReason::HolderGone]);
    assert!(!gate.is_driven());
}

#[test]
fn who_drove_and_is_silent_is_stopped_once() {
    let mut gate = gate();
    let response = gate.handle(&Event::Command(A, token("6")), Boot(1_000));
    assert_eq!(response.wake, Some(Boot(1_200)));
    assert!(stops(&gate.handle(&Event::Tick, Boot(1_199))).is_empty());
    let response = gate.handle(&Event::Tick, Boot(1_200));
    assert_eq!((stops(&response), response.wake), (vec![StopReason::Silent], None));
    assert!(stops(&gate.handle(&Event::Tick, Boot(9_000))).is_empty());
    // The next command drives again. One that comes too late comes after the stop.
    let _ = gate.handle(&Event::Command(A, token("6")), Boot(9_000));
    let late = gate.handle(&Event::Command(A, token("6")), Boot(9_900));
    assert_eq!(
        late.effects,
        [Effect::Stop(StopReason::Silent), Effect::Forward, Effect::Answer(Verdict::Ok)]
    );
}

#[test]
fn without_its_agent_nobody_drives() {
    let mut gate = gate();
    assert_eq!(verdict(&mut gate, A, "6"), Verdict::Ok);
    assert_eq!(stops(&gate.handle(&Event::AgentGone, Boot(1))), [StopReason::AgentGone]);
    assert_eq!(verdict(&mut gate, A, "6"), Verdict::Unknown);
    let _ = gate.handle(&grant(6, "a"), Boot(2));
    assert_eq!(verdict(&mut gate, A, "6"), Verdict::Ok);
    // One that goes in order is waited for.
    let leaves = gate.handle(&Event::AgentLeaves { back_within_ms: 5_000 }, Boot(10));
    assert!(stops(&leaves).is_empty());
    assert!(stops(&gate.handle(&Event::AgentGone, Boot(20))).is_empty());
    assert_eq!(verdict(&mut gate, A, "6"), Verdict::Ok);
    let waited = gate.handle(&Event::Tick, Boot(5_010));
    assert!(stops(&waited).contains(&StopReason::AgentGone));
    assert_eq!(verdict(&mut gate, A, "6"), Verdict::Unknown);
}

#[test]
fn a_grant_is_given_back_when_nobody_of_it_says_anything() {
    let ladder = [(100, Action::Stop), (500, Action::Release)];
    let ladder = ladder.map(|(after_ms, action)| Step { after_ms, action }).to_vec();
    let settings = Settings { ladder, ..Settings::default() };
    let (mut gate, _) = Gate::start(settings, Kept::default());
    for event in [Event::Opened(A, uid("a")), Event::Opened(B, uid("b")), grant(6, "a")] {
        let _ = gate.handle(&event, Boot(0));
    }
    let gives = |response: &Response| {
        response
            .effects
            .iter()
            .any(|effect| matches!(effect, Effect::GiveBack(g) if g.epoch == Epoch(6)))
    };
    // Who has never driven need not say anything.
    assert!(!gives(&gate.handle(&Event::Tick, Boot(60_000))));
    let _ = gate.handle(&Event::Delegate(A, token("6,1"), uid("b")), Boot(60_000));
    let _ = gate.handle(&Event::Command(B, token("6,1")), Boot(60_000));
    // The delegate hangs, and the holder is there.
    let _ = gate.handle(&Event::Retain(A), Boot(60_400));
    // A stop in between is no sign of life.
    let stopped = gate.handle(&Event::EStop(Source::Controller, Tier::Settle), Boot(60_450));
    assert_eq!(stopped.wake, Some(Boot(60_900)));
    assert!(!gives(&gate.handle(&Event::Tick, Boot(60_899))));
    assert!(gives(&gate.handle(&Event::Tick, Boot(60_900))));
    assert!(!gives(&gate.handle(&Event::Tick, Boot(99_000))), "once");
}

#[test]
fn an_emergency_stop_is_before_everything() {
    let mut gate = gate();
    assert_eq!(verdict(&mut gate, A, "6"), Verdict::Ok);
    let stopped = gate.handle(&Event::EStop(Source::Local("b".to_owned()), Tier::Cut), Boot(1));
    assert_eq!(stopped.effects[..2], [Effect::Stop(StopReason::EStop(Tier::Cut)), Effect::Cut]);
    assert_eq!(verdict(&mut gate, A, "6"), Verdict::Stopped);
    let _ = gate.handle(&grant(7, "b"), Boot(2));
    assert_eq!(verdict(&mut gate, B, "7"), Verdict::Stopped);
    // Another gate begins where this one ended.
    let kept = Kept { newest: gate.newest().clone(), estop: gate.estop().clone() };
    let (mut gate, response) = Gate::start(Settings::default(), kept);
    assert_eq!(response.effects, [Effect::Stop(StopReason::GateStarts), Effect::Cut]);
    for event in [Event::Opened(B, uid("b")), grant(7, "b")] {
        let _ = gate.handle(&event, Boot(3));
    }
    assert_eq!(verdict(&mut gate, B, "7"), Verdict::Stopped);
    let _ = gate.handle(&Event::EStop(Source::Local("b".to_owned()), Tier::None), Boot(4));
    assert_eq!(verdict(&mut gate, B, "7"), Verdict::Stopped);
    let _ = gate.handle(&Event::Release(gate.estop().number()), Boot(5));
    assert_eq!(verdict(&mut gate, B, "7"), Verdict::Ok);
}

/// A person took the robot and returned it; the agent is started again and seats the task that drove before.
#[test]
fn what_was_granted_before_a_fence_does_not_come_back_with_an_agent_that_forgot_it() {
    let mut gate = gate();
    assert_eq!(verdict(&mut gate, A, "6"), Verdict::Ok);
    let response = gate.handle(&Event::Fenced(Epoch(7)), Boot(1));
    let kept = Kept { newest: token("7"), estop: EStop::default() };
    let stopped = Effect::Stop(StopReason::Revoked);
    assert_eq!(response.effects, [stopped, Effect::Keep(kept.clone()), Effect::Report]);
    assert_eq!(verdict(&mut gate, A, "6"), Verdict::Revoked);
    for event in [Event::AgentGone, grant(6, "a"), Event::Fenced(Epoch(0))] {
        let _ = gate.handle(&event, Boot(2));
    }
    assert_ne!(verdict(&mut gate, A, "6"), Verdict::Ok);
    // Nor at a gate that was started again.
    let (mut gate, _) = Gate::start(Settings::default(), kept);
    for event in [Event::Opened(A, uid("a")), grant(6, "a")] {
        let _ = gate.handle(&event, Boot(3));
    }
    assert_ne!(verdict(&mut gate, A, "6"), Verdict::Ok);
    // The person's own grant has the number, and is said before the fence.
    for event in [Event::Opened(B, uid("person")), grant(7, "person"), Event::Fenced(Epoch(7))] {
        let _ = gate.handle(&event, Boot(4));
    }
    assert_eq!(verdict(&mut gate, B, "7"), Verdict::Ok);
}

/// Anything that may happen, in any order.
fn events() -> impl Strategy<Value = Event> {
    let task = || (0..3_u8).prop_map(|n| uid(&n.to_string()));
    let conn = || (0..4_u64).prop_map(Conn);
    let token = || {
        let sequence = proptest::collection::vec(0..3_u32, 0..3);
        (1..6_u64, sequence).prop_map(|(epoch, sequence)| Token { epoch: Epoch(epoch), sequence })
    };
    let tier = prop_oneof![Just(Tier::None), Just(Tier::Settle), Just(Tier::Cut)];
    let source = prop_oneof![Just(Source::Controller), Just(Source::Local("b".to_owned()))];
    prop_oneof![
        3 => (1..6_u64, task()).prop_map(|(epoch, holder)| Event::Granted(Some(Grant { epoch: Epoch(epoch), holder }))),
        1 => Just(Event::Granted(None)),
        1 => (0..6_u64).prop_map(|fence| Event::Fenced(Epoch(fence))),
        1 => (0..500_u64).prop_map(|back_within_ms| Event::AgentLeaves { back_within_ms }),
        1 => Just(Event::AgentGone),
        3 => (conn(), task()).prop_map(|(conn, task)| Event::Opened(conn, task)),
        1 => conn().prop_map(Event::Closed),
        12 => (conn(), token()).prop_map(|(conn, token)| Event::Command(conn, token)),
        1 => conn().prop_map(Event::Retain),
        3 => (conn(), token(), task()).prop_map(|(conn, token, task)| Event::Delegate(conn, token, task)),
        1 => (source, tier).prop_map(|(source, tier)| Event::EStop(source, tier)),
        1 => (0..4_u64).prop_map(Event::Release),
        1 => Just(Event::DriverBack),
        3 => Just(Event::Tick),
    ]
}

proptest! {
    /// Invariant 1, the right to command: the tokens of commands that pass never go back, each was used by who holds it, and
    /// after the last command the robot is stopped as soon as its reason to move is gone.
    #[test]
    fn no_older_command_ever_passes(events in proptest::collection::vec((events(), 0..150_u64), 1..200)) {
        let (mut gate, _) = Gate::start(Settings::default(), Kept::default());
        let (mut now, mut last) = (Boot(0), None::<Token>);
        let mut conns = BTreeMap::new();
        // Whose command moves the robot, when it came.
        let mut moves: Option<(Conn, Boot)> = None;
        for (event, pause) in events {
            now = now.plus(pause);
            if matches!(&event, Event::Opened(conn, _) if conns.contains_key(conn)) {
                continue;
            }
            let holder_before = gate.holder().cloned();
            let response = gate.handle(&event, now);
            match &event {
                Event::Opened(conn, task) => drop(conns.insert(*conn, task.clone())),
                Event::Closed(conn) => drop(conns.remove(conn)),
                _ => {}
            }
            for effect in &response.effects {
                match effect {
                    Effect::Stop(_) => moves = None,
                    Effect::Forward => {
                        let Event::Command(conn, token) = &event else { panic!("{event:?}") };
                        if let Some(last) = &last {
                            let relation = token.relation(last);
                            prop_assert!(!matches!(relation, Relation::Older | Relation::Super), "{token} after {last}");
                        }
                        let holder = gate.holder().expect("somebody holds it");
                        prop_assert_eq!(token.epoch, holder.epoch);
                        if token.sequence.is_empty() {
                            prop_assert_eq!(&conns[conn], &holder.holder, "the grant itself is its holder's alone");
                        }
                        prop_assert_eq!(gate.estop().tier(), Tier::None);
                        last = Some(token.clone());
                        moves = Some((*conn, now));
                    }
                    _ => {}
                }
            }
            prop_assert_eq!(gate.is_driven(), moves.is_some());
            if let Some((conn, since)) = moves {
                prop_assert!(conns.contains_key(&conn), "it moves on for somebody who is gone");
                prop_assert!(now < since.plus(200), "it moves on without a command");
                prop_assert_eq!(gate.estop().tier(), Tier::None);
                prop_assert!(gate.holder().is_some());
                prop_assert!(!matches!(event, Event::AgentGone) || response.wake.is_some());
            }
            if let (Some(before), Some(after)) = (&holder_before, gate.holder()) {
                prop_assert!(after.epoch >= before.epoch);
                prop_assert!(after.epoch > before.epoch || after.holder == before.holder);
            }
        }
    }
}
