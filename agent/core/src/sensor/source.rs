//! When a source is read. One run at a time: the next one begins when the one before has ended.

use crate::time::Boot;

/// Before the second try: whatever a driver needs after a crash is most often there by then.
pub const FIRST_PAUSE_MS: u64 = 200;

/// The longest pause: a camera that is plugged in again is read soon after.
pub const LONGEST_PAUSE_MS: u64 = 30_000;

/// A run that delivered for this long was healthy; the pauses begin anew.
pub const HEALTHY_MS: u64 = 10_000;

/// What happens to a source.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Event {
    /// Whether any task wants it.
    Wanted(bool),
    /// It delivered a frame.
    Frame,
    /// It runs, and says why nothing comes.
    Trouble(String),
    /// The run is over: why.
    Ended(String),
    /// Time has passed.
    Tick,
}

/// What is to be done. Each run that is begun ends with one [`Event::Ended`], asked for or not.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Action {
    /// Begin a run.
    Start,
    /// End the run.
    End,
}

/// How it stands, for people.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub enum Standing {
    /// No task wants it.
    #[default]
    Idle,
    /// It has not failed, and delivered nothing yet.
    Starting,
    /// Frames come.
    Delivering,
    /// None come: why. It is tried again.
    Failing(String),
}

#[derive(Debug, Clone, PartialEq, Eq)]
enum State {
    /// Nobody wants it.
    Idle,
    /// It is read.
    Running { since: Boot, newest: Option<Boot> },
    /// The run was told to end; `failed`: by its own fault.
    Ending { failed: bool },
    /// A run has failed; the next begins then.
    Waiting { until: Boot },
}

/// One source.
#[derive(Debug, Clone)]
pub struct Source {
    wanted: bool,
    state: State,
    /// Runs in a row that failed.
    failures: u32,
    /// Why nothing comes.
    why: Option<String>,
    /// A run that delivers nothing for so long has failed; none: it may be silent.
    silence_ms: Option<u64>,
}

impl Source {
    /// One that nobody wants yet.
    #[must_use]
    pub fn new(silence_ms: Option<u64>) -> Source {
        Source { wanted: false, state: State::Idle, failures: 0, why: None, silence_ms }
    }

    /// How it stands.
    #[must_use]
    pub fn standing(&self) -> Standing {
        match (&self.state, &self.why) {
            (State::Idle, _) => Standing::Idle,
            (_, Some(why)) => Standing::Failing(why.clone()),
            (State::Running { newest: Some(_), .. }, None) => Standing::Delivering,
            (_, None) => Standing::Starting,
        }
    }

    /// When it wants a [`Event::Tick`].
    #[must_use]
    pub fn wakes_at(&self) -> Option<Boot> {
        match self.state {
            State::Waiting { until } => Some(until),
            State::Running { since, newest } => {
                self.silence_ms.map(|silence| newest.unwrap_or(since).plus(silence))
            }
            State::Idle | State::Ending { .. } => None,
        }
    }

    /// Takes in what happened.
    #[must_use]
    pub fn handle(&mut self, event: Event, now: Boot) -> Option<Action> {
        match event {
            Event::Wanted(wanted) => self.want(wanted, now),
            Event::Frame => {
                if let State::Running { newest, .. } = &mut self.state {
                    (*newest, self.why) = (Some(now), None);
                }
                None
            }
            Event::Trouble(why) => {
                if matches!(self.state, State::Running { .. }) {
                    self.why = Some(why);
                }
                None
            }
            Event::Ended(why) => self.ended(why, now),
            Event::Tick => self.tick(now),
        }
    }

    fn want(&mut self, wanted: bool, now: Boot) -> Option<Action> {
        self.wanted = wanted;
        match (&self.state, wanted) {
            (State::Idle, true) => Some(self.start(now)),
            (State::Running { .. }, false) => {
                self.state = State::Ending { failed: false };
                Some(Action::End)
            }
            (State::Waiting { .. }, false) => {
                self.rest();
                None
            }
            _ => None,
        }
    }

    fn ended(&mut self, why: String, now: Boot) -> Option<Action> {
        match self.state {
            State::Running { since, newest } => {
                self.why = Some(why);
                self.failed(since, newest);
            }
            State::Ending { failed: false } if self.wanted => return Some(self.start(now)),
            State::Ending { .. } => {}
            // No run was under way.
            State::Idle | State::Waiting { .. } => return None,
        }
        if self.wanted {
            self.state = State::Waiting { until: now.plus(pause_ms(self.failures)) };
        } else {
            self.rest();
        }
        None
    }

    fn tick(&mut self, now: Boot) -> Option<Action> {
        match self.state {
            State::Waiting { until } if now >= until => Some(self.start(now)),
            State::Running { since, newest } if self.wakes_at().is_some_and(|at| now >= at) => {
                let silent = now.0.saturating_sub(newest.unwrap_or(since).0);
                self.why.get_or_insert_with(|| format!("it said nothing for {silent} ms"));
                self.failed(since, newest);
                self.state = State::Ending { failed: true };
                Some(Action::End)
            }
            _ => None,
        }
    }

    fn start(&mut self, now: Boot) -> Action {
        self.state = State::Running { since: now, newest: None };
        Action::Start
    }

    fn failed(&mut self, since: Boot, newest: Option<Boot>) {
        let delivered = newest.map_or(0, |newest| newest.0.saturating_sub(since.0));
        let before = if delivered >= HEALTHY_MS { 0 } else { self.failures };
        self.failures = before.saturating_add(1);
    }

    fn rest(&mut self) {
        (self.state, self.failures, self.why) = (State::Idle, 0, None);
    }
}

/// `FIRST_PAUSE_MS · 2^(failures − 1)`, at most [`LONGEST_PAUSE_MS`].
#[must_use]
pub fn pause_ms(failures: u32) -> u64 {
    let doubled = FIRST_PAUSE_MS.checked_shl(failures.saturating_sub(1));
    doubled.filter(|_| failures < 32).map_or(LONGEST_PAUSE_MS, |pause| pause.min(LONGEST_PAUSE_MS))
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn failing(why: &str) -> Standing {
        Standing::Failing(why.to_owned())
    }

    #[test]
    fn it_is_read_while_it_is_wanted_and_tried_again_when_it_fails() {
        let mut source = Source::new(None);
        let at = Boot;
        assert_eq!(source.handle(Event::Wanted(true), at(0)), Some(Action::Start));
        assert_eq!(source.standing(), Standing::Starting);
        assert_eq!(source.handle(Event::Ended("no device".to_owned()), at(5)), None);
        assert_eq!(source.standing(), failing("no device"));
        assert_eq!(source.wakes_at(), Some(at(205)));
        assert_eq!(source.handle(Event::Tick, at(204)), None);
        assert_eq!(source.handle(Event::Tick, at(205)), Some(Action::Start));
        assert_eq!(source.standing(), failing("no device"), "until it delivers");
        assert_eq!(source.handle(Event::Frame, at(300)), None);
        assert_eq!(source.standing(), Standing::Delivering);
        assert_eq!(source.handle(Event::Wanted(false), at(400)), Some(Action::End));
        assert_eq!(source.handle(Event::Wanted(true), at(401)), None, "the run has not ended");
        assert_eq!(source.handle(Event::Ended(String::new()), at(410)), Some(Action::Start));
        assert_eq!(source.handle(Event::Wanted(false), at(411)), Some(Action::End));
        assert_eq!(source.handle(Event::Ended(String::new()), at(412)), None);
        assert_eq!(source.standing(), Standing::Idle);
    }

    #[test]
    fn silence_is_a_failure_where_it_is_said_to_be_one() {
        let mut source = Source::new(Some(1_000));
        assert_eq!(source.handle(Event::Wanted(true), Boot(0)), Some(Action::Start));
        assert_eq!(source.handle(Event::Frame, Boot(900)), None);
        assert_eq!(source.handle(Event::Tick, Boot(1_000)), None);
        assert_eq!(source.wakes_at(), Some(Boot(1_900)));
        assert_eq!(source.handle(Event::Tick, Boot(1_900)), Some(Action::End));
        assert_eq!(source.standing(), failing("it said nothing for 1000 ms"));
        assert_eq!(source.handle(Event::Ended("killed".to_owned()), Boot(1_950)), None);
        assert_eq!(source.standing(), failing("it said nothing for 1000 ms"));
        assert_eq!(source.handle(Event::Tick, Boot(2_150)), Some(Action::Start));
    }

    #[test]
    fn pauses_double_to_a_cap_and_begin_anew_after_a_healthy_run() {
        let pauses: Vec<u64> = (1..=10).map(pause_ms).collect();
        assert_eq!(pauses[..4], [200, 400, 800, 1_600]);
        assert_eq!((pauses[9], pause_ms(u32::MAX)), (LONGEST_PAUSE_MS, LONGEST_PAUSE_MS));
        let mut source = Source::new(None);
        source.failures = 7;
        let _ = source.handle(Event::Wanted(true), Boot(0));
        let _ = source.handle(Event::Frame, Boot(HEALTHY_MS));
        let _ = source.handle(Event::Ended("gone".to_owned()), Boot(HEALTHY_MS));
        assert_eq!(source.failures, 1);
    }

    fn event() -> impl Strategy<Value = (Event, u64)> {
        let event = prop_oneof![
            1 => any::<bool>().prop_map(Event::Wanted),
            1 => Just(Event::Frame),
            1 => Just(Event::Trouble("t".to_owned())),
            1 => Just(Event::Ended("e".to_owned())),
            3 => Just(Event::Tick),
        ];
        (event, 0..2_000_u64)
    }

    proptest! {
        #[test]
        fn one_run_at_a_time_and_always_one_when_it_is_wanted(
            events in proptest::collection::vec(event(), 0..100),
            silence in proptest::option::of(1..3_000_u64),
        ) {
            let mut source = Source::new(silence);
            let (mut now, mut runs, mut wanted) = (0, false, false);
            let mut take = |source: &mut Source, event: Event, now: u64| {
                match &event {
                    Event::Wanted(is) => wanted = *is,
                    // Only a run that is there ends.
                    Event::Ended(_) if !runs => return (runs, wanted),
                    Event::Ended(_) => runs = false,
                    _ => {}
                }
                match source.handle(event, Boot(now)) {
                    Some(Action::Start) => {
                        assert!(!runs && wanted, "a second run, or one that nobody wants");
                        runs = true;
                    }
                    Some(Action::End) => assert!(runs, "nothing is there to end"),
                    None => {}
                }
                (runs, wanted)
            };
            for (event, passes) in events {
                now += passes;
                take(&mut source, event, now);
            }
            // Whatever was told to end ends, and whatever is due is done.
            if matches!(source.state, State::Ending { .. }) {
                take(&mut source, Event::Ended(String::new()), now);
            }
            if let State::Waiting { until } = source.state {
                prop_assert!(until.0 <= now + LONGEST_PAUSE_MS);
                now = until.0;
            }
            let (runs, wanted) = take(&mut source, Event::Frame, now);
            let (runs, wanted) = if runs == wanted { (runs, wanted) } else { take(&mut source, Event::Tick, now) };
            prop_assert_eq!(runs, wanted);
            prop_assert_eq!(source.standing() == Standing::Idle, !wanted);
        }
    }
}
