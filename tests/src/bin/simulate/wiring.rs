//! Between the frameworks and the controller: who reads, who is pinged in vain, and the faults that can be planted there.

use muster_api::wire::framework::v1 as wire;
use muster_controller::objects::FRAMEWORKS;
use muster_controller::store::Key;
use wire::event::Event as Tell;

use crate::agenda::Due;
use crate::mutation::Mutation;
use crate::net::{Conn, Down};
use crate::world::World;

/// After this the controller has pinged a peer in vain, milliseconds: twice `PING` of its `serve`.
pub(crate) const PINGED: u64 = 30_000;

impl World {
    /// A framework reads from now on, or does not, as it is frozen.
    pub(crate) fn let_read(&mut self, end: usize) {
        let framework = &self.frameworks[end - self.agents.len()];
        let (conn, reads) = (framework.conn(), !framework.frozen);
        if let (Some(controller), Some(conn)) = (&mut self.controller, conn) {
            controller.reads(conn, reads);
        }
    }

    /// The controller has pinged: whoever does not answer has no session any more.
    pub(crate) fn lost(&mut self, conn: Conn) {
        let frozen = self.frameworks.iter().any(|f| f.frozen && f.conn() == Some(conn));
        if self.net.is_dead(conn) || frozen {
            self.hang_up(conn);
            self.close_down(conn);
        }
    }

    /// The controller's end of a connection is closed.
    pub(crate) fn hang_up(&mut self, conn: Conn) {
        let node = self.net.node_of(conn);
        let Some(controller) = &mut self.controller else { return };
        controller.hang_up(conn);
        let end = node.filter(|node| *node >= self.agents.len());
        if let Some(end) = end.filter(|_| self.mutation == Some(Mutation::HastyFailover)) {
            let name = &*self.frameworks[end - self.agents.len()].name;
            controller.remove(&Key::namespaced(FRAMEWORKS, "default", name));
        }
    }

    /// What the controller says to a framework goes on its way.
    pub(crate) fn tell_framework(&mut self, conn: Conn, event: Box<wire::Event>) {
        match &event.event {
            Some(Tell::Offers(_)) if self.mutation == Some(Mutation::LostOffer) => return,
            Some(Tell::Update(update)) if self.mutation == Some(Mutation::ForgedAck) => {
                let end = [wire::TaskState::Succeeded, wire::TaskState::Failed];
                if end.iter().any(|state| *state as i32 == update.state) {
                    let (task, version) = (update.task.clone(), update.version);
                    let forged = wire::call::Call::Acknowledge(wire::Acknowledge { task, version });
                    let call = wire::Call { id: String::new(), call: Some(forged) };
                    if let Some(controller) = &mut self.controller {
                        // A session that is over hears nothing more.
                        let _ = controller.call(conn, call);
                    }
                    return;
                }
            }
            _ => {}
        }
        let chance = (&mut self.dice, &mut self.agenda);
        self.net.send_down(conn, Down::Event(event), self.now, chance);
    }

    /// Connections that cannot be used are found out.
    pub(crate) fn ping(&mut self, conn: Option<Conn>) {
        conn.into_iter().for_each(|conn| self.agenda.at(self.now + PINGED, Due::Lost(conn)));
    }
}
