//! What is broken now, or will be before its parts could be home: AnyScale III-B4, and declared signals.
//!
//! A connection whose ends are apart may be below its threshold for Δ. A part that comes home takes `returnTime`; so it
//! must be on its way Δ − `returnTime` after the frequency fell.

use std::time::Duration;

use jiff::Timestamp;

use super::problem::HOME;
use super::reason::Violation;
use super::view::Snapshot;
use crate::taskset::after;

/// What must come home, and when there is more to look at.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Found {
    /// For each part that must come home, why.
    pub culprits: Vec<(usize, Violation)>,
    /// When the next thing that is wrong now becomes a violation.
    pub look_again: Option<Timestamp>,
}

impl Found {
    fn blame(&mut self, part: usize, violation: &Violation) {
        if self.culprits.iter().all(|(p, _)| *p != part) {
            self.culprits.push((part, violation.clone()));
        }
    }

    /// Whether something that began at `since` and is tolerated for `tolerance` must be acted on now.
    fn is_due(&mut self, since: Timestamp, tolerance: Duration, now: Timestamp) -> bool {
        let due = after(since, tolerance);
        if due > now {
            self.look_again = self.look_again.into_iter().chain([due]).min();
        }
        due <= now
    }
}

/// Looks at frequencies, signals and scales. Capacities are the solver's.
#[must_use]
pub fn find(snapshot: &Snapshot<'_>, now: Timestamp) -> Found {
    let mut found = Found::default();
    for (part, view) in snapshot.parts.iter().enumerate() {
        let scale = &snapshot.scales[view.scale];
        if let Some(why) = scale.unfit.as_ref().filter(|_| view.scale != HOME) {
            found.blame(part, &Violation::Unfit { scale: scale.name.clone(), why: why.clone() });
        }
    }
    for connection in 0..snapshot.model.connections.len() {
        frequency(snapshot, connection, now, &mut found);
    }
    let model = snapshot.model;
    for (signal, view) in model.signals.iter().zip(snapshot.signals) {
        let away = || signal.parts.iter().filter(|p| snapshot.parts[**p].scale != HOME);
        let Some(since) = view.outside_since.filter(|_| away().next().is_some()) else { continue };
        if found.is_due(since, signal.tolerance.saturating_sub(model.return_time), now) {
            let (name, limits) = (signal.name.clone(), signal.limits.clone());
            let violation = Violation::Signal { name, limits };
            away().for_each(|part| found.blame(*part, &violation));
        }
    }
    found
}

fn frequency(snapshot: &Snapshot<'_>, connection: usize, now: Timestamp, found: &mut Found) {
    let model = snapshot.model;
    let c = &model.connections[connection];
    if c.min_hz.is_none() || !snapshot.is_apart(connection) {
        return;
    }
    let ends = [c.from, c.to];
    let scale = |part: usize| &snapshot.scales[snapshot.parts[part].scale];
    // The link that is down for longest; a part at its other end is no cause.
    let down = ends.into_iter().filter(|part| !scale(*part).link.up);
    let down = down.min_by_key(|part| scale(*part).link.since);
    let since = down.map(|part| scale(part).link.since);
    let below = snapshot.connections[connection].below_since;
    let Some(since) = since.into_iter().chain(below).min() else { return };
    if !found.is_due(since, c.tolerance.saturating_sub(model.return_time), now) {
        return;
    }
    let link = down.map(|part| scale(part).name.clone());
    let violation = Violation::Frequency { topic: c.topic.clone(), since, link };
    for part in ends {
        let away = snapshot.parts[part].scale != HOME;
        // When one link is known to be down, the part behind it is the cause; behind home's, every part that is away.
        let cause = down.is_none_or(|d| snapshot.parts[d].scale == HOME || !scale(part).link.up);
        if away && cause {
            found.blame(part, &violation);
        }
    }
}
