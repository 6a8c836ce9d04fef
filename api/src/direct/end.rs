//! Which way a message goes: the state of one end of the way between a framework and one of its executors. The same at both
//! ends, but for who dials.
//!
//! ```text
//!   leaving:   Relayed ──Opened, a mark is sent──▶ Held ──Passed──▶ Direct ──the line ends──▶ Relayed
//!   arriving:  Relayed ──the other's mark──▶ Direct ──the line ends, or a relayed message comes──▶ Relayed
//! ```
//!
//! Messages of one direction go one way at a time. A mark travels behind everything that was relayed before it; while it
//! does, messages are held. The other way round there is nothing to wait for: a relayed message that comes while a line
//! is open for its direction shows that the sender has left the line, so the receiver leaves it as well and never reads
//! what is still in it.

use std::collections::VecDeque;

use super::Line;

/// What happens at an end.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Event<M> {
    /// This end dials. From now on the other end may mark this line.
    Dialled(Line),
    /// The other end is known to take the line.
    Opened(Line),
    /// The other end's mark came through the controller.
    Marked(Line),
    /// The other end says over the line that the mark of this one has come.
    Passed(Line),
    /// A message is to be sent.
    Send(M),
    /// A message came through the controller.
    Relayed,
    /// A message came over the line.
    Arrived(Line),
    /// The mark of this end has had [`super::MARK_WITHIN`] to come through.
    Late(Line),
    /// The line is no more.
    Closed(Line),
}

/// What is to be done, in this order.
#[derive(Debug, Clone, PartialEq, Eq)]
#[must_use]
pub enum Effect<M> {
    /// Send this message through the controller.
    Relay(M),
    /// Send a mark of the line through the controller, behind everything that was relayed.
    Mark(Line),
    /// Give the message that came to whom it is for. Without this effect it is dropped.
    Deliver,
    /// There is something to [`End::take`] for the line.
    Wake(Line),
    /// End the line. Nothing is taken for it any more, and what comes over it is dropped.
    Close(Line),
}

/// What is written to a line.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Out<M> {
    /// The other end's mark has come.
    Passed,
    /// A message.
    Message(M),
}

#[derive(Debug)]
enum Leaving<M> {
    /// The line is being dialled.
    Relayed,
    /// The mark is under way; what is to be sent waits for it, in order.
    Held(VecDeque<M>),
    Direct,
}

#[derive(Debug)]
struct Present<M> {
    line: Line,
    leaving: Leaving<M>,
    /// The other end has marked the line: its messages come over it.
    arrives: bool,
    /// Not yet taken.
    out: VecDeque<Out<M>>,
}

/// One end. Without a line everything is relayed.
#[derive(Debug)]
pub struct End<M> {
    present: Option<Present<M>>,
}

impl<M> Default for End<M> {
    fn default() -> Self {
        End { present: None }
    }
}

impl<M> End<M> {
    /// The line that is open or being dialled.
    #[must_use]
    pub fn line(&self) -> Option<Line> {
        self.present.as_ref().map(|present| present.line)
    }

    /// Whether what is sent now goes over a line.
    #[must_use]
    pub fn is_direct(&self) -> bool {
        self.present.as_ref().is_some_and(|p| matches!(p.leaving, Leaving::Direct))
    }

    /// The next thing to write to `line`. What was taken and is not read at the other end when the line ends, is lost.
    pub fn take(&mut self, line: Line) -> Option<Out<M>> {
        self.at(line)?.out.pop_front()
    }

    fn at(&mut self, line: Line) -> Option<&mut Present<M>> {
        self.present.as_mut().filter(|present| present.line == line)
    }

    /// Decides.
    pub fn handle(&mut self, event: Event<M>) -> Vec<Effect<M>> {
        match event {
            Event::Dialled(line) => self.begin(line, Leaving::Relayed),
            Event::Opened(line) => self.opened(line),
            Event::Marked(line) => self.marked(line),
            Event::Passed(line) => self.passed(line),
            Event::Send(message) => self.send(message),
            Event::Relayed => {
                let mut effects = Vec::new();
                if let Some(present) = self.present.as_ref().filter(|present| present.arrives) {
                    effects = self.end(present.line);
                }
                effects.push(Effect::Deliver);
                effects
            }
            Event::Arrived(line) => match self.at(line) {
                Some(Present { arrives: true, .. }) => vec![Effect::Deliver],
                // It came before its mark: the other end does not keep to the order.
                Some(_) => self.end(line),
                None => Vec::new(),
            },
            Event::Late(line) => match self.at(line) {
                Some(Present { leaving: Leaving::Held(_), .. }) => self.end(line),
                _ => Vec::new(),
            },
            Event::Closed(line) => self.end(line),
        }
    }

    fn begin(&mut self, line: Line, leaving: Leaving<M>) -> Vec<Effect<M>> {
        let effects = self.present.as_ref().map(|present| present.line);
        let effects = effects.map(|before| self.end(before)).unwrap_or_default();
        self.present = Some(Present { line, leaving, arrives: false, out: VecDeque::new() });
        effects
    }

    fn opened(&mut self, line: Line) -> Vec<Effect<M>> {
        let mut effects = match self.at(line) {
            Some(present) => {
                present.leaving = Leaving::Held(VecDeque::new());
                Vec::new()
            }
            None => self.begin(line, Leaving::Held(VecDeque::new())),
        };
        effects.push(Effect::Mark(line));
        // The other end's mark may have been faster than its word over the line.
        if self.at(line).is_some_and(|present| !present.out.is_empty()) {
            effects.push(Effect::Wake(line));
        }
        effects
    }

    fn marked(&mut self, line: Line) -> Vec<Effect<M>> {
        match self.at(line) {
            Some(present) if !present.arrives => {
                present.arrives = true;
                present.out.push_back(Out::Passed);
                vec![Effect::Wake(line)]
            }
            // Of a line that is no more: who sent it knows, or will be late.
            _ => Vec::new(),
        }
    }

    fn passed(&mut self, line: Line) -> Vec<Effect<M>> {
        let Some(present) = self.at(line) else { return Vec::new() };
        let Leaving::Held(held) = &mut present.leaving else { return Vec::new() };
        present.out.extend(held.drain(..).map(Out::Message));
        present.leaving = Leaving::Direct;
        vec![Effect::Wake(line)]
    }

    fn send(&mut self, message: M) -> Vec<Effect<M>> {
        match &mut self.present {
            None | Some(Present { leaving: Leaving::Relayed, .. }) => vec![Effect::Relay(message)],
            Some(Present { leaving: Leaving::Held(held), .. }) => {
                held.push_back(message);
                Vec::new()
            }
            Some(present) => {
                present.out.push_back(Out::Message(message));
                vec![Effect::Wake(present.line)]
            }
        }
    }

    /// Leaves the line, if it is the present one; what was not taken for it is relayed.
    fn end(&mut self, line: Line) -> Vec<Effect<M>> {
        let Some(present) = self.present.take_if(|present| present.line == line) else {
            return Vec::new();
        };
        let not_taken = present.out.into_iter().filter_map(|out| match out {
            Out::Message(message) => Some(message),
            Out::Passed => None,
        });
        let held = match present.leaving {
            Leaving::Held(held) => held,
            Leaving::Relayed | Leaving::Direct => VecDeque::new(),
        };
        let relayed = not_taken.chain(held).map(Effect::Relay);
        std::iter::once(Effect::Close(line)).chain(relayed).collect()
    }
}
