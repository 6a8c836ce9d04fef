//! One source's frames to its readers.
//!
//! A reader has one frame at a time, and says when it is done with it; others wait in a line of its own, from which the
//! oldest goes when it is full. The latest value is a line of one. A frame is whatever can be cloned cheaply: the last clone
//! that is dropped gives its memory back.

use std::collections::{BTreeMap, VecDeque};

/// Whoever reads. Numbers are never used twice.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub struct Reader(pub u64);

/// Frames that may wait for one reader: half a second of a camera.
pub const DEEPEST: usize = 16;

/// A frame for a reader.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Delivery<F> {
    /// Its number among the source's frames; the first is 1.
    pub sequence: u64,
    /// Frames since the reader's last one that it does not get.
    pub dropped: u64,
    /// The frame.
    pub frame: F,
}

/// A reader is done with a frame that it does not have.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error("it is done with frame {0}, which it does not have")]
pub struct NotHeld(pub u64);

/// Who gave a frame up for want of memory.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum GivenUp {
    /// Nobody: it was kept for readers that come.
    Kept,
    /// One that waited for this reader is dropped.
    Waiting(Reader),
    /// This reader has it, and is to be put out.
    Held(Reader),
}

/// The readers of one source.
#[derive(Debug)]
pub struct Fan<F> {
    /// Frames that were published.
    published: u64,
    /// The newest, for readers that come.
    newest: Option<Numbered<F>>,
    lines: BTreeMap<Reader, Line<F>>,
}

#[derive(Debug, Clone)]
struct Numbered<F> {
    sequence: u64,
    frame: F,
}

#[derive(Debug)]
struct Line<F> {
    depth: usize,
    waiting: VecDeque<Numbered<F>>,
    held: Option<Numbered<F>>,
    /// Since the last one that it was given.
    dropped: u64,
}

impl<F> Default for Fan<F> {
    fn default() -> Self {
        Fan { published: 0, newest: None, lines: BTreeMap::new() }
    }
}

impl<F> Line<F> {
    fn drop_oldest(&mut self) {
        if self.waiting.pop_front().is_some() {
            self.dropped += 1;
        }
    }

    /// The number of its oldest frame.
    fn oldest(&self) -> Option<u64> {
        self.held.as_ref().or_else(|| self.waiting.front()).map(|numbered| numbered.sequence)
    }
}

impl<F: Clone> Fan<F> {
    /// A reader comes, for which up to `depth` frames may wait (1 to [`DEEPEST`]). One that wants the latest value begins with
    /// the newest that there is, others with the next.
    pub fn open(&mut self, reader: Reader, depth: usize) {
        let depth = depth.clamp(1, DEEPEST);
        let first = self.newest.clone().filter(|_| depth == 1);
        let waiting = first.into_iter().collect();
        self.lines.insert(reader, Line { depth, waiting, held: None, dropped: 0 });
    }

    /// It is gone, and what it had.
    pub fn close(&mut self, reader: Reader) {
        self.lines.remove(&reader);
    }

    /// Whether it is there.
    #[must_use]
    pub fn reads(&self, reader: Reader) -> bool {
        self.lines.contains_key(&reader)
    }

    /// A new frame. Returns those who can take one now and could not before.
    pub fn publish(&mut self, frame: F) -> Vec<Reader> {
        self.published += 1;
        let new = Numbered { sequence: self.published, frame };
        let mut ready = Vec::new();
        for (reader, line) in &mut self.lines {
            if line.held.is_none() && line.waiting.is_empty() {
                ready.push(*reader);
            }
            if line.waiting.len() == line.depth {
                line.drop_oldest();
            }
            line.waiting.push_back(new.clone());
        }
        self.newest = Some(new);
        ready
    }

    /// The reader's next frame; none: it has one, or none waits.
    pub fn take(&mut self, reader: Reader) -> Option<Delivery<F>> {
        let line = self.lines.get_mut(&reader).filter(|line| line.held.is_none())?;
        let Numbered { sequence, frame } = line.waiting.pop_front()?;
        line.held = Some(Numbered { sequence, frame: frame.clone() });
        let dropped = std::mem::take(&mut line.dropped);
        Some(Delivery { sequence, dropped, frame })
    }

    /// The reader is done with its frame.
    ///
    /// # Errors
    ///
    /// It does not have that one.
    pub fn done(&mut self, reader: Reader, sequence: u64) -> Result<(), NotHeld> {
        let line = self.lines.get_mut(&reader).ok_or(NotHeld(sequence))?;
        line.held.take_if(|held| held.sequence == sequence).map(drop).ok_or(NotHeld(sequence))
    }

    /// The source is not read any more: what it said last is not new to whoever comes.
    pub fn forget(&mut self) {
        self.newest = None;
    }

    /// Memory runs out: the oldest frame goes, whoever has it. None: there is none. A frame that several have goes when this
    /// was called for each of them.
    pub fn give_up(&mut self) -> Option<GivenUp> {
        if self.newest.take().is_some() {
            return Some(GivenUp::Kept);
        }
        let oldest = |(reader, line): (&Reader, &Line<F>)| Some((line.oldest()?, *reader));
        let (_, reader) = self.lines.iter().filter_map(oldest).min()?;
        let line = self.lines.get_mut(&reader)?;
        if line.held.is_some() {
            self.lines.remove(&reader);
            return Some(GivenUp::Held(reader));
        }
        line.drop_oldest();
        Some(GivenUp::Waiting(reader))
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    const A: Reader = Reader(1);
    const B: Reader = Reader(2);

    fn published(fan: &mut Fan<u64>, frames: std::ops::RangeInclusive<u64>) {
        frames.for_each(|frame| drop(fan.publish(frame)));
    }

    #[test]
    fn the_latest_value_is_that_of_the_moment_it_is_asked_for() {
        let mut fan = Fan::default();
        fan.open(A, 1);
        assert_eq!(fan.publish(1), [A]);
        assert_eq!(fan.take(A), Some(Delivery { sequence: 1, dropped: 0, frame: 1 }));
        published(&mut fan, 2..=5);
        assert_eq!(fan.take(A), None, "it has one");
        assert_eq!(fan.done(A, 2), Err(NotHeld(2)));
        assert_eq!(fan.done(A, 1), Ok(()));
        assert_eq!(fan.take(A), Some(Delivery { sequence: 5, dropped: 3, frame: 5 }));
    }

    #[test]
    fn who_comes_for_the_latest_value_begins_with_it_and_a_queue_with_the_next() {
        let mut fan = Fan::default();
        published(&mut fan, 1..=3);
        fan.open(A, 0);
        fan.open(B, 4);
        assert_eq!(fan.take(A).map(|d| (d.sequence, d.dropped)), Some((3, 0)));
        assert_eq!(fan.take(B), None);
        assert_eq!(fan.publish(4), [B]);
        assert_eq!(fan.take(B).map(|d| (d.sequence, d.dropped)), Some((4, 0)));
        fan.forget();
        fan.close(A);
        fan.open(A, 1);
        assert_eq!(fan.take(A), None, "what a source that is gone said last is not new");
    }

    #[test]
    fn for_want_of_memory_the_oldest_goes() {
        let mut fan = Fan::default();
        fan.open(A, 1);
        fan.open(B, 3);
        published(&mut fan, 1..=1);
        fan.take(A);
        published(&mut fan, 2..=2);
        assert_eq!(fan.give_up(), Some(GivenUp::Kept));
        assert_eq!(fan.give_up(), Some(GivenUp::Held(A)), "the first of two that have frame 1");
        assert!(!fan.reads(A));
        assert_eq!(fan.give_up(), Some(GivenUp::Waiting(B)));
        assert_eq!(fan.take(B), Some(Delivery { sequence: 2, dropped: 1, frame: 2 }));
        assert_eq!(fan.give_up(), Some(GivenUp::Held(B)));
        assert_eq!(fan.give_up(), None);
    }

    #[derive(Debug, Clone)]
    enum Step {
        Publish,
        Take(u64),
        Done(u64),
        Open(u64, usize),
        Close(u64),
    }

    fn steps() -> impl Strategy<Value = Vec<Step>> {
        let step = prop_oneof![
            4 => Just(Step::Publish),
            3 => (0..4_u64).prop_map(Step::Take),
            3 => (0..4_u64).prop_map(Step::Done),
            1 => (0..4_u64, 0..6_usize).prop_map(|(reader, depth)| Step::Open(reader, depth)),
            1 => (1..4_u64).prop_map(Step::Close),
        ];
        proptest::collection::vec(step, 0..200)
    }

    /// What each reader was given, by step.
    type Given = Vec<(u64, Delivery<u64>)>;

    /// Carries out the steps of those readers alone; checks what holds for each.
    fn run(steps: &[Step], of: impl Fn(u64) -> bool) -> Given {
        let (mut fan, mut given) = (Fan::default(), Vec::new());
        let (mut published, mut held) = (0, BTreeMap::new());
        let mut last: BTreeMap<u64, u64> = BTreeMap::new();
        for step in steps {
            match *step {
                Step::Publish => {
                    published += 1;
                    fan.publish(published);
                }
                Step::Open(reader, depth) if of(reader) && !fan.reads(Reader(reader)) => {
                    fan.open(Reader(reader), depth);
                    held.remove(&reader);
                    last.remove(&reader);
                }
                Step::Close(reader) if of(reader) => fan.close(Reader(reader)),
                Step::Done(reader) if of(reader) => {
                    if let Some(sequence) = held.remove(&reader)
                        && fan.reads(Reader(reader))
                    {
                        fan.done(Reader(reader), sequence).unwrap();
                    }
                }
                Step::Take(reader) if of(reader) => {
                    if let Some(delivery) = fan.take(Reader(reader)) {
                        assert!(held.insert(reader, delivery.sequence).is_none(), "one at a time");
                        assert_eq!(delivery.sequence, delivery.frame);
                        if let Some(before) = last.insert(reader, delivery.sequence) {
                            let between = delivery.sequence - before - 1;
                            assert_eq!(delivery.dropped, between, "it is told of all");
                        }
                        given.push((reader, delivery));
                    }
                }
                _ => {}
            }
            for line in fan.lines.values() {
                assert!(line.waiting.len() <= line.depth);
            }
        }
        given
    }

    proptest! {
        #[test]
        fn a_reader_gets_what_it_would_get_alone(steps in steps()) {
            let together = run(&steps, |_| true);
            for reader in 0..4 {
                let of_it: Given = together.iter().filter(|(r, _)| *r == reader).cloned().collect();
                prop_assert_eq!(of_it, run(&steps, |r| r == reader));
            }
        }

        #[test]
        fn giving_up_ends_with_nothing_and_never_takes_a_newer_frame(steps in steps()) {
            let mut fan = Fan::default();
            for step in &steps {
                match *step {
                    Step::Publish => drop(fan.publish(())),
                    Step::Open(reader, depth) if !fan.reads(Reader(reader)) => fan.open(Reader(reader), depth),
                    Step::Take(reader) => drop(fan.take(Reader(reader))),
                    _ => {}
                }
            }
            fan.forget();
            let mut before = 0;
            loop {
                let oldest = fan.lines.values().filter_map(Line::oldest).min();
                prop_assert_eq!(oldest.is_some(), fan.give_up().is_some());
                let Some(oldest) = oldest else { break };
                prop_assert!(oldest >= before);
                before = oldest;
            }
        }
    }
}
