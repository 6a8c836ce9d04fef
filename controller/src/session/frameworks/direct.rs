//! Tickets: who may exchange messages with an agent directly, told to both.
//!
//! What is decided in [`muster_controller_core::ticket`] is carried out under the lock of the tickets, so that both sides hear
//! it in the order in which it was decided. Agents get the whole of their node through a watch, which is never full.

use std::collections::BTreeMap;
use std::sync::Mutex;

use muster_api::direct::{SECRET_BYTES, Secret, server_name};
use muster_api::id::TaskUid;
use muster_api::name::NodeName;
use muster_api::wire::agent::v1 as agent;
use muster_api::wire::framework::v1 as wire;
use muster_controller_core::cluster::Executor;
use muster_controller_core::ticket::{Changes, Session, Tickets, Told};
use ring::rand::{SecureRandom as _, SystemRandom};

use super::Frameworks;
use crate::reconcile::desk::FrameworkUid;
use crate::session::lock;

/// The tickets of this life of the controller.
#[derive(Debug, Default)]
pub(super) struct Doors(Mutex<Tickets>);

fn secret() -> Secret {
    let mut bytes = [0; SECRET_BYTES];
    SystemRandom::new().fill(&mut bytes).expect("the kernel gives random bytes");
    Secret::new(bytes)
}

impl Frameworks {
    /// All executors of a node, and where its agent takes their messages.
    pub(crate) fn executors_at(&self, node: &NodeName, address: &str, executors: &[Executor]) {
        let owner = |e: &Executor| (e.uid.clone(), FrameworkUid::clone(&e.framework));
        let executors: BTreeMap<TaskUid, FrameworkUid> = executors.iter().map(owner).collect();
        self.decide(|tickets| tickets.executors(node, address, executors, &mut secret));
    }

    /// A session began; `direct`: its framework can dial agents.
    pub(super) fn may_dial(&self, framework: &FrameworkUid, number: u64, direct: bool) {
        let session = direct.then_some(Session(number));
        self.decide(|tickets| tickets.began(framework, session, &mut secret));
    }

    /// A session ended, and what its framework was given ends with it.
    pub(super) fn may_not_dial(&self, framework: &FrameworkUid, number: u64) {
        self.decide(|tickets| tickets.left(framework, Session(number), &mut secret));
    }

    pub(super) fn nobody_dials(&self, framework: &FrameworkUid) {
        self.decide(|tickets| tickets.removed(framework, &mut secret));
    }

    pub(super) fn not_dialled(&self, executor: &str) {
        self.decide(|tickets| tickets.ended(&TaskUid::new(executor), &mut secret));
    }

    fn decide(&self, act: impl FnOnce(&mut Tickets) -> Changes) {
        let mut tickets = lock(&self.doors.0);
        let Changes { nodes, told } = act(&mut tickets);
        for node in nodes {
            let Some(connection) = self.agents.connection(&node) else { continue };
            let ticket = |(executor, secret): (TaskUid, Option<Secret>)| agent::Ticket {
                executor: executor.to_string(),
                secret: secret.map(|secret| secret.bytes().to_vec()).unwrap_or_default(),
            };
            let all = tickets.on(&node).into_iter().map(ticket).collect();
            connection.tickets.send_replace(agent::Tickets { tickets: all });
        }
        for told in told {
            self.tell_door(told);
        }
    }

    fn tell_door(&self, told: Told) {
        let Told { framework, session, executor, node, door } = told;
        let open = lock(&self.open).get(&*framework).map(|open| open.outlet.clone());
        let Some(outlet) = open.filter(|outlet| outlet.session() == session.0) else { return };
        let (address, secret) = door.unzip();
        outlet.say(wire::event::Event::Direct(wire::Direct {
            executor: executor.to_string(),
            server_name: server_name(node.as_str()),
            node: node.to_string(),
            address: address.unwrap_or_default(),
            ticket: secret.map(|secret: Secret| secret.bytes().to_vec().into()).unwrap_or_default(),
        }));
    }
}

/// Counts a message that passes the controller.
pub(super) fn count(direction: &'static str) {
    metrics::counter!("muster_framework_messages_total", "direction" => direction).increment(1);
}
