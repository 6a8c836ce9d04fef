//! Who drives: robots are commanded by whoever may think that they can, and people hold them.
//!
//! Whatever has a lease and lives commands its robot once a step, and now and then lets another task drive; what passes the gate
//! is held against [`crate::truth`].

use bytes::Bytes;
use muster_agent_core::gate::{Token, Verdict};
use muster_api::id::{Epoch, TaskUid};
use muster_api::kind::lease::HolderKind;
use muster_api::kind::node::estop::EStopTier;
use muster_controller::store::Key;
use serde_json::Value;

use crate::action::Action;
use crate::invariant::{Invariant, Violation};
use crate::truth::Command;
use crate::users::Asked;
use crate::world::World;

impl World {
    /// Whatever lives and was granted a robot commands it.
    pub(crate) fn drive(&mut self) {
        for (node, task, epoch) in self.drivers() {
            let token = self.token(node, &task, epoch);
            self.command(node, task, token);
        }
    }

    fn drivers(&self) -> Vec<(usize, TaskUid, u64)> {
        let granted = self.truth.live.iter();
        granted
            .filter_map(|(uid, live)| Some((live.node, uid.clone(), live.takes.drives?)))
            .collect()
    }

    fn command(&mut self, node: usize, task: TaskUid, token: Token) -> Option<Verdict> {
        let command = Command { task, token };
        self.with_agent(node, |agent, hands| agent.command(command, hands))
    }

    /// What it commands with: its grant, or a part of it that is newer than what it handed on. Now and then it hands one on.
    fn token(&mut self, node: usize, task: &TaskUid, epoch: u64) -> Token {
        let number = self.handed_on.get(task).copied();
        let token = |number: Option<u32>| Token {
            epoch: Epoch(epoch),
            sequence: number.into_iter().collect(),
        };
        if !self.dice.one_in(12) {
            return token(number);
        }
        let others = self.truth.live.iter().filter(|(uid, live)| live.node == node && *uid != task);
        let others: Vec<TaskUid> = others.map(|(uid, _)| uid.clone()).collect();
        let Some(other) = self.dice.pick(&others).cloned() else { return token(number) };
        let next = number.unwrap_or(0) + 2;
        self.handed_on.insert(task.clone(), next);
        let handed_on = token(Some(next - 1));
        self.with_agent(node, |agent, hands| {
            agent.delegate(task, handed_on.clone(), &other, hands);
        });
        self.command(node, other, handed_on);
        token(Some(next))
    }

    /// A person acts on a lease.
    pub(crate) fn hold(&mut self, action: Action, index: usize) -> bool {
        let name = format!("{}.body", self.agents[index].name());
        let Some((_, _, lease)) = self.view.leases.all().find(|(key, ..)| *key.name == *name)
        else {
            return false;
        };
        let holder = lease.status.as_ref().and_then(|status| status.holder.as_ref());
        let person = holder.filter(|holder| holder.kind == HolderKind::User);
        let person = person.map(|holder| holder.name.clone());
        match (action, person) {
            (Action::Return, None) => false,
            (Action::Return, Some(person)) => {
                self.ask(|users, _| Some(users.give_back(&name, &person)))
            }
            (_, _) => {
                let take = action == Action::Take;
                self.ask(|users, dice| Some(users.hold((index, &name), take, dice)))
            }
        }
    }

    /// A person stops a robot, or releases what they know of.
    pub(crate) fn stop_robot(&mut self, action: Action, index: usize) -> bool {
        let name = self.agents[index].name().to_owned();
        if self.agents[index].gate.is_none() {
            return false;
        }
        if action == Action::EStop {
            let tier =
                *self.dice.pick(&[EStopTier::Settle, EStopTier::Cut]).unwrap_or(&EStopTier::Cut);
            return self.ask(|users, _| Some(users.estop(&name, tier, None)));
        }
        let Some((_, _, node)) = self.view.nodes.all().find(|(key, ..)| *key.name == *name) else {
            return false;
        };
        let known = node.status.as_ref().and_then(|status| status.estop.as_ref());
        let number = known.filter(|estop| !estop.tier.is_none()).map(|estop| estop.number);
        if number.is_none() && node.spec.estop.is_none() {
            return false;
        }
        self.ask(|users, _| Some(users.estop(&name, EStopTier::None, number)))
    }

    /// What somebody may rely on since they were answered.
    pub(crate) fn is_answered(&mut self, asked: Option<Asked>, code: u16, body: &Bytes) {
        match asked {
            Some(Asked::Hold(node)) if code == 200 => {
                let lease: Value = serde_json::from_slice(body).unwrap_or_default();
                let epoch = lease["status"]["epoch"].as_u64().unwrap_or(u64::MAX);
                if let Err(violation) = self.truth.person_holds(node, epoch) {
                    self.break_with(violation);
                }
                self.drive();
            }
            // Who was told that a node is not off has called off none of its tasks.
            Some(Asked::Fence(tasks)) if (400..500).contains(&code) => {
                self.truth.take_back(&tasks);
            }
            _ => {}
        }
    }

    /// Two may have a robot's actuators and live only if a person took it from the older one.
    pub(crate) fn nobody_drives_beside(&mut self) -> Result<(), Violation> {
        for beside in std::mem::take(&mut self.truth.beside) {
            let name = self.agents[beside.node].name();
            if self.view.fences.get(name).is_none_or(|fence| *fence <= beside.older) {
                return Err(Invariant::OneDriver.broken(beside.how));
            }
        }
        Ok(())
    }

    /// What is still under way between gates, agents and people; and whether who holds a robot can drive it.
    pub(crate) fn unsettled_drivers(&mut self, words: &mut Vec<String>) {
        let mut drivers = Vec::new();
        for index in 0..self.agents.len() {
            let agent = &self.agents[index];
            let name = agent.name();
            words.extend(agent.gate_unsettled().map(|what| format!("{name}: {what}")));
            let Some(stopped) = agent.stopped() else { continue };
            let key = Key::cluster(muster_controller::objects::NODES, name);
            let node = self.view.nodes.objects.get(&key).map(|(_, _, node)| node);
            let said = node.and_then(|node| node.status.as_ref()?.estop.as_ref());
            if said.is_none_or(|estop| estop.tier != stopped) {
                words.push(format!("{name} is stopped ({stopped}), and {said:?} is written"));
            }
            if node.is_some_and(|node| node.spec.estop > stopped) {
                words.push(format!("{name} is to be stopped, and is not"));
            }
            let lease = format!("{name}.body");
            let lease = self.view.leases.all().find(|(key, ..)| *key.name == *lease);
            let status = lease.and_then(|(_, _, lease)| lease.status.clone()).unwrap_or_default();
            let Some(holder) = status.holder else { continue };
            let granted = agent.granted().map(|grant| grant.epoch);
            match holder.kind {
                HolderKind::User if granted != Some(status.epoch) => {
                    words
                        .push(format!("{name} is held by {holder}, and its gate says {granted:?}"));
                }
                HolderKind::Task if stopped.is_none() => {
                    drivers.push((index, holder.uid, status.epoch))
                }
                _ => {}
            }
        }
        for (node, task, epoch) in drivers {
            if !self.truth.live.contains_key(&task) {
                continue;
            }
            let token = self.token(node, &task, epoch.0);
            let verdict = self.command(node, task.clone(), token);
            if verdict != Some(Verdict::Ok) {
                words.push(format!("{task} holds node {node}, and cannot drive it: {verdict:?}"));
            }
        }
    }
}
