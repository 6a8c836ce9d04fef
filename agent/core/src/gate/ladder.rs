//! What follows when whoever drives is silent: a ladder of steps, each after a time.

use serde::{Deserialize, Serialize};

use crate::time::Boot;

/// What a step does.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub enum Action {
    /// It is told to the agent, which writes it down.
    Log,
    /// The driver gets its hold command: stay as you are.
    Hold,
    /// The driver gets its stop command.
    Stop,
    /// The holder's right is given back: the agent ends its task.
    Release,
}

/// One step.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "camelCase")]
pub struct Step {
    /// After this long, milliseconds: without a command; for [`Action::Release`] without any sign of life.
    pub after_ms: u64,
    /// What then.
    pub action: Action,
}

/// Stop 200 ms after the last command: five commands a second keep a robot in motion, and a holder whose link is cut is noticed
/// within a quarter of a second. Base drivers wait 250 ms to 3 s by themselves, and some for ever.
pub const DEFAULT: &[Step] = &[Step { after_ms: 200, action: Action::Stop }];

/// The steps for a silent driver, and how far down it is. [`Action::Release`] is none of them: it is about the holder's life,
/// not about its commands.
#[derive(Debug, Clone)]
pub(super) struct Ladder {
    steps: Vec<Step>,
    taken: usize,
}

impl Ladder {
    /// Steps in the order of their times.
    #[must_use]
    pub(super) fn new(mut steps: Vec<Step>) -> Ladder {
        steps.retain(|step| step.action != Action::Release);
        steps.sort_by_key(|step| step.after_ms);
        Ladder { steps, taken: usize::MAX }
    }

    /// A command was accepted: the ladder begins anew.
    pub(super) fn commanded(&mut self) {
        self.taken = 0;
    }

    /// Nobody drives.
    pub(super) fn rest(&mut self) {
        self.taken = usize::MAX;
    }

    /// The steps that are due. `commanded`: when the last command came.
    pub(super) fn due(&mut self, commanded: Boot, now: Boot) -> Vec<Action> {
        let mut due = Vec::new();
        while let Some(step) = self.steps.get(self.taken) {
            if commanded.plus(step.after_ms) > now {
                break;
            }
            due.push(step.action);
            self.taken += 1;
        }
        due
    }

    /// When the next step is due.
    #[must_use]
    pub(super) fn next(&self, commanded: Boot) -> Option<Boot> {
        self.steps.get(self.taken).map(|step| commanded.plus(step.after_ms))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_step_once() {
        let step = |after_ms, action| Step { after_ms, action };
        let mut ladder = Ladder::new(vec![
            step(500, Action::Release),
            step(200, Action::Stop),
            step(100, Action::Log),
        ]);
        let at = Boot(1_000);
        assert!(ladder.due(at, Boot(9_000)).is_empty(), "nobody has driven");
        ladder.commanded();
        assert_eq!(ladder.next(at), Some(Boot(1_100)));
        assert!(ladder.due(at, Boot(1_099)).is_empty());
        assert_eq!(ladder.due(at, Boot(1_250)), [Action::Log, Action::Stop]);
        assert_eq!(ladder.next(at), None);
    }
}
