//! Liveness: once the faults stop, everything settles, and what waits says why.

use std::time::Duration;

use muster_api::kind::framework::ACKNOWLEDGE_FINALIZER;
use muster_api::kind::node::NodeStatus;
use muster_api::kind::task::Task;
use muster_api::phase::TaskPhase;

use crate::agenda::Due;
use crate::agent::What;
use crate::applications::Told;
use crate::dice;
use crate::framework::Deed;
use crate::invariant::Invariant;
use crate::truth::Cause;
use crate::view::{FENCED, phase};
use crate::world::World;

/// Longer than the longest back-off of a task, and than whatever waits for a time.
const LONGEST: u64 = 900_000;
/// Between two looks.
const LOOK_EVERY: u64 = 5_000;

/// A task is over, and its framework has yet to say that it knows.
fn waits_to_be_heard(task: &Task) -> bool {
    let mut finalizers = task.metadata.finalizers.iter().flatten();
    phase(task).is_terminal() && finalizers.any(|finalizer| finalizer == ACKNOWLEDGE_FINALIZER)
}

/// Nothing new is given to a robot that is stopped.
fn is_stopped(status: &NodeStatus) -> bool {
    status.estop.as_ref().is_some_and(|estop| !estop.tier.is_none())
}

impl World {
    /// No fault from now on; gives the world until everything has settled, and says what has not.
    pub(crate) fn settle(&mut self) {
        self.dice = dice::of(self.seed, u64::MAX);
        self.log.say(self.now, format_args!("= the faults stop"));
        self.house.disk.failures().fail_next(0);
        self.house.disk.failures().mislead_next(0);
        self.house.disk.set_latency(Duration::from_millis(1), Duration::ZERO);
        self.net.slowest = 5;
        self.truth.calm = true;
        self.truth.told = Told::default();
        self.failed_at = self.now;
        self.agenda.at(self.now + 1, Due::Controller);
        for index in 0..self.agents.len() {
            self.heal(index);
            self.agents[index].full_until = 0;
            self.agenda.at(self.now + 10_000, Due::Machine(index, What::Begin));
        }
        self.settle_frameworks();
        let end = self.now + LONGEST;
        // What was about to happen happens first.
        self.run_to(self.now + 20_000);
        self.check();
        while self.broken.is_none() {
            let unsettled = self.unsettled();
            if unsettled.is_empty() {
                self.ends_were_told();
                return self.parts_come_home();
            }
            if self.now >= end {
                let how = format!("not settled: {}", unsettled.join("; "));
                return self.break_with(Invariant::EverythingEndsOrExplainsItself.broken(how));
            }
            self.run_to(self.now + LOOK_EVERY);
            self.drive();
            self.check();
        }
    }

    /// Some that are away stay so.
    fn settle_frameworks(&mut self) {
        for index in 0..self.frameworks.len() {
            let end = self.frameworks[index].end;
            self.heal(end);
            self.frameworks[index].keen = true;
            self.frameworks[index].retired = !self.frameworks[index].is_up() && self.dice.one_in(2);
            self.agenda.at(self.now + 1, Due::Framework(end, Deed::Thaw));
            self.agenda.at(self.now + 10_000, Due::Framework(end, Deed::Begin));
        }
    }

    /// What is still under way between frameworks and the controller.
    fn unsettled_frameworks(&self, words: &mut Vec<String>) {
        let known = |id: &str| self.view.frameworks.all().any(|(_, uid, _)| uid.as_str() == id);
        for framework in &self.frameworks {
            let name = &framework.name;
            if framework.retired {
                let left: Vec<_> = framework.tenures.keys().filter(|id| known(id)).collect();
                words.extend(left.iter().map(|id| format!("{name} ({id}) is away, and is kept")));
                continue;
            }
            let Some(offered) = framework.offered() else {
                words.push(format!("{name} has no session"));
                continue;
            };
            if framework.unanswered() > 0 {
                words.push(format!("{name} waits for an answer to an Accept"));
            }
            for (key, _, node) in self.view.nodes.all() {
                let stopped = node.status.as_ref().is_some_and(is_stopped);
                let open = !node.spec.unschedulable && node.spec.taints.is_empty() && !stopped;
                // An offer of nothing is none.
                let gives = node.status.as_ref().is_some_and(|status| {
                    let left = status.free.cpu.0 > 0 && status.free.memory.0 > 0;
                    left || !status.sensors.is_empty()
                });
                if open && gives && !offered.contains(&*key.name) {
                    words.push(format!("{name} is not offered {}", key.name));
                }
            }
        }
        for (uid, (name, id)) in &self.view.owners {
            if !known(id) {
                words.push(format!("{name} ({uid}) has lost its framework"));
            } else if self.view.task(uid).is_some_and(waits_to_be_heard) {
                words.push(format!("the end of {name} ({uid}) is not acknowledged"));
            }
        }
    }

    /// What is still under way.
    fn unsettled(&mut self) -> Vec<String> {
        let mut words = Vec::new();
        if self.up_since.is_none() {
            words.push("the controller does not answer".to_owned());
        }
        for agent in &self.agents {
            if !agent.is_connected() {
                words.push(format!("{} has no session", agent.name()));
            }
            let unheard = agent.unheard();
            if !unheard.is_empty() {
                words.push(format!(
                    "{}: reports of {} were not answered",
                    agent.name(),
                    unheard.join(", ")
                ));
            }
        }
        self.unsettled_frameworks(&mut words);
        self.unsettled_drivers(&mut words);
        self.unsettled_sets(&mut words);
        self.unsettled_applications(&mut words);
        for (key, _, node) in self.view.nodes.all() {
            if !node.status.as_ref().is_some_and(|status| status.is_ready()) {
                words.push(format!("{key} is not ready"));
            }
        }
        for (key, uid, task) in self.view.tasks.all() {
            let status = task.status.clone().unwrap_or_default();
            let lives = self.truth.live.contains_key(uid);
            let wrong = match status.phase {
                _ if task.metadata.deletion_timestamp.is_some() => true,
                TaskPhase::Pending => status.why.is_empty() || lives,
                TaskPhase::Running => !lives,
                // Between two attempts, or after another task.
                TaskPhase::Starting => {
                    lives
                        || !["BackOff", "AwaitingDependency", "Standby"].contains(&&*status.reason)
                }
                TaskPhase::Succeeded | TaskPhase::Failed => lives,
                TaskPhase::Bound | TaskPhase::Stopping | TaskPhase::Unknown => true,
            };
            if wrong {
                let (phase, reason) = (status.phase, &status.reason);
                words.push(format!("{key} ({uid}) is {phase} {reason}, lives: {lives}"));
            }
        }
        for (uid, live) in &self.truth.live {
            if self.view.task(uid).is_none_or(|task| !phase(task).holds_node()) {
                words.push(format!("{uid} lives on node {} and nobody knows", live.node));
            }
        }
        words
    }

    /// The end of each task that ended by itself is what its kernel saw (invariant 5).
    fn ends_were_told(&mut self) {
        let mut wrong = None;
        for (key, uid, task) in self.view.tasks.all() {
            let status = task.status.clone().unwrap_or_default();
            let Some(over) = self.truth.over.get(uid).filter(|over| over.cause == Cause::Itself)
            else {
                continue;
            };
            // The end of a task on a fenced node is what the person said.
            if !status.phase.is_terminal()
                || status.reason == FENCED
                || over.attempt != status.attempt
            {
                continue;
            }
            let code = over.exit.as_ref().and_then(muster_agent_core::observed::Exit::code);
            if status.exit_code != code {
                wrong = Some(format!(
                    "{key} ended with {code:?}, and {:?} is written",
                    status.exit_code
                ));
            }
        }
        if let Some(how) = wrong {
            self.break_with(Invariant::WorkOutlivesItsManagers.broken(how));
        }
    }
}
