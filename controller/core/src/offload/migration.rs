//! One part on its way: made before it is broken, and what its robot does alone.
//!
//! ```text
//!   Settled ─Go─▶ Making ─Ready─▶ Switching ─Switched─▶ Breaking ─Gone─▶ Settled
//!                   │                 │
//!                 Abort, Failed     Abort, Failed          CutOff (link dead for the time authorised, robot alone)
//!                   ▼                 ▼                      from any stage that needs the other side
//!                Aborting ─Gone─▶ Settled                  ──▶ Alone ─Gone─▶ Settled
//! ```
//!
//! An attempt is a Task of its own uid. Two of a part live only between a start and the end of the other: while it is made,
//! switched, broken or aborted. The connections are with exactly one of them at any time. What is cut off is not one of
//! them: it ends itself, without contact, before its robot may start the standby (`onDisconnect: Stop`).

/// A live Task of the part.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Attempt {
    /// Its identity.
    pub uid: u64,
    /// The scale where it is.
    pub scale: usize,
}

/// Where a migration stands. The one that serves has the connections.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Stage {
    /// It serves, and nothing is going on.
    Settled {
        /// The only one.
        serves: Attempt,
    },
    /// The next one is starting.
    Making {
        /// The one before.
        serves: Attempt,
        /// Not Ready yet.
        next: Attempt,
    },
    /// The next one is Ready; the connections are being switched to it.
    Switching {
        /// The one before; the connections are still with it.
        serves: Attempt,
        /// Ready.
        next: Attempt,
    },
    /// The connections are with the new one; the old one is ending.
    Breaking {
        /// The new one.
        serves: Attempt,
        /// Told to end.
        old: Attempt,
    },
    /// The next one is given up, and is ending.
    Aborting {
        /// The one before, which goes on.
        serves: Attempt,
        /// Told to end.
        next: Attempt,
    },
    /// The robot has started the standby by itself. The other one cannot be reached; it has ended, or has contact again and
    /// is told to.
    Alone {
        /// At home.
        serves: Attempt,
        /// Not known to be gone.
        lost: Attempt,
        /// Nor this one, if it was on its way from one scale to another.
        also: Option<Attempt>,
    },
}

/// What happened.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Event {
    /// It is to move.
    Go(Attempt),
    /// An attempt is Ready.
    Ready(u64),
    /// The connections are with this attempt.
    Switched(u64),
    /// An attempt has ended; nothing of it runs.
    Gone(u64),
    /// What served has ended, and nothing follows it: it is begun again.
    Lost {
        /// In its place.
        again: Attempt,
    },
    /// The move is not wanted any more.
    Abort,
    /// What is away cannot be reached for the time after which the robot may act alone, or is known to have ended; with the
    /// standby that the robot was given.
    CutOff {
        /// The standby, at home.
        standby: Attempt,
    },
    /// There is contact again with what was cut off.
    Contact,
}

/// What is to be done.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Act {
    /// Start an attempt.
    Start(Attempt),
    /// Switch the connections to it.
    Connect(Attempt),
    /// End an attempt, with its grace.
    Stop(Attempt),
}

/// The answer to an event.
#[must_use]
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Step {
    /// Where the migration stands now.
    pub stage: Stage,
    /// In this order.
    pub acts: Vec<Act>,
}

impl Stage {
    /// The attempt that has the connections.
    #[must_use]
    pub fn serves(self) -> Attempt {
        match self {
            Stage::Settled { serves }
            | Stage::Making { serves, .. }
            | Stage::Switching { serves, .. }
            | Stage::Breaking { serves, .. }
            | Stage::Aborting { serves, .. }
            | Stage::Alone { serves, .. } => serves,
        }
    }

    /// The other attempt that may live.
    #[must_use]
    pub fn other(self) -> Option<Attempt> {
        match self {
            Stage::Settled { .. } => None,
            Stage::Making { next: other, .. }
            | Stage::Switching { next: other, .. }
            | Stage::Breaking { old: other, .. }
            | Stage::Aborting { next: other, .. }
            | Stage::Alone { lost: other, .. } => Some(other),
        }
    }

    /// The window in which two attempts may live, one made before the other is broken; also while one that was on its way
    /// to another scale is ending.
    #[must_use]
    pub fn is_window(self) -> bool {
        !matches!(self, Stage::Settled { .. } | Stage::Alone { also: None, .. })
    }

    /// What follows an event. One that means nothing here changes nothing: messages come late and twice.
    pub fn on(self, event: Event) -> Step {
        let stay = || Step { stage: self, acts: Vec::new() };
        let go = |stage, act| Step { stage, acts: vec![act] };
        let settle = |serves| Step { stage: Stage::Settled { serves }, acts: Vec::new() };
        match (self, event) {
            (Stage::Settled { serves }, Event::Go(next)) if next.scale != serves.scale => {
                go(Stage::Making { serves, next }, Act::Start(next))
            }
            (Stage::Making { serves, next }, Event::Ready(uid)) if uid == next.uid => {
                go(Stage::Switching { serves, next }, Act::Connect(next))
            }
            (Stage::Switching { serves, next }, Event::Switched(uid)) if uid == next.uid => {
                go(Stage::Breaking { serves: next, old: serves }, Act::Stop(serves))
            }
            (Stage::Making { serves, next }, Event::Abort) => {
                go(Stage::Aborting { serves, next }, Act::Stop(next))
            }
            // Some connections may be with the next one already.
            (Stage::Switching { serves, next }, Event::Abort) => Step {
                stage: Stage::Aborting { serves, next },
                acts: vec![Act::Connect(serves), Act::Stop(next)],
            },
            (_, Event::Lost { again }) => self.again(again).unwrap_or_else(stay),
            (_, Event::Gone(uid)) => self.gone(uid).unwrap_or_else(stay),
            (_, Event::CutOff { standby }) => self.cut_off(standby).unwrap_or_else(stay),
            (Stage::Alone { lost, also, .. }, Event::Contact) => Step {
                stage: self,
                acts: [Some(lost), also].into_iter().flatten().map(Act::Stop).collect(),
            },
            (Stage::Settled { serves }, Event::Abort) => settle(serves),
            _ => stay(),
        }
    }

    fn gone(self, uid: u64) -> Option<Step> {
        let settle = |serves| Some(Step { stage: Stage::Settled { serves }, acts: Vec::new() });
        match self {
            Stage::Alone { serves, lost, also: Some(also) } if lost.uid == uid => {
                Some(Step { stage: Stage::Breaking { serves, old: also }, acts: Vec::new() })
            }
            Stage::Alone { serves, lost, also: Some(also) } if also.uid == uid => {
                Some(Step { stage: Stage::Alone { serves, lost, also: None }, acts: Vec::new() })
            }
            Stage::Breaking { serves, old: other }
            | Stage::Aborting { serves, next: other }
            | Stage::Alone { serves, lost: other, also: None }
            | Stage::Making { serves, next: other }
                if other.uid == uid =>
            {
                settle(serves)
            }
            Stage::Switching { serves, next } if next.uid == uid => {
                Some(Step { stage: Stage::Settled { serves }, acts: vec![Act::Connect(serves)] })
            }
            // The one before ended while the next one starts: the next one is all there is.
            Stage::Making { serves, next } | Stage::Switching { serves, next }
                if serves.uid == uid =>
            {
                Some(Step {
                    stage: Stage::Settled { serves: next },
                    acts: vec![Act::Connect(next)],
                })
            }
            _ => None,
        }
    }

    /// Another one in the place of the one that served. While the next one is starting, that follows.
    fn again(self, again: Attempt) -> Option<Step> {
        let stage = match self {
            Stage::Settled { .. } => Stage::Settled { serves: again },
            Stage::Breaking { old, .. } => Stage::Breaking { serves: again, old },
            Stage::Aborting { next, .. } => Stage::Aborting { serves: again, next },
            Stage::Alone { lost, also, .. } => Stage::Alone { serves: again, lost, also },
            Stage::Making { .. } | Stage::Switching { .. } => return None,
        };
        Some(Step { stage, acts: vec![Act::Start(again), Act::Connect(again)] })
    }

    /// The robot alone: what is at home serves, or the standby is started.
    fn cut_off(self, standby: Attempt) -> Option<Step> {
        let home = standby.scale;
        let alone = |serves, lost, also, acts| {
            Some(Step { stage: Stage::Alone { serves, lost, also }, acts })
        };
        let mut start = vec![Act::Start(standby), Act::Connect(standby)];
        match self {
            Stage::Settled { serves } if serves.scale != home => {
                alone(standby, serves, None, start)
            }
            // On its way home: the one at home serves as soon as it can.
            Stage::Making { serves, next } | Stage::Switching { serves, next }
                if next.scale == home =>
            {
                alone(next, serves, None, vec![Act::Connect(next)])
            }
            // On its way out: the one at home goes on.
            Stage::Making { serves, next } | Stage::Switching { serves, next }
                if serves.scale == home =>
            {
                Some(Step {
                    stage: Stage::Aborting { serves, next },
                    acts: vec![Act::Connect(serves), Act::Stop(next)],
                })
            }
            // From one scale to another, and neither is sure.
            Stage::Making { serves, next } | Stage::Switching { serves, next } => {
                start.insert(0, Act::Stop(next));
                alone(standby, serves, Some(next), start)
            }
            Stage::Breaking { serves, old: other } | Stage::Aborting { serves, next: other }
                if other.scale != home && serves.scale != home =>
            {
                alone(standby, serves, Some(other), start)
            }
            // Home serves already, and the other one was told to end. Or what was at home, or should have come, is ending
            // there: the robot waits for its end, which it sees itself, and asks again; a standby beside it would be one
            // too many.
            _ => None,
        }
    }
}
