//! Two ends, two ways between them, and everything that may happen to either in any order.

use std::collections::{BTreeMap, VecDeque};

use proptest::prelude::*;

use super::{Effect, End, Event, Line, Out};

/// What travels through the controller.
#[derive(Debug, Clone, PartialEq)]
enum Relay {
    Message(u32),
    Mark(Line),
}

/// What travels over a line.
#[derive(Debug, Clone, PartialEq)]
enum Frame {
    Welcome,
    Passed,
    Message(u32),
}

/// A connection. Its ends are looked after by two programs, which notice what happens to it one after the other.
#[derive(Debug, Default)]
struct Wire {
    /// Under way to each side; what is there can be read after the other side has closed.
    to: [VecDeque<Frame>; 2],
    /// The side still looks after it.
    kept: [bool; 2],
    broken: bool,
}

/// The framework is side 0 and dials.
#[derive(Debug, Default)]
struct World {
    ends: [End<u32>; 2],
    relay: [VecDeque<Relay>; 2],
    wires: BTreeMap<Line, Wire>,
    last_line: u64,
    sent: [u32; 2],
    delivered: [Vec<u32>; 2],
}

#[derive(Debug, Clone)]
enum Step {
    Send(usize),
    Relay(usize),
    Write(usize),
    Read(usize),
    Dial,
    Accept,
    /// The connection breaks, and so much of what was under way is lost with it.
    Break(usize),
    Notice(usize),
    Late(usize),
    /// A session with the controller breaks.
    LoseRelayed(usize),
}

impl World {
    fn happens(&mut self, side: usize, event: Event<u32>) {
        self.comes(side, event, 0);
    }

    /// With the message that it is about, if it is about one.
    fn comes(&mut self, side: usize, event: Event<u32>, message: u32) {
        for effect in self.ends[side].handle(event) {
            match effect {
                Effect::Relay(message) => {
                    self.relay[1 - side].push_back(Relay::Message(message));
                }
                Effect::Mark(line) => self.relay[1 - side].push_back(Relay::Mark(line)),
                Effect::Deliver => self.delivered[side].push(message),
                Effect::Wake(_) => {}
                Effect::Close(line) => {
                    if let Some(wire) = self.wires.get_mut(&line) {
                        wire.kept[side] = false;
                        wire.broken = true;
                    }
                }
            }
        }
    }

    /// The line that a side looks after.
    fn kept(&self, side: usize) -> Option<Line> {
        self.wires.iter().find(|(_, wire)| wire.kept[side]).map(|(line, _)| *line)
    }

    fn relay(&mut self, to: usize) -> bool {
        match self.relay[to].pop_front() {
            Some(Relay::Message(message)) => self.comes(to, Event::Relayed, message),
            Some(Relay::Mark(line)) => self.happens(to, Event::Marked(line)),
            None => return false,
        }
        true
    }

    fn write(&mut self, side: usize) -> bool {
        let Some(line) = self.kept(side) else { return false };
        // A connection begins with its Welcome, whatever the end wants to say already.
        if self.ends[side].line() != Some(line) || (side == 0 && !self.is_open(line)) {
            return false;
        }
        let Some(out) = self.ends[side].take(line) else { return false };
        let wire = self.wires.get_mut(&line).expect("kept");
        if !wire.broken {
            wire.to[1 - side].push_back(match out {
                Out::Passed => Frame::Passed,
                Out::Message(message) => Frame::Message(message),
            });
        }
        true
    }

    /// The framework has read the Welcome.
    fn is_open(&self, line: Line) -> bool {
        let wire = &self.wires[&line];
        wire.kept[1] && !wire.to[0].contains(&Frame::Welcome) || wire.broken
    }

    fn read(&mut self, side: usize) -> bool {
        let Some(line) = self.kept(side) else { return false };
        match self.wires.get_mut(&line).expect("kept").to[side].pop_front() {
            Some(Frame::Welcome) => self.happens(side, Event::Opened(line)),
            Some(Frame::Passed) => self.happens(side, Event::Passed(line)),
            Some(Frame::Message(message)) => self.comes(side, Event::Arrived(line), message),
            None => return false,
        }
        true
    }

    fn dial(&mut self) {
        if self.kept(0).is_none() {
            self.last_line += 1;
            let line = Line::new(self.last_line).expect("not 0");
            self.wires.insert(line, Wire { kept: [true, false], ..Wire::default() });
            self.happens(0, Event::Dialled(line));
        }
    }

    /// The agent lets the newest connection in, in place of an older one.
    fn accept(&mut self) {
        let Some((line, wire)) = self.wires.last_key_value() else { return };
        let (line, fresh) = (*line, !wire.broken && !wire.kept[1] && wire.to[0].is_empty());
        if fresh && self.ends[1].line() != Some(line) {
            if let Some(before) = self.kept(1) {
                self.wires.get_mut(&before).expect("kept").kept[1] = false;
            }
            let wire = self.wires.get_mut(&line).expect("the last");
            wire.kept[1] = true;
            wire.to[0].push_back(Frame::Welcome);
            self.happens(1, Event::Opened(line));
        }
    }

    fn notice(&mut self, side: usize) -> bool {
        let Some(line) = self.kept(side) else { return false };
        let wire = self.wires.get_mut(&line).expect("kept");
        if !wire.broken {
            return false;
        }
        wire.kept[side] = false;
        self.happens(side, Event::Closed(line));
        true
    }

    fn step(&mut self, step: &Step) {
        match *step {
            Step::Send(side) => {
                self.sent[side] += 1;
                self.happens(side, Event::Send(self.sent[side]));
            }
            Step::Relay(to) => drop(self.relay(to)),
            Step::Write(side) => drop(self.write(side)),
            Step::Read(side) => drop(self.read(side)),
            Step::Dial => self.dial(),
            Step::Accept => self.accept(),
            Step::Break(lost) => {
                for wire in self.wires.values_mut() {
                    wire.broken = true;
                    for under_way in &mut wire.to {
                        under_way.truncate(under_way.len().saturating_sub(lost));
                    }
                }
            }
            Step::Notice(side) => drop(self.notice(side)),
            Step::Late(side) => {
                if let Some(line) = self.ends[side].line() {
                    self.happens(side, Event::Late(line));
                }
            }
            Step::LoseRelayed(to) => self.relay[to].clear(),
        }
    }

    /// Until nothing moves any more.
    fn settle(&mut self) {
        let mut moves = true;
        while moves {
            moves = false;
            for side in [0, 1] {
                moves |= self.relay(side) | self.write(side) | self.read(side) | self.notice(side);
            }
        }
    }
}

fn orderly() -> impl Strategy<Value = Step> {
    prop_oneof![
        4 => (0..2_usize).prop_map(Step::Send),
        4 => (0..2_usize).prop_map(Step::Relay),
        4 => (0..2_usize).prop_map(Step::Write),
        4 => (0..2_usize).prop_map(Step::Read),
        1 => Just(Step::Dial),
        1 => Just(Step::Accept),
    ]
}

fn any_step() -> impl Strategy<Value = Step> {
    prop_oneof![
        20 => orderly(),
        1 => (0..4_usize).prop_map(Step::Break),
        2 => (0..2_usize).prop_map(Step::Notice),
        1 => (0..2_usize).prop_map(Step::Late),
        1 => (0..2_usize).prop_map(Step::LoseRelayed),
    ]
}

/// Sent by the other side: in order, and at most once.
fn in_order(delivered: &[u32]) -> bool {
    delivered.windows(2).all(|pair| pair[0] < pair[1])
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(1_000))]

    #[test]
    fn whatever_breaks_messages_come_in_order_and_at_most_once(
        steps in prop::collection::vec(any_step(), 1..120),
    ) {
        let mut world = World::default();
        for step in &steps {
            world.step(step);
            prop_assert!(world.delivered.iter().all(|d| in_order(d)), "{step:?} {world:?}");
        }
        // A mark that was lost is late at some time; then nothing is held back any more.
        world.settle();
        world.step(&Step::Late(0));
        world.step(&Step::Late(1));
        world.settle();
        let before = world.delivered.clone();
        world.step(&Step::Send(0));
        world.step(&Step::Send(1));
        world.settle();
        for side in [0, 1] {
            prop_assert!(in_order(&world.delivered[side]), "{world:?}");
            prop_assert_eq!(world.delivered[side].len(), before[side].len() + 1, "{:?}", world);
        }
    }

    #[test]
    fn where_nothing_breaks_nothing_is_lost(steps in prop::collection::vec(orderly(), 1..120)) {
        let mut world = World::default();
        for step in &steps {
            world.step(step);
        }
        world.settle();
        for side in [0, 1] {
            let all: Vec<u32> = (1..=world.sent[1 - side]).collect();
            prop_assert_eq!(&world.delivered[side], &all, "{:?}", world);
        }
    }
}

#[test]
fn once_both_marks_have_come_nothing_is_relayed() {
    let mut world = World::default();
    for side in [0, 1] {
        world.step(&Step::Send(side));
    }
    world.step(&Step::Dial);
    world.step(&Step::Accept);
    for side in [0, 1] {
        world.step(&Step::Send(side));
    }
    world.settle();
    assert!(world.ends.iter().all(End::is_direct));
    for side in [0, 1] {
        world.step(&Step::Send(side));
        assert!(world.relay[1 - side].is_empty());
    }
    world.settle();
    assert_eq!(world.delivered, [vec![1, 2, 3], vec![1, 2, 3]]);
}

#[test]
fn what_was_not_begun_goes_through_the_controller_and_what_was_is_never_read_after_it() {
    let mut world = World::default();
    world.step(&Step::Dial);
    world.step(&Step::Accept);
    world.settle();
    for _ in 0..3 {
        world.step(&Step::Send(0));
    }
    // The first is written and unread when the framework gives the connection up.
    world.step(&Step::Write(0));
    world.step(&Step::Break(0));
    world.step(&Step::Notice(0));
    assert_eq!(world.relay[1].len(), 2);
    world.step(&Step::Relay(1));
    world.step(&Step::Read(1));
    world.settle();
    assert_eq!(world.delivered[1], [2, 3]);
}

#[test]
fn a_message_that_comes_before_its_mark_ends_the_line() {
    let mut end: End<u32> = End::default();
    let line = Line::new(1).expect("not 0");
    assert_eq!(end.handle(Event::Opened(line)), [Effect::Mark(line)]);
    assert_eq!(end.handle(Event::Send(5)), []);
    let effects = end.handle(Event::Arrived(line));
    assert_eq!(effects, [Effect::Close(line), Effect::Relay(5)]);
    assert_eq!(end.handle(Event::Arrived(line)), []);
}
