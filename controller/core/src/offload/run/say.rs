//! What is said of an application: phase, conditions, and for each part why it is where it is.

use std::collections::BTreeMap;

use muster_api::condition::{CHARACTERISED, DEGRADED, FITS_HOME, MANAGED, READY};
use muster_api::kind::application::{
    ApplicationPhase, ApplicationStatus, MAX_TIMELINE, MappingStatus, Obstacle, PartClass,
    PartStatus, stamp,
};
use muster_api::phase::TaskPhase;

use super::observe::Observed;
use super::runner::Runner;
use super::{Gathered, Look, Plan};
use crate::offload::constraint::{Resource, exceeds};
use crate::offload::problem::HOME;
use crate::offload::reason::{Stand, amount};
use crate::taskset::after;

/// A condition as it is said.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Said {
    /// Which.
    pub condition: &'static str,
    /// Whether it holds.
    pub holds: bool,
    /// Why, one word.
    pub reason: &'static str,
    /// Why, in a sentence.
    pub message: String,
}

impl Said {
    fn new(condition: &'static str, holds: bool, reason: &'static str, message: String) -> Self {
        Said { condition, holds, reason, message }
    }
}

/// The whole plan.
pub(super) fn whole(
    look: &Look<'_>,
    observed: Observed,
    runners: Vec<Runner>,
    decided: Option<&crate::offload::Plan>,
    out: Gathered,
) -> Plan {
    let before = look.snapshot.status;
    let worries = worries(look, &runners);
    let moved: Vec<String> =
        runners.iter().filter(|r| r.moved).map(|r| r.status.name.clone()).collect();
    let parts: Vec<PartStatus> =
        runners.into_iter().filter_map(|runner| part(look, runner, decided)).collect();
    let (all, allowed) = look.model.mappings(look.scales.named);
    let of_spec = |p: &&PartStatus| look.snapshot.spec.part(&p.name).is_some();
    let waits: Vec<&str> =
        parts.iter().filter(of_spec).filter(|p| !p.ready).map(|p| p.name.as_str()).collect();
    let conditions = vec![
        Said::new(MANAGED, true, "Managed", String::new()),
        match waits.as_slice() {
            [] => Said::new(READY, true, "AllServe", String::new()),
            some => {
                let message = format!("not serving: {}", some.join(", "));
                Said::new(READY, false, "PartsNotReady", message)
            }
        },
        match worries.into_iter().next() {
            None => Said::new(DEGRADED, false, "AsItShouldBe", String::new()),
            Some((reason, message)) => Said::new(DEGRADED, true, reason, message),
        },
        Said::new(CHARACTERISED, true, "Characterised", String::new()),
        fits_home(look),
    ];
    let status = ApplicationStatus {
        observed_generation: look.snapshot.generation,
        phase: match before.phase {
            _ if waits.is_empty() => ApplicationPhase::Running,
            ApplicationPhase::Pending => ApplicationPhase::Pending,
            ApplicationPhase::Running | ApplicationPhase::Degraded => ApplicationPhase::Degraded,
        },
        scales: look.scales.views[1..look.scales.named].iter().map(|v| v.name.clone()).collect(),
        mappings: number(all),
        allowed_mappings: number(allowed),
        value: decided.map(|d| rounded(d.value)).or(before.value),
        bound: decided.map(|d| rounded(d.bound)).filter(|b| b.is_finite()),
        connections: observed.connections,
        signals: observed.signals,
        timeline: timeline(look, &parts, &moved),
        conditions: before.conditions.clone(),
        parts,
    };
    let next = after(look.now, look.model.period);
    Plan {
        actions: out.actions,
        status,
        conditions,
        news: out.news,
        look_again: out.look_again.map_or(next, |w| w.min(next)),
    }
}

fn part(
    look: &Look<'_>,
    runner: Runner,
    decided: Option<&crate::offload::Plan>,
) -> Option<PartStatus> {
    let ready = runner.serves(look) || runner.is_done(look);
    let trouble = trouble(look, &runner);
    let index = runner.part;
    let mut status = runner.into_status(look)?;
    status.ready = ready;
    let Some(index) = index else {
        let message = "the application has no such part any more; its task ends".to_owned();
        (status.reason, status.message) = ("NoSuchPart".to_owned(), message);
        status.elsewhere.clear();
        return Some(status);
    };
    let of = &look.model.parts[index];
    status.pinned = of.pins.iter().map(Into::into).collect();
    status.class = if of.may_move() { PartClass::Migratable } else { PartClass::Critical };
    if let Some(decided) = decided {
        let said = &decided.parts[index];
        status.reason = said.stand.reason().to_owned();
        status.message = said.stand.to_string();
        let scales = &look.scales.views;
        let elsewhere = said.elsewhere.iter().map(|other| Obstacle {
            scale: scales[other.scale].name.clone(),
            reason: other.obstacle.reason().to_owned(),
            message: other.obstacle.to_string(),
            gain: rounded(other.gain),
        });
        status.elsewhere = elsewhere.collect();
    } else if status.reason.is_empty() && !of.may_move() {
        let stand = Stand::Pinned(of.pins.clone());
        (status.reason, status.message) = (stand.reason().to_owned(), stand.to_string());
    }
    if let Some((reason, message)) = trouble {
        (status.reason, status.message) = (reason, message);
    }
    Some(status)
}

/// Why a part does not serve.
fn trouble(look: &Look<'_>, runner: &Runner) -> Option<(String, String)> {
    if let Some(why) = &runner.refused {
        return Some(("FailedCreate".to_owned(), why.clone()));
    }
    if runner.is_done(look) {
        return Some(("Completed".to_owned(), "has done what it had to".to_owned()));
    }
    let task = runner.serving(look)?;
    if runner.serves(look) {
        return None;
    }
    let view = &task.view;
    let home = &look.scales.views[HOME].name;
    let refusal = || view.refusal.clone().filter(|_| view.phase == TaskPhase::Pending);
    let what = match view.phase {
        TaskPhase::Pending => format!("waits for a place on {home}"),
        phase => format!("its task is {phase}"),
    };
    let reason = if view.reason.is_empty() { view.phase.as_str() } else { &view.reason };
    let why = refusal().unwrap_or_else(|| view.message.clone());
    let message = if why.is_empty() { what } else { format!("{what}: {why}") };
    Some((reason.to_owned(), message))
}

/// What is not as it should be, the worst first.
fn worries(look: &Look<'_>, runners: &[Runner]) -> Vec<(&'static str, String)> {
    let mut all = Vec::new();
    for runner in runners {
        if let Some(why) = &runner.refused {
            all.push(("FailedCreate", format!("part {}: {why}", runner.status.name)));
        }
    }
    let home = &look.scales.views[HOME];
    if !home.link.up {
        let why = home.unfit.clone().unwrap_or_else(|| "it is not heard".to_owned());
        all.push(("HomeNotReady", format!("{}: {why}", home.name)));
    }
    let lost = |r: &&Runner| r.serving(look).is_some() && !r.serves(look) && !r.is_done(look);
    let began = look.snapshot.status.phase != ApplicationPhase::Pending;
    for runner in runners.iter().filter(|_| began).filter(lost) {
        let (_, why) = trouble(look, runner).unwrap_or_default();
        all.push(("PartsNotReady", format!("part {}: {why}", runner.status.name)));
    }
    for runner in runners {
        let other = runner.stage.and_then(|stage| stage.other());
        let unknown = other.and_then(|other| runner.task(look, other));
        if let Some(task) = unknown.filter(|task| task.view.phase == TaskPhase::Unknown) {
            let (task, node) = (&task.view.name, task.view.node.as_deref().unwrap_or_default());
            let message =
                format!("task {task} on {node} cannot be reached, and may still run there");
            all.push(("TaskUnreachable", message));
        }
    }
    for runner in runners {
        if let Some(why) = runner.not_kept(look) {
            let message = format!("nothing is kept at home for part {}: {why}", runner.status.name);
            all.push(("StandbyNotPlaced", message));
        }
    }
    let fits = fits_home(look);
    all.extend((!fits.holds).then_some((fits.reason, fits.message)));
    all
}

/// Whether everything could be at home at once.
fn fits_home(look: &Look<'_>) -> Said {
    let home = &look.snapshot.spec.home;
    let Some(node) = look.node(home) else {
        let message = format!("there is no node {home}; `muster get nodes` lists them");
        return Said::new(FITS_HOME, false, "NoSuchNode", message);
    };
    let ((cpu, memory), (has_cpu, has_memory)) = (look.model.home_need(), node.allocatable);
    let amounts = [(Resource::Cpu, cpu, has_cpu), (Resource::Memory, memory, has_memory)];
    for (resource, need, have) in amounts {
        if exceeds(need, have) {
            let (need, have) = (amount(resource, need), amount(resource, have));
            let message = format!(
                "all parts together need {need}, {home} has {have}: they could not all come home"
            );
            return Said::new(FITS_HOME, false, "HomeTooSmall", message);
        }
    }
    Said::new(FITS_HOME, true, "Fits", String::new())
}

fn timeline(look: &Look<'_>, parts: &[PartStatus], moved: &[String]) -> Vec<MappingStatus> {
    let mut timeline = look.snapshot.status.timeline.clone();
    let home = &look.snapshot.spec.home;
    let away = || -> BTreeMap<String, String> {
        let scale = |p: &PartStatus| Some((p.name.clone(), p.scale.clone()?));
        parts.iter().filter_map(scale).filter(|(_, scale)| scale != home).collect()
    };
    for name in moved {
        let task = parts.iter().find(|p| p.name == *name).and_then(|p| p.task.as_ref());
        let (reason, message) =
            task.map(|t| (t.reason.clone(), t.message.clone())).unwrap_or_default();
        let (since, part) = (stamp(look.now), name.clone());
        timeline.push(MappingStatus { since, part, reason, message, away: away() });
    }
    let old = timeline.len().saturating_sub(MAX_TIMELINE);
    timeline.split_off(old)
}

/// Whole while that is exact enough to read.
fn number(count: f64) -> String {
    if count < 1e9 { format!("{count:.0}") } else { format!("{count:.1e}") }
}

/// To a thousandth: what differs by less is the same.
fn rounded(value: f64) -> f64 {
    (value * 1000.0).round() / 1000.0
}
