//! The offline half (AnyScale III-B): what follows from the spec alone, worked out once for each generation of it.

use std::collections::BTreeMap;
use std::time::Duration;

use muster_api::kind::application::pin::{Pin, pins};
use muster_api::kind::application::{
    ApplicationSpec, Connection, Objective, Part, Policy, Runs, Signal,
};

/// An application as decisions want it.
#[derive(Debug, Clone, PartialEq)]
pub struct Model {
    /// Parts in the order of the spec.
    pub parts: Vec<PartModel>,
    /// Connections whose ends are both parts.
    pub connections: Vec<ConnectionModel>,
    /// Declared limits.
    pub signals: Vec<SignalModel>,
    /// What is maximised.
    pub objective: Objective,
    /// Who decides.
    pub policy: Policy,
    /// Between two looks for something better.
    pub period: Duration,
    /// The paper's T.
    pub cooldown: Duration,
    /// How long a part takes to serve at home again.
    pub return_time: Duration,
}

/// A part.
#[derive(Debug, Clone, PartialEq)]
pub struct PartModel {
    /// Its name.
    pub name: String,
    /// Why it stays at home; none: it may move.
    pub pins: Vec<Pin>,
    /// When it runs.
    pub runs: Runs,
    /// The share of the time that it runs.
    pub share: f64,
    /// What its cpu counts.
    pub gain: f64,
    /// How good its results are at home.
    pub home_accuracy: f64,
    /// Declared mean use at home, cores.
    pub cpu: Option<f64>,
    /// Declared mean use elsewhere, cores by node.
    pub cpu_on: BTreeMap<String, f64>,
    /// What its task reserves, cores; the use until one is known.
    pub quota: f64,
    /// What its task reserves, bytes.
    pub memory: f64,
}

/// A connection.
#[derive(Debug, Clone, PartialEq)]
pub struct ConnectionModel {
    /// The topic.
    pub topic: String,
    /// The part that publishes.
    pub from: usize,
    /// The part that subscribes.
    pub to: usize,
    /// The threshold, Hz; none: it is not watched.
    pub min_hz: Option<f64>,
    /// The paper's Δ.
    pub tolerance: Duration,
    /// Bits a second.
    pub bandwidth: f64,
}

/// A declared limit.
#[derive(Debug, Clone, PartialEq)]
pub struct SignalModel {
    /// Its name.
    pub name: String,
    /// Its limits and unit, for people: `at most 4 deg/s`.
    pub limits: String,
    /// How long it may be outside.
    pub tolerance: Duration,
    /// The parts that come home for it.
    pub parts: Vec<usize>,
}

impl Model {
    /// What follows from a spec that was admitted.
    #[must_use]
    pub fn of(spec: &ApplicationSpec) -> Self {
        let index = |name: &str| spec.parts.iter().position(|p| p.name == name);
        let parts: Vec<PartModel> = spec.parts.iter().map(|part| of_part(spec, part)).collect();
        let connection = |c: &Connection| {
            Some(ConnectionModel {
                topic: c.topic.clone(),
                from: index(&c.from)?,
                to: index(&c.to)?,
                min_hz: c.min_hz,
                tolerance: c.tolerance.as_duration(),
                bandwidth: c.bandwidth.0 as f64,
            })
        };
        let signal = |s: &Signal| SignalModel {
            name: s.name.clone(),
            limits: limits(s),
            tolerance: s.tolerance.as_duration(),
            parts: match s.parts.is_empty() {
                true => (0..parts.len()).filter(|i| parts[*i].may_move()).collect(),
                false => s.parts.iter().filter_map(|name| index(name)).collect(),
            },
        };
        Model {
            connections: spec.connections.iter().filter_map(connection).collect(),
            signals: spec.signals.iter().map(signal).collect(),
            objective: spec.objective.clone(),
            policy: spec.policy,
            period: spec.period.as_duration(),
            cooldown: spec.cooldown.as_duration(),
            return_time: spec.return_time.as_duration(),
            parts,
        }
    }

    /// The parts that may move.
    pub fn migratable(&self) -> impl Iterator<Item = usize> + '_ {
        (0..self.parts.len()).filter(|i| self.parts[*i].may_move())
    }

    /// Cores and bytes that home holds for all parts, so that everything can come home at once.
    #[must_use]
    pub fn home_need(&self) -> (f64, f64) {
        let cpu = self.parts.iter().map(PartModel::home_cpu).sum();
        (cpu, self.parts.iter().map(|p| p.memory).sum())
    }

    /// Mappings there would be on as many scales if every part could go everywhere, and those that are left when pinned
    /// parts stay.
    #[must_use]
    pub fn mappings(&self, scales: usize) -> (f64, f64) {
        let all = |parts: usize| (scales as f64).powi(i32::try_from(parts).unwrap_or(i32::MAX));
        (all(self.parts.len()), all(self.migratable().count()))
    }

    /// For how long a part that is away may be without its link before it must be on its way home; none: nothing of it is
    /// watched.
    #[must_use]
    pub fn patience(&self, part: usize) -> Option<Duration> {
        let of = self.connections.iter().filter(|c| c.from == part || c.to == part);
        let watched = of.filter(|c| c.min_hz.is_some());
        watched.map(|c| c.tolerance.saturating_sub(self.return_time)).min()
    }
}

impl PartModel {
    /// It may run on other scales.
    #[must_use]
    pub fn may_move(&self) -> bool {
        self.pins.is_empty()
    }

    /// Cores that it uses at home, as declared.
    #[must_use]
    pub fn home_cpu(&self) -> f64 {
        self.cpu.unwrap_or(self.quota)
    }
}

fn of_part(spec: &ApplicationSpec, part: &Part) -> PartModel {
    let resources = &part.template.spec.resources;
    PartModel {
        name: part.name.clone(),
        pins: pins(spec, part),
        runs: part.runs,
        share: part.share(),
        gain: part.gain,
        home_accuracy: part.home_accuracy,
        cpu: part.cpu.map(|cpu| cpu.cores()),
        cpu_on: part.cpu_on.iter().map(|(node, cpu)| (node.clone(), cpu.cores())).collect(),
        quota: resources.cpu.map_or(0.0, |cpu| cpu.cores()),
        memory: resources.memory.map_or(0.0, |memory| memory.0 as f64),
    }
}

fn limits(signal: &Signal) -> String {
    let unit = if signal.unit.is_empty() { "" } else { &*format!(" {}", signal.unit) };
    match (signal.min, signal.max) {
        (Some(min), Some(max)) => format!("{min} to {max}{unit}"),
        (Some(min), None) => format!("at least {min}{unit}"),
        (None, Some(max)) => format!("at most {max}{unit}"),
        (None, None) => String::new(),
    }
}
