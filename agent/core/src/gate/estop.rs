//! The emergency stop: how far each source says that the robot must be stopped, and until when.
//!
//! It is apart from leases: whoever holds the robot, it stands. What a source on the robot demanded stays demanded until a
//! person releases it, also when the source is quiet again or the machine was started again. A release names the newest
//! stop that the person knew of: it never releases one that came after.

use std::fmt;

use muster_api::kind::node::estop::EStopTier as Tier;
use serde::{Deserialize, Serialize};

/// Who demands a stop.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
pub enum Source {
    /// A person, by way of the controller. It keeps what was demanded there, so nothing of it is latched here.
    Controller,
    /// A file or a pin on the robot, by its name in the settings.
    Local(String),
}

impl fmt::Display for Source {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Source::Controller => f.write_str("the controller"),
            Source::Local(name) => write!(f, "{name} on the robot"),
        }
    }
}

/// What one source demands.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
struct Demand {
    source: Source,
    /// The most restrictive that it has demanded since the last release.
    latched: Tier,
    /// What it demands now.
    now: Tier,
    /// The number of the stop that latched it.
    number: u64,
}

/// Everything that is demanded.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct EStop {
    demands: Vec<Demand>,
    /// How many stops there were.
    number: u64,
    /// The newest release: one that is said again releases nothing.
    #[serde(default)]
    released: u64,
}

impl EStop {
    /// The most restrictive of all.
    #[must_use]
    pub fn tier(&self) -> Tier {
        self.demands.iter().map(|demand| demand.latched).max().unwrap_or_default()
    }

    /// The number of the newest stop; what a release must name to release everything.
    #[must_use]
    pub fn number(&self) -> u64 {
        self.number
    }

    /// The sources that keep the robot stopped, and how far.
    pub fn demands(&self) -> impl Iterator<Item = (&Source, Tier)> {
        let set = self.demands.iter().filter(|demand| demand.latched > Tier::None);
        set.map(|demand| (&demand.source, demand.latched))
    }

    /// A source says how far the robot must be stopped now. Less than before releases nothing, but for the controller's.
    pub fn demand(&mut self, source: &Source, tier: Tier) {
        let known = self.demands.iter().position(|demand| demand.source == *source);
        let at = known.unwrap_or_else(|| {
            let (latched, now) = (Tier::None, Tier::None);
            self.demands.push(Demand { source: source.clone(), latched, now, number: 0 });
            self.demands.len() - 1
        });
        let demand = &mut self.demands[at];
        // Pressed again counts as a stop of its own: whoever released the one before did not see it.
        if tier > demand.now || tier > demand.latched {
            self.number += 1;
            demand.number = self.number;
        }
        demand.now = tier;
        demand.latched = match source {
            // Only its end lets go: a second person who stops the robot less far does not switch its power on.
            Source::Controller if tier == Tier::None => Tier::None,
            Source::Controller => demand.latched.max(tier),
            Source::Local(_) => demand.latched.max(tier),
        };
        self.forget();
    }

    /// A person releases the stops up to this number, once: their sources fall back to what they demand now. A button that is
    /// still pressed keeps the robot where it is, and counts as a stop that comes after: it needs a release of its own.
    pub fn release(&mut self, number: u64) {
        if number <= self.released {
            return;
        }
        self.released = number;
        if number > self.number {
            // Of another life of this robot's records: it has seen none of these.
            self.number = number;
            return;
        }
        for demand in self.demands.iter_mut().filter(|demand| demand.number <= number) {
            demand.latched = demand.now;
            if demand.now > Tier::None {
                self.number += 1;
                demand.number = self.number;
            }
        }
        self.forget();
    }

    fn forget(&mut self) {
        self.demands.retain(|demand| demand.latched > Tier::None);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_most_restrictive_wins_and_stays_until_released() {
        let (button, controller) = (Source::Local("button".to_owned()), Source::Controller);
        let mut stop = EStop::default();
        assert_eq!(stop.tier(), Tier::None);
        stop.demand(&controller, Tier::Settle);
        stop.demand(&button, Tier::Cut);
        assert_eq!(stop.tier(), Tier::Cut);
        stop.demand(&button, Tier::None);
        stop.demand(&controller, Tier::None);
        assert_eq!(stop.tier(), Tier::Cut, "nobody has released the button's");
        stop.demand(&controller, Tier::Settle);
        stop.release(stop.number());
        assert_eq!(stop.tier(), Tier::Settle, "the controller still demands it");
        stop.demand(&controller, Tier::None);
        assert_eq!((stop.tier(), stop.demands().count()), (Tier::None, 0));
    }

    #[test]
    fn a_button_that_is_still_pressed_is_not_released() {
        let button = Source::Local("button".to_owned());
        let mut stop = EStop::default();
        stop.demand(&button, Tier::Cut);
        stop.release(stop.number());
        assert_eq!(stop.tier(), Tier::Cut);
        stop.demand(&button, Tier::None);
        stop.release(stop.number());
        assert_eq!(stop.tier(), Tier::None);
    }

    #[test]
    fn a_release_counts_once_and_not_for_a_button_that_was_pressed_all_the_time() {
        let button = Source::Local("button".to_owned());
        let mut stop = EStop::default();
        stop.demand(&button, Tier::Cut);
        let seen = stop.number();
        stop.release(seen);
        stop.demand(&button, Tier::None);
        stop.release(seen);
        assert_eq!(stop.tier(), Tier::Cut, "the same release, said again");
        stop.release(stop.number());
        assert_eq!(stop.tier(), Tier::None);
        // A record that was lost begins with smaller numbers than the release that is still written down.
        let mut stop = EStop::default();
        stop.release(40);
        stop.demand(&button, Tier::Settle);
        stop.demand(&button, Tier::None);
        stop.release(40);
        assert_eq!((stop.tier(), stop.number()), (Tier::Settle, 41));
    }

    #[test]
    fn who_stops_less_far_switches_nothing_on() {
        let mut stop = EStop::default();
        stop.demand(&Source::Controller, Tier::Cut);
        stop.demand(&Source::Controller, Tier::Settle);
        assert_eq!(stop.tier(), Tier::Cut);
        stop.demand(&Source::Controller, Tier::None);
        assert_eq!(stop.tier(), Tier::None);
    }

    #[test]
    fn a_release_that_comes_late_does_not_release_a_newer_stop() {
        let button = Source::Local("button".to_owned());
        let mut stop = EStop::default();
        stop.demand(&button, Tier::Settle);
        stop.demand(&button, Tier::None);
        let seen = stop.number();
        stop.demand(&button, Tier::Settle);
        stop.demand(&button, Tier::None);
        stop.release(seen);
        assert_eq!(stop.tier(), Tier::Settle);
        stop.release(stop.number());
        assert_eq!(stop.tier(), Tier::None);
    }

    #[test]
    fn it_is_the_same_after_it_was_written_down() {
        let mut stop = EStop::default();
        stop.demand(&Source::Local("a/b".to_owned()), Tier::Cut);
        stop.demand(&Source::Controller, Tier::Settle);
        let text = serde_json::to_string(&stop).unwrap();
        assert_eq!(serde_json::from_str::<EStop>(&text).unwrap(), stop);
    }
}
