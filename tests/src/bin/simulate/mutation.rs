//! Faults that can be planted in the simulation's own wiring, to see that the invariants find them.

use std::fmt;

use clap::ValueEnum;

/// A planted fault.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub(crate) enum Mutation {
    /// An agent says that a driving task has ended when it was only told to.
    DoubleLease,
    /// The controller's disk answers for what it has not synced.
    LostWrite,
    /// An agent's disk answers for what it writes, and does not keep it.
    DoubleRun,
    /// A task that drives is ended in the books, and its lease is not given back.
    Leak,
    /// Agents say that they have twice the CPU that there is.
    Overcommit,
    /// An agent never says that a task has ended.
    LostEnd,
    /// A framework is removed as soon as it is away.
    HastyFailover,
    /// The end of a framework's task is acknowledged by somebody else.
    ForgedAck,
    /// Offers do not reach their framework.
    LostOffer,
    /// What runs cannot be ended by order.
    DeafToStops,
    /// An agent says that a person's grant counts, and its gate has not heard of it.
    ForgedHold,
    /// A set is told that its rollouts may take everything down.
    HastyRollout,
    /// A robot that is cut off begins what stands by too soon.
    HastyStandby,
}

impl fmt::Display for Mutation {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let value = self.to_possible_value();
        f.write_str(value.as_ref().map_or("", |value| value.get_name()))
    }
}
