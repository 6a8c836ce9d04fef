//! What is measured of an application, as a decision wants it: frequencies of connections and values of signals, and since
//! when they are not as they should be.
//!
//! A frequency is told by the task that subscribes. A connection whose ends are apart, and one of which does not serve, has
//! none, whoever tells what.

use muster_api::kind::application::{
    Connection, ConnectionStatus, PartStatus, Runs, Signal, SignalStatus, stamp,
};

use super::{Gathered, Look};
use crate::offload::problem::HOME;
use crate::offload::view::{ConnectionView, SignalView};
use crate::taskset::after;

/// Frequencies and values that differ by less than this share are the same: a status is not written for noise.
const STEP: f64 = 0.1;

/// What is observed.
#[derive(Debug)]
pub(super) struct Observed {
    pub(super) views: Vec<ConnectionView>,
    pub(super) signal_views: Vec<SignalView>,
    /// For the status.
    pub(super) connections: Vec<ConnectionStatus>,
    /// For the status.
    pub(super) signals: Vec<SignalStatus>,
}

impl Observed {
    pub(super) fn of(look: &Look<'_>, out: &mut Gathered) -> Self {
        let (spec, model) = (look.snapshot.spec, &look.model);
        let connections: Vec<ConnectionStatus> =
            spec.connections.iter().map(|c| connection(look, c)).collect();
        let signals: Vec<SignalStatus> = spec.signals.iter().map(|s| signal(look, s)).collect();
        for (connection, status) in model.connections.iter().zip(&connections) {
            let due = status
                .below_since
                .as_ref()
                .map(|at| after(at.0, connection.tolerance.saturating_sub(model.return_time)));
            if let Some(due) = due.filter(|due| *due > look.now) {
                out.look_at(due);
            }
        }
        let below = |c: &ConnectionStatus| ConnectionView {
            below_since: c.below_since.as_ref().map(|at| at.0),
        };
        let outside = |s: &SignalStatus| SignalView {
            outside_since: s.outside_since.as_ref().map(|at| at.0),
        };
        Observed {
            views: connections.iter().map(below).collect(),
            signal_views: signals.iter().map(outside).collect(),
            connections: connections
                .into_iter()
                .filter(|c| c.hz.is_some() || c.below_since.is_some())
                .collect(),
            signals: signals.into_iter().filter(|s| s.value.is_some()).collect(),
        }
    }
}

fn part<'l>(look: &'l Look<'_>, name: &str) -> Option<&'l PartStatus> {
    look.snapshot.status.part(name)
}

/// What the task that serves a part tells under a name.
fn told(look: &Look<'_>, of: &str, name: &str) -> Option<f64> {
    let task = look.task(&part(look, of)?.task.as_ref()?.name)?;
    task.tells.iter().find(|(told, _)| told == name).map(|(_, value)| *value)
}

fn connection(look: &Look<'_>, c: &Connection) -> ConnectionStatus {
    let before = look.snapshot.status.connections.iter();
    let same = |s: &&ConnectionStatus| (&s.topic, &s.from, &s.to) == (&c.topic, &c.from, &c.to);
    let before = before.clone().find(same);
    let hz = told(look, &c.to, &c.topic);
    let ends = [&c.from, &c.to].map(|name| part(look, name));
    let scale = |end: Option<&PartStatus>| end.and_then(|p| p.scale.clone());
    let apart = scale(ends[0]) != scale(ends[1]);
    // One that runs sometimes may be idle.
    let always = |name: &str| look.snapshot.spec.part(name).is_some_and(|p| p.runs == Runs::Always);
    let down = |(end, name): (Option<&PartStatus>, &String)| {
        always(name) && end.is_some_and(|part| !part.ready && heard(look, part))
    };
    let broken = apart && ends.into_iter().zip([&c.from, &c.to]).any(down);
    let slow = c.min_hz.is_some_and(|min| hz.is_some_and(|hz| hz < min));
    let since = before.and_then(|b| b.below_since.as_ref());
    ConnectionStatus {
        topic: c.topic.clone(),
        from: c.from.clone(),
        to: c.to.clone(),
        hz: settled(before.and_then(|b| b.hz), hz),
        // At home it is slow for another reason than where its ends are; to count that would fetch home at once what was moved
        // out because of it.
        below_since: begun(
            c.min_hz.is_some() && ((apart && slow) || broken),
            since,
            stamp(look.now),
        ),
    }
}

/// The node of a part's task is heard; one that is not is judged by its link.
fn heard(look: &Look<'_>, part: &PartStatus) -> bool {
    let scale = part.scale.as_ref().and_then(|name| look.scales.index(name));
    scale.is_some_and(|scale| look.scales.views[scale].link.up)
}

fn signal(look: &Look<'_>, signal: &Signal) -> SignalStatus {
    let before = look.snapshot.status.signals.iter().find(|s| s.name == signal.name);
    let parts = look.snapshot.spec.parts.iter();
    let value = parts.filter_map(|part| told(look, &part.name, &signal.name)).next();
    let outside = |value: f64| {
        signal.max.is_some_and(|max| value > max) || signal.min.is_some_and(|min| value < min)
    };
    let since = before.and_then(|b| b.outside_since.as_ref());
    // As with connections: at home nothing can be fetched home.
    let home = &look.scales.views[HOME].name;
    let mut scales = look.snapshot.status.parts.iter().filter_map(|part| part.scale.as_ref());
    let is_away = scales.any(|scale| scale != home);
    SignalStatus {
        name: signal.name.clone(),
        value: settled(before.and_then(|b| b.value), value),
        outside_since: begun(is_away && value.is_some_and(outside), since, stamp(look.now)),
    }
}

/// What was written, while what is told is hardly another.
fn settled(before: Option<f64>, told: Option<f64>) -> Option<f64> {
    let near = |a: f64, b: f64| (a - b).abs() <= STEP * a.abs();
    before.filter(|before| told.is_some_and(|told| near(*before, told))).or(told)
}

/// Since when something is so, if it is.
fn begun<T: Clone>(so: bool, since: Option<&T>, now: T) -> Option<T> {
    so.then(|| since.cloned().unwrap_or(now))
}
