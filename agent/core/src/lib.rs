//! The agent's decisions, without the agent: no runtime, no files, no clock, no randomness. Time is an
//! argument; what came of an effect comes back as an event.
//!
//! | module | holds |
//! |---|---|
//! | [`desired`] | what the controller wants of a task, as far as decisions need it |
//! | [`observed`] | what a runtime saw of an attempt |
//! | [`event`] | what goes into a decision, and what comes out of it |
//! | [`workload`] | one task's state machine: `Event` in, `Response` out |
//! | [`restart`] | when an ended task starts again, and after how long |
//! | [`probe`] | when a running attempt is checked, and what follows from the answers |
//! | [`depend`] | the tasks that a task waits for: how far they are, and who was started again |
//! | [`link`] | how the link to the controller does |
//! | [`journal`] | which reports a session has to say |
//! | [`report`] | what is told to the controller, and its sequence |
//! | [`image`] | images that are pulled before a task needs them: which now, which later |
//! | [`executor`] | an executor and the works it was given: who may end, and on whose word |
//! | [`gate`] | who may command the robot's actuators, and when the robot is stopped |
//! | [`sensor`] | one reader of each sensor for any number of tasks: who gets which frame, when a source is read |
//! | [`pose`] | where the robot is by what ROS says: frames, transforms, whether it counts |
//! | [`sim`] | a simulated robot: walls, base, laser, camera, battery |
//! | [`plan`] | a set of assignments against the tasks that are known: who gets which event |
//!
//! The executor (`muster-agent`'s `driver`) keeps three promises that the proofs here rest on:
//! effects are carried out in order; a `Persist` is durable before the effect after it begins; a
//! runtime's answer is given back as an event exactly once per effect, in any order.
#![deny(missing_docs)]

pub mod depend;
pub mod desired;
pub mod event;
pub mod executor;
pub mod gate;
pub mod image;
pub mod journal;
pub mod link;
pub mod observed;
pub mod plan;
pub mod pose;
pub mod probe;
pub mod report;
pub mod restart;
pub mod sensor;
pub mod sim;
pub mod time;
pub mod workload;
