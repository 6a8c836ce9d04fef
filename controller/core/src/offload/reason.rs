//! Typed reasons: why a part is where it is, what it would gain elsewhere, and what it would take.

use std::fmt;

use jiff::Timestamp;
use muster_api::kind::application::pin::Pin;
use muster_api::quantity::{BitRate, Bytes, MilliCpu};

use super::constraint::Resource;

/// A constraint that is broken, or will be before anything can be done about it.
#[derive(Debug, Clone, PartialEq)]
pub enum Violation {
    /// A connection is below its threshold for nearly as long as it tolerates (AnyScale III-B4, i).
    Frequency {
        /// The topic.
        topic: String,
        /// Since when.
        since: Timestamp,
        /// The link that is down; none: it is up and carries too little.
        link: Option<String>,
    },
    /// A declared signal is outside its limits for nearly as long as it may be.
    Signal {
        /// Which.
        name: String,
        /// What it should be.
        limits: String,
    },
    /// A scale has less than its parts need (ii, iii).
    Exceeded {
        /// The node.
        scale: String,
        /// Of what.
        resource: Resource,
        /// Needed: cores, bytes or bits a second.
        need: f64,
        /// There.
        have: f64,
    },
    /// Nothing can run on its scale any more.
    Unfit {
        /// The node.
        scale: String,
        /// Why.
        why: String,
    },
}

/// Why a part is where it is.
#[derive(Debug, Clone, PartialEq)]
pub enum Stand {
    /// It never leaves home.
    Pinned(Vec<Pin>),
    /// It is at home, and nowhere else is it worth more, or nowhere has room.
    AtHome,
    /// It is away, for this gain over home.
    Away {
        /// What the objective gains.
        gain: f64,
    },
    /// It is about to move.
    Moves {
        /// Where.
        to: String,
        /// What the objective gains.
        gain: f64,
    },
    /// It is to move when there is room for it beside those that are leaving.
    MovesLater {
        /// Where.
        to: String,
    },
    /// It comes home.
    Returns(Violation),
    /// It was moved a moment ago.
    CoolsDown {
        /// Until when it is not moved again.
        until: Timestamp,
    },
    /// It is on its way.
    Moving,
    /// The policy is Home.
    Policy,
}

/// What is between a part and a scale.
#[derive(Debug, Clone, PartialEq)]
pub enum Obstacle {
    /// Nothing can run there.
    Unfit {
        /// Why.
        why: String,
    },
    /// Its link is down.
    LinkDown {
        /// Since when.
        since: Timestamp,
    },
    /// There, with the other parts where they are, a scale would have too little.
    Exceeded {
        /// The node.
        scale: String,
        /// Of what.
        resource: Resource,
        /// Needed.
        need: f64,
        /// There.
        have: f64,
    },
    /// It would gain nothing, or less than is worth a move.
    TooLittle {
        /// What it would have to gain.
        least: f64,
    },
    /// It was moved a moment ago.
    CoolsDown {
        /// Until when.
        until: Timestamp,
    },
    /// Nothing but that another place is better.
    Other,
}

/// A scale where a part is not.
#[derive(Debug, Clone, PartialEq)]
pub struct Elsewhere {
    /// The scale.
    pub scale: usize,
    /// What the objective would gain.
    pub gain: f64,
    /// What stands in the way.
    pub obstacle: Obstacle,
}

impl Violation {
    /// One word, for programs.
    #[must_use]
    pub fn reason(&self) -> &'static str {
        match self {
            Violation::Frequency { .. } => "Frequency",
            Violation::Signal { .. } => "Signal",
            Violation::Exceeded { resource, .. } => exceeded(*resource),
            Violation::Unfit { .. } => "ScaleUnfit",
        }
    }
}

impl Stand {
    /// One word, for programs.
    #[must_use]
    pub fn reason(&self) -> &'static str {
        match self {
            Stand::Pinned(_) => "Critical",
            Stand::AtHome => "BestAtHome",
            Stand::Away { .. } => "WorthMore",
            Stand::Moves { .. } => "Moves",
            Stand::MovesLater { .. } => "MovesLater",
            Stand::Returns(violation) => violation.reason(),
            Stand::CoolsDown { .. } => "CoolsDown",
            Stand::Moving => "Moving",
            Stand::Policy => "PolicyHome",
        }
    }
}

impl Obstacle {
    /// One word, for programs.
    #[must_use]
    pub fn reason(&self) -> &'static str {
        match self {
            Obstacle::Unfit { .. } => "ScaleUnfit",
            Obstacle::LinkDown { .. } => "LinkDown",
            Obstacle::Exceeded { resource, .. } => exceeded(*resource),
            Obstacle::TooLittle { .. } => "GainTooSmall",
            Obstacle::CoolsDown { .. } => "CoolsDown",
            Obstacle::Other => "AnotherIsBetter",
        }
    }
}

fn exceeded(resource: Resource) -> &'static str {
    match resource {
        Resource::Cpu => "CpuExceeded",
        Resource::Memory => "MemoryExceeded",
        Resource::Bandwidth => "BandwidthExceeded",
    }
}

/// An amount of a resource with its unit.
#[must_use]
pub fn amount(resource: Resource, amount: f64) -> String {
    let whole = |amount: f64| amount.max(0.0).ceil() as u64;
    match resource {
        Resource::Cpu => format!("{} cpu", MilliCpu(whole((amount * 1000.0).round()))),
        Resource::Memory => format!("{} memory", Bytes(whole(amount))),
        Resource::Bandwidth => format!("{}bit/s", BitRate(whole(amount))),
    }
}

fn what(resource: Resource, scale: &str) -> String {
    match resource {
        Resource::Cpu | Resource::Memory => scale.to_owned(),
        Resource::Bandwidth => format!("the link of {scale}"),
    }
}

impl fmt::Display for Violation {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Violation::Frequency { topic, since, link: Some(link) } => {
                write!(f, "the link of {link} is down, {topic} misses its frequency since {since}")
            }
            Violation::Frequency { topic, since, link: None } => {
                write!(f, "{topic} is below its frequency since {since}")
            }
            Violation::Signal { name, limits } => {
                write!(f, "the signal {name} is not {limits}")
            }
            Violation::Exceeded { scale, resource, need, have } => write!(
                f,
                "{} has {} for it, and {} are needed",
                what(*resource, scale),
                amount(*resource, *have),
                amount(*resource, *need)
            ),
            Violation::Unfit { scale, why } => write!(f, "nothing can run on {scale}: {why}"),
        }
    }
}

impl fmt::Display for Stand {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Stand::Pinned(pins) => {
                let pins: Vec<String> = pins.iter().map(ToString::to_string).collect();
                write!(f, "stays at home: {}", pins.join("; "))
            }
            Stand::AtHome => f.write_str("is at home: nowhere else is it worth more and has room"),
            Stand::Away { gain } => write!(f, "is worth {gain:.3} more there than at home"),
            Stand::Moves { to, gain } => write!(f, "moves to {to}, for {gain:.3} more"),
            Stand::MovesLater { to } => {
                write!(f, "moves to {to} when those that are leaving have made room")
            }
            Stand::Returns(violation) => write!(f, "comes home: {violation}"),
            Stand::CoolsDown { until } => {
                write!(f, "was moved a moment ago, and is not moved again before {until}")
            }
            Stand::Moving => f.write_str("is being moved"),
            Stand::Policy => f.write_str("is at home: so says the policy Home"),
        }
    }
}

impl fmt::Display for Obstacle {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Obstacle::Unfit { why } => write!(f, "nothing can run there: {why}"),
            Obstacle::LinkDown { since } => write!(f, "its link is down since {since}"),
            Obstacle::Exceeded { scale, resource, need, have } => write!(
                f,
                "{} has {} for the application and {} would be needed: {} more would let it move",
                what(*resource, scale),
                amount(*resource, *have),
                amount(*resource, *need),
                amount(*resource, need - have)
            ),
            Obstacle::TooLittle { least } => {
                write!(f, "a move must gain {least:.3} at least (objective.hysteresis)")
            }
            Obstacle::CoolsDown { until } => write!(f, "cools down until {until}"),
            Obstacle::Other => f.write_str("nothing stands in the way; the whole is worth more so"),
        }
    }
}
