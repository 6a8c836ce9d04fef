//! An executor against a world in which connections break, messages are lost, and either side dies
//! at any point: no work begins twice or after its end was told, and every work's end is told once.

#![expect(clippy::unwrap_used, reason = "tests")]

use std::collections::{BTreeMap, BTreeSet, VecDeque};

use muster_agent_core::executor::{
    Effect, Event, Executor, Life, Record, Stage, Update, WorkState,
};
use muster_agent_core::observed::{End, Said};
use muster_agent_core::time::{Boot, Now, Wall};
use muster_api::id::TaskUid;
use proptest::prelude::*;

const WORKS: usize = 3;

/// Longer than any grace here and all that follows it.
const LONG_MS: u64 = 60_000;

#[derive(Debug, Clone)]
enum Action {
    /// The task of a work asks for an executor, or an attempt after its last one does.
    Claim(usize),
    /// The claim of a work becomes durable.
    Written(usize),
    /// The executor reads what was sent to it first.
    ExecutorReads,
    /// The executor says something of the n-th work that it has.
    Says(usize, Say),
    /// The agent reads what was said first.
    AgentReads,
    Breaks,
    Connects,
    ExecutorDies,
    /// The agent learns what the kernel knows of the executor.
    Looks,
    AgentDies,
    /// The agent dies after this many effects of the next decision.
    AgentDiesAfter(usize),
    Stop(usize, u64),
    ShutDown(u64),
    Pass(u64),
    /// The end of a work is told.
    Tells(usize),
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Say {
    Starting,
    Running,
    Over,
}

fn action() -> impl Strategy<Value = Action> {
    let work = || 0..WORKS;
    prop_oneof![
        4 => work().prop_map(Action::Claim),
        4 => work().prop_map(Action::Written),
        8 => Just(Action::ExecutorReads),
        6 => (work(), prop_oneof![Just(Say::Starting), Just(Say::Running), Just(Say::Over)])
            .prop_map(|(work, say)| Action::Says(work, say)),
        8 => Just(Action::AgentReads),
        2 => Just(Action::Breaks),
        6 => Just(Action::Connects),
        1 => Just(Action::ExecutorDies),
        5 => Just(Action::Looks),
        1 => Just(Action::AgentDies),
        1 => (0..4_usize).prop_map(Action::AgentDiesAfter),
        2 => (work(), 0..5_000_u64).prop_map(|(work, grace_ms)| Action::Stop(work, grace_ms)),
        1 => (0..9_000_u64).prop_map(Action::ShutDown),
        2 => (1..8_000_u64).prop_map(Action::Pass),
        3 => work().prop_map(Action::Tells),
    ]
}

/// What the driver of a work knows, all of it durable.
#[derive(Debug, Default)]
struct Driver {
    attempt: u32,
    /// The attempt is under way: its end was not told.
    open: bool,
    stop: Option<u64>,
}

/// The executor's program.
#[derive(Debug, Default)]
struct Program {
    has: BTreeSet<TaskUid>,
    unacknowledged: Vec<Update>,
    sequence: u64,
}

#[derive(Debug)]
struct World {
    now: u64,
    life: u32,
    /// None: its processes are gone.
    program: Option<Program>,
    connected: bool,
    down: VecDeque<Effect>,
    up: VecDeque<Update>,
    agent: Executor,
    crash_after: Option<usize>,
    drivers: BTreeMap<TaskUid, Driver>,
    files: BTreeMap<TaskUid, (u32, Record)>,
    /// Attempts that began, and in which life of the executor.
    begun: BTreeMap<(TaskUid, u32), u32>,
    told: BTreeSet<(TaskUid, u32)>,
}

fn uid(work: usize) -> TaskUid {
    TaskUid::new(format!("w{work}"))
}

impl World {
    fn new() -> World {
        World {
            now: 0,
            life: 1,
            program: Some(Program::default()),
            connected: false,
            down: VecDeque::new(),
            up: VecDeque::new(),
            agent: Executor::new(Life::Live(1)),
            crash_after: None,
            drivers: (0..WORKS).map(|work| (uid(work), Driver::default())).collect(),
            files: BTreeMap::new(),
            begun: BTreeMap::new(),
            told: BTreeSet::new(),
        }
    }

    fn now(&self) -> Now {
        Now { boot: Boot(self.now), wall: Wall(self.now.cast_signed()) }
    }

    fn has(&self, work: &TaskUid) -> bool {
        self.program.as_ref().is_some_and(|program| program.has.contains(work))
    }

    fn handle(&mut self, event: Event) {
        let before = self.agent.clone();
        let effects = self.agent.handle(event.clone(), self.now());
        for work in self.drivers.keys() {
            let ended = |agent: &Executor| {
                agent.work(work).is_some_and(|work| matches!(work.stage, Stage::Ended(_)))
            };
            if ended(&self.agent) && !ended(&before) {
                assert!(!self.has(work), "{work} counts as over while it runs: {event:?}");
            }
        }
        for (done, effect) in effects.into_iter().enumerate() {
            if self.crash_after.is_some_and(|after| done >= after) {
                return self.agent_dies();
            }
            match effect {
                Effect::Record(work) => self.write(&work),
                Effect::EndExecutor(life) => {
                    assert_eq!(life, self.life, "another life of the executor is ended");
                    self.program = None;
                }
                effect if self.connected => self.down.push_back(effect),
                _ => {}
            }
        }
    }

    fn write(&mut self, work: &TaskUid) {
        let known = self.agent.work(work).map(|known| known.attempt);
        if let (Some(attempt), Some(record)) = (known, self.agent.record(work)) {
            self.files.insert(work.clone(), (attempt, record));
        }
    }

    fn claim(&mut self, work: &TaskUid) {
        let driver = self.drivers.get_mut(work).unwrap();
        if driver.open && self.agent.work(work).is_some() {
            return;
        }
        if !driver.open {
            // The attempt is durable before anything is asked of an executor.
            (driver.open, driver.stop) = (true, None);
            driver.attempt += 1;
        }
        let attempt = driver.attempt;
        let unknown = self.files.get(work).is_none_or(|(of, _)| *of != attempt);
        if unknown && self.agent.accepts() {
            self.handle(Event::Claim(work.clone(), attempt));
        }
    }

    fn written(&mut self, work: &TaskUid) {
        if self.agent.work(work).is_some_and(|work| work.stage == Stage::Claimed) {
            self.write(work);
            self.handle(Event::Recorded(work.clone()));
        }
    }

    fn executor_reads(&mut self) {
        let Some(effect) = self.down.pop_front() else { return };
        let Some(program) = &mut self.program else { return };
        match effect {
            Effect::Launch(work) => {
                // It ignores what it has.
                if program.has.insert(work.clone()) {
                    let attempt = (work.clone(), self.drivers[&work].attempt);
                    assert!(!self.told.contains(&attempt), "{attempt:?} begins after its end");
                    let before = self.begun.insert(attempt.clone(), self.life);
                    assert_eq!(before, None, "{attempt:?} begins twice");
                }
            }
            Effect::Kill { work, .. } => {
                // One answers for what it does not know, too.
                self.over(&work, Said::Killed);
            }
            Effect::ShutDown { .. } => {
                for work in program.has.clone() {
                    self.over(&work, Said::Killed);
                }
            }
            Effect::Acknowledge(sequence) => {
                program.unacknowledged.retain(|update| update.sequence != sequence);
            }
            other => unreachable!("{other:?} is not sent"),
        }
    }

    fn says(&mut self, work: &TaskUid, state: WorkState) {
        let Some(program) = &mut self.program else { return };
        program.sequence += 1;
        let update = Update { work: work.clone(), sequence: program.sequence, state };
        program.unacknowledged.push(update.clone());
        if self.connected {
            self.up.push_back(update);
        }
    }

    fn over(&mut self, work: &TaskUid, said: Said) {
        if let Some(program) = &mut self.program {
            program.has.remove(work);
        }
        let message = String::new();
        self.says(work, WorkState::Over(End::Said { said, code: None, message }));
    }

    fn breaks(&mut self) {
        if std::mem::take(&mut self.connected) {
            self.handle(Event::Disconnected);
        }
        self.down.clear();
        self.up.clear();
    }

    fn connects(&mut self) {
        if self.agent.life().attempt() != Some(self.life) {
            return;
        }
        let Some(program) = &self.program else { return };
        let works = program.has.clone();
        let unacknowledged = program.unacknowledged.clone();
        self.breaks();
        self.connected = true;
        self.handle(Event::Registered { works, unacknowledged });
    }

    fn looks(&mut self) {
        if self.program.is_some() {
            return self.handle(Event::Life(Life::Live(self.life)));
        }
        self.breaks();
        self.handle(Event::Life(Life::Gone));
        self.life += 1;
        self.program = Some(Program::default());
        self.handle(Event::Life(Life::Live(self.life)));
    }

    fn agent_dies(&mut self) {
        (self.connected, self.crash_after) = (false, None);
        self.down.clear();
        self.up.clear();
        // Its record says how far the agent knew of it.
        let life = self.agent.life().attempt().unwrap_or(self.life);
        self.agent = Executor::new(Life::Unsure(life));
        let open: Vec<TaskUid> = self.open();
        for work in open {
            let attempt = self.drivers[&work].attempt;
            let file = self.files.get(&work).filter(|(of, _)| *of == attempt).cloned();
            if let Some((_, record)) = file {
                self.handle(Event::Adopted(work.clone(), attempt, record));
            }
            if let Some(grace_ms) = self.drivers[&work].stop {
                self.handle(Event::Stop { work, grace_ms, disconnected: false });
            }
        }
    }

    fn open(&self) -> Vec<TaskUid> {
        let open = self.drivers.iter().filter(|(_, driver)| driver.open);
        open.map(|(work, _)| work.clone()).collect()
    }

    fn stop(&mut self, work: &TaskUid, grace_ms: u64) {
        let driver = self.drivers.get_mut(work).unwrap();
        if driver.open && self.agent.work(work).is_some() {
            driver.stop = Some(grace_ms);
            self.handle(Event::Stop { work: work.clone(), grace_ms, disconnected: false });
        }
    }

    /// Whatever was ordered before, no order gives more than it says, and SIGTERM never follows SIGKILL.
    fn shut_down(&mut self, grace_ms: u64) {
        let mut agent = self.agent.clone();
        let before = agent.stop_times(u64::MAX, Boot(self.now));
        let _ = agent.handle(Event::ShutDown { grace_ms }, self.now());
        let times = agent.stop_times(grace_ms, Boot(self.now));
        assert!(times.signal_ms <= times.kill_ms && times.kill_ms <= grace_ms, "{times:?}");
        assert!(times.kill_ms <= before.kill_ms, "{before:?}, then {times:?}");
        self.handle(Event::ShutDown { grace_ms });
    }

    fn pass(&mut self, millis: u64) {
        self.now += millis;
        for work in self.open() {
            self.handle(Event::Tick(work));
        }
    }

    fn tells(&mut self, work: &TaskUid) {
        let ended = self.agent.work(work).is_some_and(|work| matches!(work.stage, Stage::Ended(_)));
        let driver = self.drivers.get_mut(work).unwrap();
        if driver.open && ended {
            driver.open = false;
            assert!(self.told.insert((work.clone(), driver.attempt)), "{work} ends twice");
        }
    }

    fn act(&mut self, action: Action) {
        match action {
            Action::Claim(work) => self.claim(&uid(work)),
            Action::Written(work) => self.written(&uid(work)),
            Action::ExecutorReads => self.executor_reads(),
            Action::Says(work, say) => {
                let has = self.program.as_ref().and_then(|program| {
                    program.has.iter().nth(work % program.has.len().max(1)).cloned()
                });
                let Some(work) = has else { return };
                match say {
                    Say::Starting => self.says(&work, WorkState::Starting),
                    Say::Running => self.says(&work, WorkState::Running),
                    Say::Over => self.over(&work, Said::Succeeded),
                }
            }
            Action::AgentReads => {
                if let Some(update) = self.up.pop_front() {
                    self.handle(Event::Said(update));
                }
            }
            Action::Breaks => self.breaks(),
            Action::Connects => self.connects(),
            Action::ExecutorDies => self.program = None,
            Action::Looks => self.looks(),
            Action::AgentDies => self.agent_dies(),
            Action::AgentDiesAfter(count) => self.crash_after = Some(count),
            Action::Stop(work, grace_ms) => self.stop(&uid(work), grace_ms),
            Action::ShutDown(grace_ms) => self.shut_down(grace_ms),
            Action::Pass(millis) => self.pass(millis),
            Action::Tells(work) => self.tells(&uid(work)),
        }
    }

    /// Every message arrives, and every claim becomes durable.
    fn flow(&mut self) {
        for work in 0..WORKS {
            self.act(Action::Written(work));
        }
        while !(self.down.is_empty() && self.up.is_empty()) {
            self.act(Action::ExecutorReads);
            self.act(Action::AgentReads);
        }
        for work in 0..WORKS {
            self.act(Action::Tells(work));
        }
    }
}

fn actions() -> impl Strategy<Value = Vec<Action>> {
    prop::collection::vec(action(), 1..120)
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 400, ..ProptestConfig::default() })]

    #[test]
    fn works_begin_once_and_their_ends_are_told_once(actions in actions()) {
        let mut world = World::new();
        for action in actions {
            world.act(action);
        }
        world.crash_after = None;
        world.act(Action::Looks);
        world.act(Action::Connects);
        world.flow();
        for work in 0..WORKS {
            world.act(Action::Stop(work, 1_000));
        }
        world.flow();
        prop_assert!(world.program.as_ref().unwrap().has.is_empty(), "{world:?}");
        let open = world.open();
        prop_assert!(open.iter().all(|work| world.agent.work(work).is_none()), "{world:?}");
    }

    /// Whatever happened, an executor that is there again gets every work that is claimed.
    #[test]
    fn works_that_are_handed_over_begin(actions in actions()) {
        let mut world = World::new();
        for action in actions {
            world.act(action);
        }
        world.crash_after = None;
        world.act(Action::Connects);
        world.act(Action::Looks);
        world.act(Action::Connects);
        world.flow();
        for work in world.open() {
            let live = world.agent.work(&work).is_some_and(muster_agent_core::executor::Work::is_live);
            prop_assert_eq!(live, world.has(&work), "{}: {:?}", work, world);
        }
    }

    /// An executor that reads nothing any more does not keep a work from ending.
    #[test]
    fn a_stop_needs_no_good_will(actions in actions()) {
        let mut world = World::new();
        for action in actions {
            world.act(action);
        }
        world.crash_after = None;
        world.act(Action::Looks);
        for work in 0..WORKS {
            world.act(Action::Stop(work, 1_000));
        }
        world.act(Action::Pass(LONG_MS));
        world.act(Action::Looks);
        for work in 0..WORKS {
            world.act(Action::Tells(work));
            prop_assert!(!world.has(&uid(work)), "{world:?}");
        }
        let open = world.open();
        prop_assert!(open.iter().all(|work| world.agent.work(work).is_none()), "{world:?}");
    }
}
