//! From a snapshot to a plan: first what must come home, then, if nothing must, what is better elsewhere.

use std::time::Duration;

use jiff::Timestamp;
use muster_api::kind::application::Policy;

use super::constraint::{Broken, check};
use super::problem::{Capacity, Edge, HOME, Item, Mapping, Problem};
use super::reason::{Elsewhere, Obstacle, Stand, Violation};
use super::solver::{Effort, Solution, solve};
use super::view::Snapshot;
use super::{Action, Fallback, Plan, Said, greedy, violation};
use crate::taskset::after;

/// A snapshot as a problem: which part is which item, and who may go where now.
#[derive(Debug)]
struct Case<'a> {
    snapshot: &'a Snapshot<'a>,
    now: Timestamp,
    /// The parts that may move: item → part.
    items: Vec<usize>,
    /// What is worth what, for parts as they are; no cost of moving in it.
    problem: Problem,
    /// Where the items are.
    current: Mapping,
}

/// A decision about the items.
struct Decision {
    target: Mapping,
    forced: Vec<(usize, Violation)>,
    bound: f64,
}

/// Decides what is to be done as of `now`.
#[must_use]
pub fn plan(snapshot: &Snapshot<'_>, now: Timestamp) -> Plan {
    let case = Case::of(snapshot, now);
    let found = violation::find(snapshot, now);
    let decision = match case.repair(&found) {
        Some(decision) => decision,
        None => case.improve(),
    };
    let (mapping, later) = case.first_moves(&decision);
    let look_again = [Some(after(now, snapshot.model.period)), found.look_again];
    Plan {
        actions: case.actions(&decision, &mapping),
        parts: case.say(&decision, (&mapping, &later)),
        value: case.problem.value(&mapping),
        home_value: case.problem.value(&case.problem.all_home()),
        bound: decision.bound,
        fallback: case.fallback(&mapping),
        look_again: look_again.into_iter().flatten().min().unwrap_or(now),
        mapping: case.whole(&mapping),
    }
}

impl<'a> Case<'a> {
    fn of(snapshot: &'a Snapshot<'a>, now: Timestamp) -> Self {
        let items: Vec<usize> = snapshot.model.migratable().collect();
        let current = items.iter().map(|part| snapshot.parts[*part].scale).collect();
        let problem = Problem {
            items: items.iter().map(|part| item(snapshot, *part)).collect(),
            scales: snapshot.scales.iter().map(|scale| capacity(snapshot, scale)).collect(),
            edges: edges(snapshot, &items),
        };
        Case { snapshot, now, items, problem, current }
    }

    /// Until when the item is not moved but for a violation.
    fn cools_until(&self, item: usize) -> Option<Timestamp> {
        let moved = self.snapshot.parts[self.items[item]].moved_at?;
        Some(after(moved, self.snapshot.model.cooldown)).filter(|until| *until > self.now)
    }

    /// It stays where it is, unless a violation brings it home.
    fn is_frozen(&self, item: usize) -> bool {
        self.cools_until(item).is_some() || self.snapshot.parts[self.items[item]].moving
    }

    /// What comes home for what is broken; none: nothing is.
    fn repair(&self, found: &violation::Found) -> Option<Decision> {
        let index = |part: usize| self.items.iter().position(|p| *p == part);
        let culprits = found.culprits.iter();
        let mut forced: Vec<(usize, Violation)> =
            culprits.filter_map(|(part, why)| Some((index(*part)?, why.clone()))).collect();
        let mut target = self.current.clone();
        forced.iter().for_each(|(item, _)| target[*item] = HOME);
        let mut problem = self.problem.clone();
        for (item, there) in problem.items.iter_mut().zip(&target) {
            item.allowed = (0..problem.scales.len()).map(|k| k == HOME || k == *there).collect();
        }
        let broken = check(&problem, &target);
        let first = broken.iter().find_map(|b| self.exceeded(b));
        if forced.is_empty() && first.is_none() {
            return None;
        }
        if let Some(why) = first {
            let kept = match self.snapshot.model.policy {
                Policy::Greedy => greedy::bring_home(&problem, &target, &self.by_move()),
                Policy::Optimal | Policy::Home => {
                    let best = solve(&problem, &target, Effort::ONLINE);
                    best.map_or_else(|| problem.all_home(), |best| best.mapping)
                }
            };
            for (item, scale) in kept.iter().enumerate() {
                if *scale != target[item] {
                    forced.push((item, why.clone()));
                }
            }
            target = kept;
        }
        let bound = self.problem.value(&target);
        Some(Decision { target, forced, bound })
    }

    /// Items that are away, the one that was moved last last.
    fn by_move(&self) -> Vec<usize> {
        let mut away: Vec<usize> =
            (0..self.items.len()).filter(|i| self.current[*i] != HOME).collect();
        away.sort_by_key(|item| self.snapshot.parts[self.items[*item]].moved_at);
        away
    }

    fn exceeded(&self, broken: &Broken) -> Option<Violation> {
        match *broken {
            Broken::Exceeded { scale, resource, need, have } => {
                let scale = self.snapshot.scales[scale].name.clone();
                Some(Violation::Exceeded { scale, resource, need, have })
            }
            Broken::NotAllowed { .. } => None,
        }
    }

    /// The best that the policy knows, when nothing is broken.
    fn improve(&self) -> Decision {
        let stay =
            |bound: f64| Decision { target: self.current.clone(), forced: Vec::new(), bound };
        let mut problem = self.problem.clone();
        let hysteresis = self.snapshot.model.objective.hysteresis;
        for (i, item) in problem.items.iter_mut().enumerate() {
            let here = self.current[i];
            if self.is_frozen(i) {
                item.allowed = (0..problem.scales.len()).map(|k| k == here).collect();
            }
            let cost = hysteresis * item.value[here].abs();
            for (k, value) in item.value.iter_mut().enumerate() {
                *value -= if k == here { 0.0 } else { cost };
            }
        }
        match self.snapshot.model.policy {
            Policy::Home => {
                let home: Mapping = (0..self.items.len())
                    .map(|i| if self.is_frozen(i) { self.current[i] } else { HOME })
                    .collect();
                let value = self.problem.value(&home);
                Decision { target: home, forced: Vec::new(), bound: value }
            }
            Policy::Greedy => {
                let free = |item: usize| !self.is_frozen(item);
                let mut decision = stay(f64::INFINITY);
                if let Some((item, scale)) = greedy::step(&self.problem, &self.current, free) {
                    decision.target[item] = scale;
                }
                decision
            }
            Policy::Optimal => match solve(&problem, &self.current, Effort::ONLINE) {
                Some(Solution { mapping, bound, value, .. }) => {
                    // In what the mapping is worth without the cost of moving.
                    let moved = self.problem.value(&mapping) - value;
                    Decision { target: mapping, forced: Vec::new(), bound: bound + moved }
                }
                None => stay(self.problem.value(&self.current)),
            },
        }
    }

    /// The moves that can be begun at once, most gain first: while a part is made in one place and not yet broken in the
    /// other, it is in both. The others follow at the next looks; they are the second.
    fn first_moves(&self, decision: &Decision) -> (Mapping, Vec<usize>) {
        let target = &decision.target;
        let home_first = |item: &usize| target[*item] != HOME;
        let gain = |item: usize| {
            let values = &self.problem.items[item].value;
            values[target[item]] - values[self.current[item]]
        };
        let mut order: Vec<usize> =
            (0..target.len()).filter(|i| target[*i] != self.current[*i]).collect();
        order.sort_by(|a, b| {
            home_first(a).cmp(&home_first(b)).then(gain(*b).total_cmp(&gain(*a))).then(a.cmp(b))
        });
        let mut load = self.problem.load(&self.current);
        let (mut mapping, mut later) = (self.current.clone(), Vec::new());
        for item in order {
            let (to, part) = (target[item], &self.problem.items[item]);
            let scale = &self.problem.scales[to];
            let room = to == HOME
                || (load.cpu[to] + part.cpu[to] <= scale.cpu
                    && load.memory[to] + part.memory <= scale.memory);
            if room {
                load.cpu[to] += part.cpu[to];
                load.memory[to] += part.memory;
                mapping[item] = to;
            } else {
                later.push(item);
            }
        }
        // What is left out must not be what made room on a link.
        if !later.is_empty() && !self.holds(&mapping) {
            let forced = |i: usize| decision.forced.iter().any(|(item, _)| *item == i);
            for (item, scale) in mapping.iter_mut().enumerate() {
                if *scale != self.current[item] && !forced(item) && *scale != HOME {
                    *scale = self.current[item];
                    later.push(item);
                }
            }
        }
        (mapping, later)
    }

    fn holds(&self, mapping: &[usize]) -> bool {
        check(&self.problem, mapping).iter().all(|b| self.exceeded(b).is_none())
    }

    fn actions(&self, decision: &Decision, mapping: &[usize]) -> Vec<Action> {
        let value = |item: usize, k: usize| self.problem.items[item].value[k];
        let mut moves: Vec<usize> = (0..mapping.len())
            .filter(|i| mapping[*i] != self.current[*i])
            .filter(|i| !self.snapshot.parts[self.items[*i]].moving || mapping[*i] == HOME)
            .collect();
        let gain = |item: usize| value(item, mapping[item]) - value(item, self.current[item]);
        let home = |item: usize| mapping[item] != HOME;
        moves.sort_by(|a, b| {
            home(*a).cmp(&home(*b)).then(gain(*b).total_cmp(&gain(*a))).then(a.cmp(b))
        });
        let why = |item: usize| decision.forced.iter().find(|(i, _)| *i == item);
        let action = |item: usize| Action {
            part: self.items[item],
            to: mapping[item],
            forced: why(item).map(|(_, why)| why.clone()),
        };
        moves.into_iter().map(action).collect()
    }

    /// Where every part of the application is.
    fn whole(&self, mapping: &[usize]) -> Vec<usize> {
        let mut whole = vec![HOME; self.snapshot.parts.len()];
        for (part, scale) in self.items.iter().zip(mapping) {
            whole[*part] = *scale;
        }
        whole
    }

    fn fallback(&self, mapping: &[usize]) -> Vec<Fallback> {
        let away = self.items.iter().zip(mapping).filter(|(_, scale)| **scale != HOME);
        away.filter_map(|(part, _)| {
            let after = self.snapshot.model.patience(*part)?;
            Some(Fallback { part: *part, after: after.max(Duration::from_millis(1)) })
        })
        .collect()
    }

    fn say(&self, decision: &Decision, (mapping, later): (&Mapping, &[usize])) -> Vec<Said> {
        let parts = self.snapshot.model.parts.iter().enumerate();
        let said = parts.map(|(part, model)| match self.items.iter().position(|p| *p == part) {
            None => Said { stand: Stand::Pinned(model.pins.clone()), elsewhere: Vec::new() },
            Some(item) => Said {
                stand: self.stand(decision, (mapping, later), item),
                elsewhere: self.elsewhere(mapping, item),
            },
        });
        said.collect()
    }

    fn stand(
        &self,
        decision: &Decision,
        (mapping, later): (&Mapping, &[usize]),
        item: usize,
    ) -> Stand {
        let values = &self.problem.items[item].value;
        let (here, there) = (self.current[item], mapping[item]);
        let name = |k: usize| self.snapshot.scales[k].name.clone();
        if let Some((_, why)) = decision.forced.iter().find(|(i, _)| *i == item) {
            return Stand::Returns(why.clone());
        }
        if self.snapshot.parts[self.items[item]].moving {
            return Stand::Moving;
        }
        if later.contains(&item) {
            return Stand::MovesLater { to: name(decision.target[item]) };
        }
        if there != here {
            return Stand::Moves { to: name(there), gain: values[there] - values[here] };
        }
        match self.cools_until(item) {
            Some(until) if here == HOME => Stand::CoolsDown { until },
            _ if here != HOME => Stand::Away { gain: values[here] - values[HOME] },
            _ if self.snapshot.model.policy == Policy::Home => Stand::Policy,
            _ => Stand::AtHome,
        }
    }

    /// For each scale but the one where the item will be: what it would gain there by itself, and what stands in the way.
    fn elsewhere(&self, mapping: &[usize], item: usize) -> Vec<Elsewhere> {
        let here = mapping[item];
        let value = self.problem.value(mapping);
        let mut all = Vec::new();
        for scale in (0..self.problem.scales.len()).filter(|k| *k != here) {
            let mut there = mapping.to_vec();
            there[item] = scale;
            let gain = self.problem.value(&there) - value;
            let obstacle = self.obstacle(&there, item, gain);
            all.push(Elsewhere { scale, gain, obstacle });
        }
        all
    }

    fn obstacle(&self, there: &[usize], item: usize, gain: f64) -> Obstacle {
        let scale = &self.snapshot.scales[there[item]];
        let away = there[item] != HOME;
        if let Some(why) = scale.unfit.clone().filter(|_| away) {
            return Obstacle::Unfit { why };
        }
        let bar = self.snapshot.bar(self.items[item], there[item]);
        if let Some(why) = bar.filter(|_| away) {
            return Obstacle::Unfit { why: why.to_owned() };
        }
        if away && !scale.link.up {
            return Obstacle::LinkDown { since: scale.link.since };
        }
        let exceeded = check(&self.problem, there).into_iter().find_map(|b| self.exceeded(&b));
        if let Some(Violation::Exceeded { scale, resource, need, have }) = exceeded {
            return Obstacle::Exceeded { scale, resource, need, have };
        }
        let hysteresis = self.snapshot.model.objective.hysteresis;
        let least = hysteresis * self.problem.items[item].value[self.current[item]].abs();
        if gain <= least {
            return Obstacle::TooLittle { least };
        }
        self.cools_until(item).map_or(Obstacle::Other, |until| Obstacle::CoolsDown { until })
    }
}

/// What a part is worth and needs on each scale.
fn item(snapshot: &Snapshot<'_>, part: usize) -> Item {
    let (model, objective) = (&snapshot.model.parts[part], &snapshot.model.objective);
    let cpu: Vec<f64> = (0..snapshot.scales.len()).map(|k| snapshot.cpu(part, k)).collect();
    let pinned = |other: usize| !snapshot.model.parts[other].may_move();
    let mut traffic = 0.0;
    let mut connections = 0.0;
    for c in &snapshot.model.connections {
        if (c.from == part && pinned(c.to)) || (c.to == part && pinned(c.from)) {
            traffic += c.bandwidth;
            connections += f64::from(u8::from(c.min_hz.is_some()));
        }
    }
    let value = |k: usize| {
        let scale = &snapshot.scales[k];
        let worth = objective.cpu * cpu[k] * scale.gain * model.gain;
        let accuracy = if k == HOME { model.home_accuracy } else { 1.0 };
        let network = if k == HOME {
            objective.energy * cpu[HOME]
        } else {
            let latency = scale.link.latency + snapshot.scales[HOME].link.latency;
            objective.latency * connections * latency + objective.energy * traffic / RADIO
        };
        model.share * (worth + objective.accuracy * accuracy - network)
    };
    let usable = |k: usize| {
        let scale = &snapshot.scales[k];
        let home = &snapshot.scales[HOME];
        k == HOME
            || k == snapshot.parts[part].scale
            || (scale.unfit.is_none()
                && snapshot.bar(part, k).is_none()
                && scale.link.up
                && home.link.up)
    };
    // Elsewhere its task reserves what its template says, however little it uses.
    let needs = |k: usize| if k == HOME { cpu[HOME] } else { cpu[k].max(model.quota) };
    Item {
        value: (0..cpu.len()).map(value).collect(),
        allowed: (0..cpu.len()).map(usable).collect(),
        memory: model.memory,
        traffic,
        cpu: (0..cpu.len()).map(needs).collect(),
    }
}

/// As much traffic of the radio counts as a core in `objective.energy`, bits a second.
const RADIO: f64 = 100e6;

fn capacity(snapshot: &Snapshot<'_>, scale: &super::view::ScaleView) -> Capacity {
    let objective = &snapshot.model.objective;
    let home = scale.name == snapshot.scales[HOME].name;
    Capacity {
        gain: scale.gain,
        cpu: scale.cpu,
        memory: scale.memory,
        // What is down carries nothing for a moment; whether that is tolerated is told by the frequencies.
        bandwidth: if scale.link.up { scale.link.bandwidth } else { f64::INFINITY },
        latency_cost: objective.latency * scale.link.latency,
        traffic_cost: if home { objective.energy / RADIO } else { 0.0 },
    }
}

fn edges(snapshot: &Snapshot<'_>, items: &[usize]) -> Vec<Edge> {
    let index = |part: usize| items.iter().position(|p| *p == part);
    let connections = snapshot.model.connections.iter();
    connections
        .filter_map(|c| Some(Edge { a: index(c.from)?, b: index(c.to)?, traffic: c.bandwidth }))
        .collect()
}
