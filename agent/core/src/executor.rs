//! One executor (a task that runs other tasks, its *works*, itself) as the agent sees it: which works
//! it was given, what it said of them, and what must be sent, written down or ended next.
//!
//! ```text
//!   Claimed → Recorded → Sent → Running ─┐ the executor says so, or
//!      └─────────┴─────────┴─────────────┴→ Ended  no process of the executor is left
//! ```
//!
//! Three rules. A work is begun at most once in one life of its executor: it is written down before it
//! is handed over, it is handed over again only while the executor has said nothing of it (an executor
//! ignores what it has), and what a reconnected executor no longer has is lost. A work may hold a
//! robot's actuators, so its end needs a witness: the executor's word, or the kernel's that nothing
//! of the executor is left. What the executor said is durable before it is acknowledged.

use std::collections::{BTreeMap, BTreeSet};

use muster_api::id::TaskUid;
use serde::{Deserialize, Serialize};

use crate::desired::StopTimes;
use crate::observed::{End, Exit, Loss, Said};
use crate::time::{Boot, Now, Wall};

/// What an executor has beyond a work's grace to tell its end: the report has to travel, and be
/// written down. After it the executor is ended, with all that it runs.
pub const REPORT_MS: u64 = 1_000;

/// An executor that must end is told so first, and has this part of its grace to end its works, say so and exit by
/// itself; then it gets SIGTERM. Half: whoever listens rarely needs more for what a SIGTERM would leave it no time for,
/// and whoever does not listen has the other half for its signal handler.
pub const ASKED_FOR_PERCENT: u64 = 50;

/// An order to end the executor that had no effect is given again after this.
pub const END_AGAIN_MS: u64 = 5_000;

/// Whether the executor's processes exist.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Life {
    /// None does.
    #[default]
    Gone,
    /// Those of this attempt may, from an earlier life of the agent; its runtime is being asked.
    Unsure(u32),
    /// Those of this attempt may.
    Live(u32),
    /// Those of this attempt may, and it is being ended: it gets no more work.
    Ending(u32),
}

impl Life {
    /// The attempt whose processes may exist.
    #[must_use]
    pub fn attempt(self) -> Option<u32> {
        match self {
            Life::Gone => None,
            Life::Unsure(n) | Life::Live(n) | Life::Ending(n) => Some(n),
        }
    }
}

/// How far a work is.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Stage {
    /// It is the executor's; room is being made for it, and it is being written down.
    Claimed,
    /// It is written down, and waits for a connection.
    Recorded,
    /// It was handed over.
    Sent,
    /// The executor says that it runs.
    Running,
    /// It is over.
    Ended(Exit),
}

/// One attempt of one work.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Work {
    /// Which.
    pub attempt: u32,
    /// How far it is.
    pub stage: Stage,
    /// When it was claimed.
    pub claimed: Wall,
    /// When the executor first said that it runs.
    pub began: Option<Wall>,
    /// The executor has said something of it.
    heard: bool,
    /// The newest update that is accounted for. Its own: of several updates that came together, the
    /// agent may have written down one and died before the next.
    sequence: u64,
    /// It was handed over, and whoever is connected now does not have it.
    absent: bool,
    /// It is being ended; after this the executor is ended instead.
    pub until: Option<Boot>,
    /// Milliseconds that the executor was given to end it.
    grace_ms: u64,
    /// It is being ended because contact was lost for too long.
    disconnected: bool,
}

impl Work {
    /// Whether the executor may be running it, or is about to.
    #[must_use]
    pub fn is_live(&self) -> bool {
        !matches!(self.stage, Stage::Ended(_))
    }

    fn end(&mut self, end: End, now: Now) {
        self.stage = Stage::Ended(Exit {
            end,
            oom_killed: false,
            disconnected: self.disconnected,
            started_at: self.began,
            finished_at: now.wall,
        });
    }
}

/// What of a work survives the agent.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "camelCase")]
pub struct Record {
    /// The executor's attempt that has it.
    pub life: u32,
    /// The newest update that its end and begin account for.
    pub sequence: u64,
    /// When it was claimed.
    pub claimed: Wall,
    /// Whether the executor has said anything of it.
    pub heard: bool,
    /// When it began, if the executor said so.
    pub began: Option<Wall>,
    /// How it ended, if the executor said so.
    pub exit: Option<Exit>,
}

/// What an executor says of a work.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Update {
    /// Which work.
    pub work: TaskUid,
    /// Grows with every update of this life of the executor; 1 is the least.
    pub sequence: u64,
    /// What.
    pub state: WorkState,
}

/// Where a work is, by its executor's word.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum WorkState {
    /// Being made ready.
    Starting,
    /// It runs.
    Running,
    /// It is over, and nothing of it runs.
    Over(End),
}

/// What happened.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Event {
    /// The executor's processes.
    Life(Life),
    /// It connected, and says what it has.
    Registered {
        /// Works that it still has.
        works: BTreeSet<TaskUid>,
        /// Updates that were not acknowledged.
        unacknowledged: Vec<Update>,
    },
    /// Its connection is gone.
    Disconnected,
    /// A work is to be its. Only while [`Executor::accepts`].
    Claim(TaskUid, u32),
    /// The claimed work is durable, and there is room for it.
    Recorded(TaskUid),
    /// A work of an earlier life of the agent.
    Adopted(TaskUid, u32, Record),
    /// It says something of a work.
    Said(Update),
    /// A work must end.
    Stop {
        /// Which.
        work: TaskUid,
        /// What the executor is given for it.
        grace_ms: u64,
        /// Because contact was lost for too long.
        disconnected: bool,
    },
    /// The executor itself must end.
    ShutDown {
        /// What it is given for it.
        grace_ms: u64,
    },
    /// A work's time to end may be over.
    Tick(TaskUid),
    /// Nobody asks for this work any more.
    Forget(TaskUid),
}

/// What must be done, in this order.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Effect {
    /// Make the work's record durable. Before the effects after it.
    Record(TaskUid),
    /// Hand the work over.
    Launch(TaskUid),
    /// Tell the executor to end a work.
    Kill {
        /// Which.
        work: TaskUid,
        /// Milliseconds it is given.
        grace_ms: u64,
    },
    /// Tell the executor to end everything and exit.
    ShutDown {
        /// Milliseconds it has.
        grace_ms: u64,
    },
    /// Tell the executor that its update is accounted for.
    Acknowledge(u64),
    /// End this attempt of the executor, without grace.
    EndExecutor(u32),
}

/// Until when an executor that must end has what.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Ending {
    /// To exit by itself.
    signal: Boot,
    /// At all.
    kill: Boot,
}

/// One executor.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Executor {
    life: Life,
    connected: bool,
    /// It has registered in this life.
    registered: bool,
    /// It must end.
    ending: Option<Ending>,
    /// The newest update that was heard.
    sequence: u64,
    works: BTreeMap<TaskUid, Work>,
}

impl Executor {
    /// An executor that no process of is known, or one of an earlier life of the agent.
    #[must_use]
    pub fn new(life: Life) -> Executor {
        Executor { life, ..Executor::default() }
    }

    /// Whether its processes exist.
    #[must_use]
    pub fn life(&self) -> Life {
        self.life
    }

    /// Whether it would take a work now.
    #[must_use]
    pub fn accepts(&self) -> bool {
        self.connected && matches!(self.life, Life::Live(_))
    }

    /// Whether it is an executor, as far as its life goes: it has registered, and is not being ended. Its connection
    /// may be broken for the moment.
    #[must_use]
    pub fn is_there(&self) -> bool {
        self.registered && matches!(self.life, Life::Live(_))
    }

    /// When its processes are to be signalled, for an order with this grace that it was told of: who cannot be asked
    /// is signalled at once.
    #[must_use]
    pub fn stop_times(&self, grace_ms: u64, now: Boot) -> StopTimes {
        let left = |at: Boot| at.0.saturating_sub(now.0);
        match self.ending {
            Some(Ending { signal, kill }) => {
                StopTimes { signal_ms: left(signal), kill_ms: left(kill) }
            }
            None => StopTimes { signal_ms: 0, kill_ms: grace_ms },
        }
    }

    /// A work of it.
    #[must_use]
    pub fn work(&self, work: &TaskUid) -> Option<&Work> {
        self.works.get(work)
    }

    /// The works that it may be running, or is about to.
    pub fn live(&self) -> impl Iterator<Item = &TaskUid> {
        self.works.iter().filter(|(_, work)| work.is_live()).map(|(uid, _)| uid)
    }

    /// What of a work must survive the agent; none of a work that is not here.
    #[must_use]
    pub fn record(&self, work: &TaskUid) -> Option<Record> {
        let work = self.works.get(work)?;
        Some(Record {
            life: self.life.attempt()?,
            sequence: work.sequence,
            claimed: work.claimed,
            heard: work.heard,
            began: work.began,
            exit: match &work.stage {
                Stage::Ended(exit) => Some(exit.clone()),
                _ => None,
            },
        })
    }

    /// The one way in.
    #[must_use = "effects that are not carried out leave works stuck"]
    pub fn handle(&mut self, event: Event, now: Now) -> Vec<Effect> {
        let mut effects = Vec::new();
        match event {
            Event::Life(life) => self.on_life(life, now, &mut effects),
            // The last words of an earlier life may come late, and their numbers mean nothing now.
            Event::Registered { .. } if self.life == Life::Gone => {}
            Event::Said(_) if !self.connected => {}
            Event::Registered { works, unacknowledged } => {
                self.on_registered(&works, unacknowledged, now, &mut effects);
            }
            Event::Disconnected => self.connected = false,
            Event::Claim(uid, attempt) => self.claim(uid, attempt, Stage::Claimed, now.wall),
            Event::Recorded(uid) => self.on_recorded(&uid, &mut effects),
            Event::Adopted(uid, attempt, record) => self.adopt(uid, attempt, record, now),
            Event::Said(update) => self.on_update(update, now, &mut effects),
            Event::Stop { work, grace_ms, disconnected } => {
                self.on_stop(&work, grace_ms, disconnected, now, &mut effects);
            }
            Event::ShutDown { grace_ms } => self.on_shut_down(grace_ms, now, &mut effects),
            Event::Tick(uid) => self.on_tick(&uid, now, &mut effects),
            Event::Forget(uid) => {
                self.works.remove(&uid);
            }
        }
        effects
    }

    fn on_life(&mut self, life: Life, now: Now, effects: &mut Vec<Effect>) {
        if life.attempt() != self.life.attempt() {
            // Nothing of the former attempt is left, and so nothing of its works.
            for work in self.works.values_mut().filter(|work| work.is_live()) {
                work.end(End::Lost(Loss::Executor), now);
            }
            (self.connected, self.registered, self.sequence) = (false, false, 0);
            self.ending = None;
        }
        self.life = life;
        // It may have connected before its runtime said that it lives.
        self.hand_over(effects);
    }

    fn claim(&mut self, uid: TaskUid, attempt: u32, stage: Stage, claimed: Wall) {
        let work = Work {
            attempt,
            stage,
            claimed,
            began: None,
            heard: false,
            // What came before is of an earlier attempt.
            sequence: self.sequence,
            absent: false,
            until: None,
            grace_ms: 0,
            disconnected: false,
        };
        self.works.insert(uid, work);
    }

    fn on_recorded(&mut self, uid: &TaskUid, effects: &mut Vec<Effect>) {
        match self.works.get_mut(uid) {
            Some(work) if work.stage == Stage::Claimed => work.stage = Stage::Recorded,
            _ => return,
        }
        self.hand_over(effects);
    }

    /// Hands over what the executor can take and does not have.
    fn hand_over(&mut self, effects: &mut Vec<Effect>) {
        if !self.accepts() {
            return;
        }
        for (uid, work) in &mut self.works {
            // An earlier hand-over may have been lost with its connection.
            let lost = work.stage == Stage::Sent && work.absent && !work.heard;
            if work.stage != Stage::Recorded && !lost {
                continue;
            }
            (work.stage, work.absent) = (Stage::Sent, false);
            effects.push(Effect::Launch(uid.clone()));
            if work.until.is_some() {
                effects.push(Effect::Kill { work: uid.clone(), grace_ms: work.grace_ms });
            }
        }
    }

    /// It counts as handed over: whether it was, the executor says when it registers.
    fn adopt(&mut self, uid: TaskUid, attempt: u32, record: Record, now: Now) {
        self.claim(uid.clone(), attempt, Stage::Sent, record.claimed);
        let same = self.life.attempt() == Some(record.life);
        if same {
            self.sequence = self.sequence.max(record.sequence);
        }
        let Some(work) = self.works.get_mut(&uid) else { return };
        (work.began, work.heard) = (record.began, record.heard);
        work.sequence = record.sequence;
        match record.exit {
            Some(exit) => work.stage = Stage::Ended(exit),
            None if !same => work.end(End::Lost(Loss::Executor), now),
            None if work.began.is_some() => work.stage = Stage::Running,
            None => {}
        }
    }

    fn on_registered(
        &mut self,
        works: &BTreeSet<TaskUid>,
        unacknowledged: Vec<Update>,
        now: Now,
        effects: &mut Vec<Effect>,
    ) {
        (self.connected, self.registered) = (true, true);
        // An update that is accounted for may be of an earlier attempt of the work.
        let new = unacknowledged.iter().filter(|update| {
            self.works.get(&update.work).is_some_and(|work| update.sequence > work.sequence)
        });
        let named: BTreeSet<TaskUid> =
            works.iter().chain(new.map(|update| &update.work)).cloned().collect();
        for update in unacknowledged {
            self.on_update(update, now, effects);
        }
        for uid in works.iter().filter(|uid| !self.works.get(*uid).is_some_and(Work::is_live)) {
            // Nobody here asks for it, and it must not go on.
            effects.push(Effect::Kill { work: uid.clone(), grace_ms: 0 });
        }
        for (uid, work) in &mut self.works {
            if !matches!(work.stage, Stage::Sent | Stage::Running) {
                continue;
            }
            work.absent = !named.contains(uid);
            if work.absent && work.heard {
                work.end(End::Lost(Loss::Executor), now);
            } else if !work.absent && work.until.is_some() {
                effects.push(Effect::Kill { work: uid.clone(), grace_ms: work.grace_ms });
            }
        }
        self.hand_over(effects);
        self.ask(now, effects);
    }

    fn on_shut_down(&mut self, grace_ms: u64, now: Now, effects: &mut Vec<Effect>) {
        let asked_for =
            if self.connected { grace_ms.saturating_mul(ASKED_FOR_PERCENT) / 100 } else { 0 };
        let (signal, kill) = (now.boot.plus(asked_for), now.boot.plus(grace_ms));
        // A later order only hastens it.
        let before = self.ending.unwrap_or(Ending { signal, kill });
        self.ending =
            Some(Ending { signal: signal.min(before.signal), kill: kill.min(before.kill) });
        self.ask(now, effects);
    }

    /// Tells an executor that must end, in case the last telling was lost with its connection.
    fn ask(&self, now: Now, effects: &mut Vec<Effect>) {
        if let Some(Ending { kill, .. }) = self.ending.filter(|_| self.connected) {
            let grace_ms = kill.0.saturating_sub(now.boot.0);
            effects.push(Effect::ShutDown { grace_ms });
        }
    }

    fn on_update(&mut self, update: Update, now: Now, effects: &mut Vec<Effect>) {
        let Update { work: uid, sequence, state } = update;
        if let Some(work) = self.works.get_mut(&uid) {
            if sequence > work.sequence && matches!(work.stage, Stage::Sent | Stage::Running) {
                work.heard = true;
                match state {
                    WorkState::Starting => {}
                    WorkState::Running => {
                        work.stage = Stage::Running;
                        work.began = work.began.or(Some(now.wall));
                    }
                    WorkState::Over(end) => work.end(end, now),
                }
            }
            work.sequence = work.sequence.max(sequence);
            // Also for one that was heard before: its record may still be under way.
            effects.push(Effect::Record(uid));
        }
        self.sequence = self.sequence.max(sequence);
        effects.push(Effect::Acknowledge(sequence));
    }

    fn on_stop(
        &mut self,
        uid: &TaskUid,
        grace_ms: u64,
        disconnected: bool,
        now: Now,
        effects: &mut Vec<Effect>,
    ) {
        let Some(work) = self.works.get_mut(uid).filter(|work| work.is_live()) else { return };
        work.disconnected |= disconnected;
        if matches!(work.stage, Stage::Claimed | Stage::Recorded) {
            let message = "it was ended before its executor had it".to_owned();
            return work.end(End::Said { said: Said::Killed, code: None, message }, now);
        }
        let until = now.boot.plus(grace_ms.saturating_add(REPORT_MS));
        if work.until.is_none_or(|before| until < before) {
            (work.until, work.grace_ms) = (Some(until), grace_ms);
        }
        // One that it does not have is ended as soon as it was handed over: it may answer for what
        // it does not know, and must not get it after that.
        if self.connected && !work.absent {
            effects.push(Effect::Kill { work: uid.clone(), grace_ms: work.grace_ms });
        }
    }

    fn on_tick(&mut self, uid: &TaskUid, now: Now, effects: &mut Vec<Effect>) {
        let Some(work) = self.works.get_mut(uid).filter(|work| work.is_live()) else { return };
        if work.until.is_some_and(|until| now.boot >= until)
            && let Some(attempt) = self.life.attempt()
        {
            work.until = Some(now.boot.plus(END_AGAIN_MS));
            effects.push(Effect::EndExecutor(attempt));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn uid(name: &str) -> TaskUid {
        TaskUid::new(name)
    }

    fn at(boot: u64) -> Now {
        Now { boot: Boot(boot), wall: Wall(i64::try_from(boot).expect("small")) }
    }

    fn said(work: &str, sequence: u64, state: WorkState) -> Event {
        Event::Said(Update { work: uid(work), sequence, state })
    }

    fn over() -> WorkState {
        let message = String::new();
        WorkState::Over(End::Said { said: Said::Succeeded, code: Some(0), message })
    }

    fn registered(works: &[&str]) -> Event {
        let works = works.iter().map(|work| uid(work)).collect();
        Event::Registered { works, unacknowledged: Vec::new() }
    }

    /// Connected, with work `a` handed over.
    fn busy() -> Executor {
        let mut executor = Executor::new(Life::Live(1));
        assert!(executor.handle(registered(&[]), at(0)).is_empty());
        assert!(executor.handle(Event::Claim(uid("a"), 1), at(0)).is_empty());
        let effects = executor.handle(Event::Recorded(uid("a")), at(0));
        assert_eq!(effects, [Effect::Launch(uid("a"))]);
        executor
    }

    fn end_of(executor: &Executor, work: &str) -> Option<End> {
        match &executor.work(&uid(work))?.stage {
            Stage::Ended(exit) => Some(exit.end.clone()),
            _ => None,
        }
    }

    #[test]
    fn an_update_is_written_down_before_it_is_acknowledged_and_counts_once() {
        let mut executor = busy();
        let effects = executor.handle(said("a", 1, WorkState::Running), at(5));
        assert_eq!(effects, [Effect::Record(uid("a")), Effect::Acknowledge(1)]);
        let _ = executor.handle(said("a", 2, over()), at(9));
        let before = executor.clone();
        let again = executor.handle(said("a", 1, WorkState::Running), at(10));
        assert_eq!(again, [Effect::Record(uid("a")), Effect::Acknowledge(1)]);
        assert_eq!(executor, before);
        assert_eq!(executor.record(&uid("a")).and_then(|record| record.began), Some(Wall(5)));
        assert_eq!(executor.handle(said("?", 3, over()), at(11)), [Effect::Acknowledge(3)]);
    }

    #[test]
    fn the_end_of_the_executor_is_the_end_of_its_works() {
        let mut executor = busy();
        assert!(executor.handle(Event::Disconnected, at(1)).is_empty());
        assert_eq!(end_of(&executor, "a"), None, "a broken connection proves nothing");
        assert!(executor.handle(Event::Life(Life::Ending(1)), at(1)).is_empty());
        assert_eq!(end_of(&executor, "a"), None, "it still ends");
        assert!(executor.handle(Event::Life(Life::Live(2)), at(2)).is_empty());
        assert_eq!(end_of(&executor, "a"), Some(End::Lost(Loss::Executor)));
    }

    #[test]
    fn the_last_words_of_an_earlier_life_are_not_heard_in_the_next() {
        let mut executor = busy();
        let _ = executor.handle(Event::Life(Life::Gone), at(1));
        let update = Update { work: uid("a"), sequence: 9, state: over() };
        let late = Event::Registered { works: BTreeSet::new(), unacknowledged: vec![update] };
        assert!(executor.handle(late, at(1)).is_empty());
        let _ = executor.handle(Event::Life(Life::Live(2)), at(2));
        assert!(executor.handle(said("a", 9, over()), at(2)).is_empty());
        let _ = executor.handle(registered(&[]), at(2));
        let _ = executor.handle(Event::Claim(uid("a"), 2), at(3));
        let _ = executor.handle(Event::Recorded(uid("a")), at(3));
        let _ = executor.handle(said("a", 1, over()), at(4));
        assert!(end_of(&executor, "a").is_some(), "the next life counts from 1");
    }

    #[test]
    fn a_stop_that_is_not_obeyed_ends_the_executor() {
        let mut executor = busy();
        let stop = |grace_ms| Event::Stop { work: uid("a"), grace_ms, disconnected: false };
        let kill = |grace_ms| Effect::Kill { work: uid("a"), grace_ms };
        assert_eq!(executor.handle(stop(9_000), at(0)), [kill(9_000)]);
        assert_eq!(executor.handle(stop(2_000), at(0)), [kill(2_000)]);
        assert_eq!(executor.handle(stop(9_000), at(0)), [kill(2_000)]);
        let _ = executor.handle(Event::Disconnected, at(1));
        assert_eq!(executor.handle(registered(&["a"]), at(2)), [kill(2_000)]);
        assert!(executor.handle(Event::Tick(uid("a")), at(2_999)).is_empty());
        let ends = [Effect::EndExecutor(1)];
        assert_eq!(executor.handle(Event::Tick(uid("a")), at(3_000)), ends);
        assert!(executor.handle(Event::Tick(uid("a")), at(3_001)).is_empty());
        assert_eq!(executor.handle(Event::Tick(uid("a")), at(8_000)), ends);
        assert_eq!(end_of(&executor, "a"), None, "only the kernel shows that it is gone");
    }

    #[test]
    fn an_executor_that_must_end_is_asked_before_it_is_signalled() {
        let mut executor = busy();
        let shut_down = |grace_ms| Event::ShutDown { grace_ms };
        let told = |grace_ms| [Effect::ShutDown { grace_ms }];
        let times = |signal_ms, kill_ms| StopTimes { signal_ms, kill_ms };
        let _ = executor.handle(Event::Life(Life::Ending(1)), at(0));
        assert_eq!(executor.handle(shut_down(10_000), at(0)), told(10_000));
        assert_eq!(executor.stop_times(10_000, Boot(0)), times(5_000, 10_000));
        assert_eq!(
            executor.handle(shut_down(20_000), at(1_000)),
            told(9_000),
            "no more than before"
        );
        assert_eq!(executor.stop_times(20_000, Boot(1_000)), times(4_000, 9_000));
        assert_eq!(executor.handle(shut_down(2_000), at(2_000)), told(2_000), "less hastens");
        assert_eq!(executor.stop_times(2_000, Boot(2_000)), times(1_000, 2_000));
        // What it was told may be lost with its connection.
        let _ = executor.handle(Event::Disconnected, at(2_100));
        let again = executor.handle(registered(&["a"]), at(2_500));
        assert_eq!(again, told(1_500));
        let _ = executor.handle(Event::Life(Life::Live(2)), at(3_000));
        assert!(!executor.is_there(), "the next life has not registered");
        assert_eq!(executor.stop_times(7, Boot(3_000)), times(0, 7));
    }

    #[test]
    fn who_cannot_be_asked_is_signalled_at_once() {
        let mut executor = busy();
        assert!(executor.is_there());
        let _ = executor.handle(Event::Disconnected, at(1));
        assert!(executor.is_there(), "it comes back");
        assert!(executor.handle(Event::ShutDown { grace_ms: 9_000 }, at(2)).is_empty());
        let now = StopTimes { signal_ms: 0, kill_ms: 9_000 };
        assert_eq!(executor.stop_times(9_000, Boot(2)), now);
        let _ = executor.handle(Event::Life(Life::Ending(1)), at(2));
        assert!(!executor.is_there());
    }

    #[test]
    fn who_comes_back_says_what_it_has() {
        let mut executor = busy();
        for work in ["b", "c"] {
            let _ = executor.handle(Event::Claim(uid(work), 1), at(0));
        }
        let _ = executor.handle(Event::Disconnected, at(1));
        assert!(executor.handle(Event::Recorded(uid("b")), at(1)).is_empty());
        let update = Update { work: uid("a"), sequence: 7, state: over() };
        let works = BTreeSet::from([uid("stranger")]);
        let effects =
            executor.handle(Event::Registered { works, unacknowledged: vec![update] }, at(2));
        assert_eq!(
            effects,
            [
                Effect::Record(uid("a")),
                Effect::Acknowledge(7),
                Effect::Kill { work: uid("stranger"), grace_ms: 0 },
                Effect::Launch(uid("b")),
            ]
        );
        assert_eq!(executor.work(&uid("c")).map(|work| &work.stage), Some(&Stage::Claimed));
        let again = executor.handle(registered(&[]), at(3));
        assert_eq!(again, [Effect::Launch(uid("b"))], "nobody knows whether it was heard");
        let _ = executor.handle(said("b", 8, WorkState::Starting), at(4));
        assert!(executor.handle(registered(&[]), at(5)).is_empty());
        assert_eq!(end_of(&executor, "b"), Some(End::Lost(Loss::Executor)), "it had it");
    }

    #[test]
    fn who_comes_back_before_it_is_known_to_live_gets_its_works_then() {
        let record = busy().record(&uid("a")).expect("it is there");
        let mut executor = Executor::new(Life::Unsure(1));
        let _ = executor.handle(Event::Adopted(uid("a"), 1, record), at(1));
        assert!(executor.handle(registered(&[]), at(2)).is_empty());
        let stop = Event::Stop { work: uid("a"), grace_ms: 9, disconnected: false };
        assert!(executor.handle(stop, at(3)).is_empty());
        let effects = executor.handle(Event::Life(Life::Live(1)), at(4));
        let kill = Effect::Kill { work: uid("a"), grace_ms: 9 };
        assert_eq!(effects, [Effect::Launch(uid("a")), kill]);
        assert!(executor.handle(Event::Life(Life::Live(1)), at(5)).is_empty());
    }

    #[test]
    fn works_are_taken_up_by_another_life_of_the_agent() {
        let mut executor = busy();
        let _ = executor.handle(said("a", 4, WorkState::Running), at(5));
        let record = executor.record(&uid("a")).expect("it is there");
        let mut next = Executor::new(Life::Unsure(1));
        let _ = next.handle(Event::Adopted(uid("a"), 1, record.clone()), at(9));
        assert_eq!(next.record(&uid("a")), Some(record.clone()));
        let mut other = Executor::new(Life::Unsure(2));
        let _ = other.handle(Event::Adopted(uid("a"), 1, record), at(9));
        assert_eq!(end_of(&other, "a"), Some(End::Lost(Loss::Executor)));
    }

    #[test]
    fn what_was_not_handed_over_ends_at_once() {
        let mut executor = Executor::new(Life::Live(1));
        let _ = executor.handle(registered(&[]), at(0));
        let _ = executor.handle(Event::Claim(uid("a"), 1), at(0));
        let stop = Event::Stop { work: uid("a"), grace_ms: 9, disconnected: false };
        assert!(executor.handle(stop, at(0)).is_empty());
        assert!(end_of(&executor, "a").is_some());
        assert!(executor.handle(Event::Recorded(uid("a")), at(0)).is_empty());
    }
}
