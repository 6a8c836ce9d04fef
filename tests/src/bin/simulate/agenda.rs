//! What is going to happen, in the order of the world's time.

use std::collections::BTreeMap;

use crate::agent::What;
use crate::framework::Deed;
use crate::net::Conn;

/// Something that is going to happen.
#[derive(Debug)]
pub(crate) enum Due {
    /// The oldest of what is under way on a connection arrives at the controller.
    Up(Conn),
    /// The same at the agent.
    Down(Conn),
    /// Something happens on a machine.
    Machine(usize, What),
    /// Something happens to the framework at this end of the network.
    Framework(usize, Deed),
    /// The controller has pinged a framework for long enough, if it does not answer.
    Lost(Conn),
    /// The controller is started again.
    Controller,
    /// What parts tell is as it should be again.
    WellAgain,
    /// A partition ends.
    Heal(usize),
}

/// By time in milliseconds; at the same time in the order in which they were put.
#[derive(Debug, Default)]
pub(crate) struct Agenda {
    due: BTreeMap<(u64, u64), Due>,
    next: u64,
}

impl Agenda {
    pub(crate) fn at(&mut self, time: u64, due: Due) {
        self.due.insert((time, self.next), due);
        self.next += 1;
    }

    pub(crate) fn first(&self) -> Option<u64> {
        self.due.first_key_value().map(|((time, _), _)| *time)
    }

    pub(crate) fn pop(&mut self, now: u64) -> Option<Due> {
        if self.first()? > now {
            return None;
        }
        self.due.pop_first().map(|(_, due)| due)
    }
}
