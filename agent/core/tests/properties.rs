//! One task in a world that crashes at any point: generated actions, named invariants, then liveness.

#![allow(clippy::unwrap_used, clippy::allow_attributes, reason = "tests")]

use std::collections::BTreeMap;

use muster_agent_core::depend::{Dependency, Standing};
use muster_agent_core::desired::{Desired, RestartPolicy, StopOrder};
use muster_agent_core::observed::{End, Exit, Loss, Observed, Started};
use muster_agent_core::probe::{Probes, Role, Timing, Verdict};
use muster_agent_core::report::{Phase, Report};
use muster_agent_core::time::{Boot, Now, Wall};
use muster_agent_core::workload::{
    Context, Effect, Event, Failure, Fetch, Outcome, Response, State, Workload,
};
use muster_api::id::TaskUid;
use muster_api::kind::task::depend::DependencyCondition;
use proptest::prelude::*;

const TIMING: Timing =
    Timing { initial_delay_ms: 0, period_ms: 1, success_threshold: 1, failure_threshold: 1 };
const PROBES: Probes =
    Probes { startup: Some(TIMING), readiness: Some(TIMING), liveness: Some(TIMING) };

#[derive(Debug, Clone)]
enum Action {
    /// The n-th operation under way is carried out, and its answer comes.
    Answer(usize),
    /// The same, but a launch, a find or a removal fails.
    Fail(usize),
    /// A launch happens, and nobody knows.
    Unclear(usize),
    /// The agent dies after this many effects of the next response.
    CrashAfter(usize),
    Crash,
    /// A launch happens, and the agent dies before its answer.
    LaunchAndCrash,
    Reboot,
    /// What its runtime fetched is gone.
    Evict,
    /// The program ends by itself.
    Ends(i32),
    Pass(u64),
    /// The task that it waits for stands so: whether it has come far enough, and its attempt.
    Others(bool, u32),
    /// The probes of the attempt that is this many before the present one say something.
    Probed(u32, Verdict),
    Stop(u64),
    Unassign,
    Forget,
    Wish(RestartPolicy),
}

fn action() -> impl Strategy<Value = Action> {
    prop_oneof![
        8 => (0..4_usize).prop_map(Action::Answer),
        1 => (0..4_usize).prop_map(Action::Fail),
        1 => (0..4_usize).prop_map(Action::Unclear),
        2 => (0..5_usize).prop_map(Action::CrashAfter),
        2 => Just(Action::Crash),
        1 => Just(Action::LaunchAndCrash),
        1 => Just(Action::Reboot),
        1 => Just(Action::Evict),
        4 => prop_oneof![Just(0), Just(1)].prop_map(Action::Ends),
        4 => (1..400_000_u64).prop_map(Action::Pass),
        3 => (0..2_u32, verdict()).prop_map(|(ago, verdict)| Action::Probed(ago, verdict)),
        3 => (any::<bool>(), 1..4_u32).prop_map(|(met, attempt)| Action::Others(met, attempt)),
        1 => (0..20_000_u64).prop_map(Action::Stop),
        1 => Just(Action::Unassign),
        1 => Just(Action::Forget),
        1 => policy().prop_map(Action::Wish),
    ]
}

fn verdict() -> impl Strategy<Value = Verdict> {
    let why = || "no".to_owned();
    prop_oneof![
        4 => Just(Verdict::Started),
        4 => Just(Verdict::Ready),
        2 => Just(Verdict::NotReady { why: why() }),
        1 => Just(Verdict::Failed { role: Role::Startup, why: why() }),
        1 => Just(Verdict::Failed { role: Role::Liveness, why: why() }),
    ]
}

fn fetch() -> impl Strategy<Value = Fetch> {
    prop_oneof![
        Just(Fetch::Nothing),
        Just(Fetch::Missing),
        Just(Fetch::Always),
        Just(Fetch::Executor)
    ]
}

fn policy() -> impl Strategy<Value = RestartPolicy> {
    prop_oneof![
        Just(RestartPolicy::Never),
        Just(RestartPolicy::OnFailure),
        Just(RestartPolicy::Always)
    ]
}

/// An attempt, as the kernel knows it.
#[derive(Debug, Clone, PartialEq)]
enum Attempt {
    Live,
    Ended(Exit),
}

struct World {
    now: u64,
    fetch: Fetch,
    /// What a launch needs is not here.
    missing: bool,
    desired: Desired,
    attempts: BTreeMap<u32, Attempt>,
    durable: Option<(Workload, u64)>,
    agent: Option<Workload>,
    under_way: Vec<Effect>,
    told: Option<Report>,
    boot: u64,
    crash_after: Option<usize>,
    stopping: bool,
    dropped: bool,
    /// What was said last of the task that it waits for, in this life of the agent.
    met: bool,
}

impl World {
    fn new(policy: RestartPolicy, fetch: Fetch) -> World {
        World::with(policy, fetch, Vec::new())
    }

    /// Waits for another task, and begins anew when that does.
    fn waiting(policy: RestartPolicy, fetch: Fetch) -> World {
        let other = Dependency {
            task: "other".to_owned(),
            uid: "o".to_owned(),
            condition: DependencyCondition::Running,
            restart: true,
            unmet: None,
            attempt: 1,
        };
        World::with(policy, fetch, vec![other])
    }

    fn with(policy: RestartPolicy, fetch: Fetch, depends: Vec<Dependency>) -> World {
        let desired = Desired { restart: policy, probes: PROBES, depends, ..Desired::once(1_000) };
        let mut world = World {
            now: 0,
            fetch,
            missing: fetch != Fetch::Nothing,
            desired: desired.clone(),
            attempts: BTreeMap::new(),
            durable: None,
            agent: None,
            under_way: Vec::new(),
            told: None,
            boot: 0,
            crash_after: None,
            stopping: false,
            dropped: false,
            met: false,
        };
        let (workload, response) =
            Workload::assigned(TaskUid::new("t"), desired, fetch, world.context());
        world.agent = Some(workload);
        world.carry_out(response);
        world
    }

    fn context(&self) -> Context {
        let now = Now { boot: Boot(self.now), wall: Wall(self.now.cast_signed()) };
        Context { now, contact: Some(now.boot) }
    }

    fn exit(&self, end: End) -> Exit {
        Exit {
            end,
            oom_killed: false,
            disconnected: false,
            started_at: Some(Wall(0)),
            finished_at: Wall(self.now.cast_signed()),
        }
    }

    fn live(&self) -> usize {
        self.attempts.values().filter(|attempt| **attempt == Attempt::Live).count()
    }

    fn carry_out(&mut self, response: Response) {
        for (done, effect) in response.effects.into_iter().enumerate() {
            if self.crash_after.is_some_and(|after| done >= after) {
                self.crash_after = None;
                return self.crash();
            }
            match effect {
                Effect::Persist => {
                    self.durable = Some((self.agent.clone().unwrap(), self.boot));
                }
                Effect::Publish => self.publish(),
                Effect::Stop { attempt, .. } => {
                    // The ladder does not depend on the agent: it ends the attempt some time.
                    self.stopping |= self.attempts.get(&attempt) == Some(&Attempt::Live);
                    if self.fetch == Fetch::Executor && !self.attempts.contains_key(&attempt) {
                        // A work that its executor has not got yet ends where it is.
                        let killed = Attempt::Ended(self.exit(End::Lost(Loss::Executor)));
                        self.attempts.insert(attempt, killed);
                    }
                }
                Effect::CancelPrepare => {
                    self.under_way.retain(|effect| !matches!(effect, Effect::Prepare(_)));
                }
                Effect::WakeAt(_) => {}
                Effect::Drop => {
                    assert_eq!(self.live(), 0, "dropped while it lives");
                    self.dropped = true;
                    self.durable = None;
                }
                effect => {
                    if matches!(effect, Effect::Launch(_)) {
                        let waits = !self.desired.depends.is_empty();
                        assert!(self.met || !waits, "begins before the other has come so far");
                    }
                    self.under_way.push(effect);
                }
            }
        }
    }

    fn publish(&mut self) {
        let workload = self.agent.as_ref().unwrap();
        let report = workload.report.clone();
        if report.content.phase.is_terminal() {
            assert_eq!(self.live(), 0, "said to have ended while it lives: {report:?}");
        }
        let ready = report.content.ready.expect("its probes say so or not");
        assert!(!ready || report.content.phase == Phase::Running, "ready, not running: {report:?}");
        if let Some(before) = &self.told {
            assert!(report.sequence >= before.sequence, "{before:?} then {report:?}");
            if report.sequence == before.sequence {
                assert_eq!(&report, before, "two reports of one number");
            }
            assert!(
                !before.content.phase.is_terminal() || report.content.phase.is_terminal(),
                "an end was taken back"
            );
        }
        self.told = Some(report);
    }

    fn handle(&mut self, event: Event) {
        if self.dropped {
            return;
        }
        let context = self.context();
        let Some(agent) = &mut self.agent else { return };
        let response = agent.handle(event, context);
        self.carry_out(response);
    }

    fn answer(&mut self, attempt: u32, outcome: Outcome) {
        self.handle(Event::Attempt(attempt, outcome));
    }

    /// Starts the attempt for real.
    fn begin(&mut self, attempt: u32) {
        assert_eq!(self.live(), 0, "a second attempt beside a live one");
        let before = self.attempts.insert(attempt, Attempt::Live);
        assert_eq!(before, None, "attempt {attempt} runs twice");
        self.stopping = false;
    }

    fn perform(&mut self, index: usize, fail: bool) {
        if self.under_way.is_empty() {
            return;
        }
        let index = index % self.under_way.len();
        let failure = Failure { reason: "F".to_owned(), message: String::new(), retry: true };
        match self.under_way[index].clone() {
            Effect::Watch(attempt) => {
                let Attempt::Ended(exit) = self.attempts[&attempt].clone() else { return };
                self.under_way.remove(index);
                self.answer(attempt, Outcome::Exited(exit));
            }
            Effect::Prepare(attempt) => {
                self.under_way.remove(index);
                if fail {
                    return self.answer(attempt, Outcome::PrepareFailed(failure));
                }
                self.missing = false;
                self.answer(attempt, Outcome::Prepared);
            }
            Effect::Launch(attempt) => {
                self.under_way.remove(index);
                if fail {
                    return self.answer(attempt, Outcome::LaunchFailed(failure));
                }
                if let Some(Attempt::Ended(exit)) = self.attempts.get(&attempt).cloned() {
                    return self.answer(attempt, Outcome::Exited(exit));
                }
                if self.missing {
                    let away = self.fetch == Fetch::Executor;
                    let outcome = if away { Outcome::LaunchFailed } else { Outcome::Unprepared };
                    return self.answer(attempt, outcome(failure));
                }
                self.begin(attempt);
                self.answer(attempt, Outcome::Launched(Started { at: Wall(0) }));
            }
            Effect::Find(attempt) => {
                self.under_way.remove(index);
                let found = match self.attempts.get(&attempt) {
                    _ if fail => return self.answer(attempt, Outcome::FindFailed),
                    None => Observed::NeverStarted,
                    Some(Attempt::Live) => Observed::Running(Started { at: Wall(0) }),
                    Some(Attempt::Ended(exit)) => Observed::Ended(exit.clone()),
                };
                self.answer(attempt, Outcome::Found(found));
            }
            Effect::Remove => {
                self.under_way.remove(index);
                assert_eq!(self.live(), 0, "removed while it lives");
                self.handle(if fail { Event::RemoveFailed } else { Event::Removed });
            }
            other => unreachable!("{other:?} is not an operation"),
        }
    }

    fn unclear(&mut self, index: usize) {
        if self.missing {
            return;
        }
        if let Some(Effect::Launch(attempt)) = self.under_way.get(index).cloned() {
            if self.attempts.contains_key(&attempt) {
                return;
            }
            self.under_way.remove(index);
            self.begin(attempt);
            self.answer(attempt, Outcome::LaunchUnclear);
        }
    }

    /// The agent dies and comes back; the task's processes do not care.
    fn crash(&mut self) {
        self.under_way.clear();
        (self.agent, self.met) = (None, false);
        if self.dropped {
            return;
        }
        let context = self.context();
        let Some((mut workload, boot)) = self.durable.clone() else {
            // Nothing was written: the controller assigns it anew.
            let (workload, response) =
                Workload::assigned(TaskUid::new("t"), self.desired.clone(), self.fetch, context);
            self.agent = Some(workload);
            return self.carry_out(response);
        };
        let response = workload.restored(boot == self.boot, context);
        self.agent = Some(workload);
        self.carry_out(response);
        // The session begins with everything that is assigned.
        self.handle(Event::Assigned(self.desired.clone()));
    }

    fn end_live(&mut self, end: End) {
        let exit = self.exit(end);
        for attempt in self.attempts.values_mut() {
            if *attempt == Attempt::Live {
                *attempt = Attempt::Ended(exit.clone());
            }
        }
        self.stopping = false;
    }

    fn act(&mut self, action: Action) {
        match action {
            Action::Answer(index) => self.perform(index, false),
            Action::Fail(index) => self.perform(index, true),
            Action::Unclear(index) => self.unclear(index),
            Action::CrashAfter(count) => self.crash_after = Some(count),
            Action::Crash => self.crash(),
            Action::LaunchAndCrash => {
                let launch = self.under_way.iter().find_map(|effect| match effect {
                    Effect::Launch(attempt) => Some(*attempt),
                    _ => None,
                });
                let launch = launch.filter(|attempt| !self.attempts.contains_key(attempt));
                if let Some(attempt) = launch.filter(|_| !self.missing) {
                    self.begin(attempt);
                    self.crash();
                }
            }
            Action::Reboot => {
                self.boot += 1;
                // What was not synced is gone with the power: attempts without a trace.
                let live: Vec<u32> = self.attempts.keys().copied().collect();
                for attempt in live {
                    if self.attempts[&attempt] == Attempt::Live {
                        self.attempts.remove(&attempt);
                    }
                }
                self.crash();
            }
            Action::Evict => self.missing = self.fetch != Fetch::Nothing,
            Action::Ends(code) => self.end_live(End::Exited(code)),
            Action::Pass(millis) => {
                self.now += millis;
                if self.stopping {
                    self.end_live(End::Signaled(9));
                }
                self.handle(Event::Tick);
            }
            Action::Probed(ago, verdict) => {
                let Some(agent) = &self.agent else { return };
                let (attempt, ready) = (agent.attempt, agent.report.content.ready);
                let before = self.told.clone();
                self.handle(Event::Probed(attempt.wrapping_sub(ago), verdict.clone()));
                if ago > 0 {
                    assert_eq!(self.told, before, "an earlier attempt's verdict counts");
                } else if let (Some(agent), Verdict::Ready) = (&self.agent, verdict) {
                    let started = agent.verdicts.started;
                    let now = agent.report.content.ready;
                    assert!(now == ready || started, "ready before it has started");
                }
            }
            Action::Others(met, attempt) => {
                if self.desired.depends.is_empty() || self.agent.is_none() {
                    return;
                }
                self.met = met;
                let unmet = (!met).then(|| "waits".to_owned());
                let attempts = BTreeMap::from([("other".to_owned(), ("o".to_owned(), attempt))]);
                self.handle(Event::Dependencies(Standing { unmet, attempts }));
            }
            Action::Stop(grace_ms) => {
                self.desired.stop = Some(StopOrder { grace_ms, reason: "Deleted".to_owned() });
                self.handle(Event::Assigned(self.desired.clone()));
            }
            Action::Unassign => self.handle(Event::Unassigned),
            Action::Forget => self.handle(Event::Forgotten),
            Action::Wish(restart) => {
                self.desired.restart = restart;
                self.handle(Event::Assigned(self.desired.clone()));
            }
        }
    }

    /// Without faults, everything goes on.
    fn settle(&mut self) {
        self.crash_after = None;
        // What is to end for its probe ends here as by an order.
        self.stopping |= self.agent.as_ref().is_some_and(|agent| agent.condemned.is_some());
        for _ in 0..60 {
            for index in 0..self.under_way.len() {
                self.perform(index, false);
            }
            self.act(Action::Pass(60_000));
        }
    }
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 400, ..ProptestConfig::default() })]

    #[test]
    fn a_task_runs_once_at_a_time_and_ends_when_told(
        policy in policy(),
        fetch in fetch(),
        waits in any::<bool>(),
        actions in prop::collection::vec(action(), 1..60),
    ) {
        let begin = if waits { World::waiting } else { World::new };
        let mut world = begin(policy, fetch);
        for action in actions {
            world.act(action);
            prop_assert!(world.live() <= 1);
        }
        world.act(Action::Stop(0));
        world.settle();
        prop_assert_eq!(world.live(), 0, "a stop did not end it");
        if !world.dropped {
            let state = world.agent.as_ref().unwrap().state.clone();
            prop_assert!(matches!(state, State::Ended | State::Removing { .. }), "{:?}", state);
        }
        world.act(Action::Forget);
        world.settle();
        prop_assert!(world.dropped, "a forgotten task stays");
    }

    #[test]
    fn a_task_that_is_no_longer_assigned_tells_its_end_before_it_goes(
        policy in policy(),
        fetch in fetch(),
    ) {
        let mut world = World::new(policy, fetch);
        world.act(Action::Answer(0));
        world.act(Action::Unassign);
        world.settle();
        prop_assert_eq!(world.live(), 0);
        prop_assert!(!world.dropped, "forgotten before anybody asked for that");
        prop_assert!(world.told.as_ref().is_some_and(|told| told.content.phase.is_terminal()));
        world.act(Action::Forget);
        world.settle();
        prop_assert!(world.dropped, "its end was heard");
    }

    #[test]
    fn an_always_task_comes_back_after_every_end(ends in prop::collection::vec(0..3_i32, 1..8)) {
        let mut world = World::new(RestartPolicy::Always, Fetch::Nothing);
        world.settle();
        for (number, code) in (1_u32..).zip(&ends) {
            prop_assert_eq!(world.live(), 1);
            prop_assert_eq!(world.agent.as_ref().unwrap().attempt, number);
            world.act(Action::Ends(*code));
            world.settle();
        }
    }
}
