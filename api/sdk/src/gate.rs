//! Commands for a robot's actuators, through the gate that stands before its drivers.
//!
//! Every command shows a lease and is answered. Whoever gave the last command and is gone or silent (200 ms, unless the
//! robot's operator says otherwise) leaves a robot that stands: command it as long as it is to move.
//!
//! ```no_run
//! # async fn drive() -> Result<(), muster_sdk::gate::GateError> {
//! use muster_sdk::gate::{Gate, Verdict};
//!
//! let mut gate = Gate::from_env().await?;
//! loop {
//!     let answer = gate.command("base:Drive", &br#"{"linear": 0.2}"#[..]).await?;
//!     if answer.verdict() == Verdict::Revoked {
//!         break;
//!     }
//!     tokio::time::sleep(std::time::Duration::from_millis(50)).await;
//! }
//! # Ok(())
//! # }
//! ```

use std::env;
use std::io;
use std::path::Path;

use bytes::Bytes;
use muster_api::wire::gate::v1 as proto;
use proto::call::Call;
use proto::event::Event;
pub use proto::{Answer, Lease, Verdict};
use tokio::net::UnixStream;
use tokio::net::unix::{OwnedReadHalf, OwnedWriteHalf};

use crate::executor::frame::{self, Frames};

/// The variable that names the gate's socket.
pub const SOCKET: &str = "MUSTER_GATE_SOCKET";
/// The variable that holds what the task shows there.
pub const TOKEN: &str = "MUSTER_GATE_TOKEN";
/// The variable that holds the task's lease, `NODE.GROUP:EPOCH`.
pub const LEASE: &str = "MUSTER_LEASE";

/// Why the gate is not there for this program.
#[derive(Debug, thiserror::Error)]
pub enum GateError {
    /// The environment says nothing of a gate.
    #[error("{0} is not set; no gate stands before this robot's drivers, or this is no task")]
    NotSet(&'static str),
    /// The lease is no lease.
    #[error("{LEASE}={0:?} is no lease; NODE.GROUP:EPOCH")]
    Lease(String),
    /// The connection does not come about, or broke. The robot stands.
    #[error("the connection to the gate")]
    Io(#[from] io::Error),
    /// The gate closed the connection: the task is over, or its token does not count.
    #[error("the gate closed the connection")]
    Closed,
}

/// A connection to the gate. Dropped: the robot stands, if this drove it.
#[derive(Debug)]
pub struct Gate {
    from: Frames<OwnedReadHalf>,
    to: OwnedWriteHalf,
    lease: Lease,
    id: u64,
}

impl Gate {
    /// As the task that this program runs in, with the lease that it was given.
    ///
    /// # Errors
    ///
    /// When the environment does not say where and with what, and when the gate does not take it in.
    pub async fn from_env() -> Result<Gate, GateError> {
        let get = |name| env::var(name).map_err(|_| GateError::NotSet(name));
        let lease = lease(&get(LEASE)?)?;
        Gate::connect(Path::new(&get(SOCKET)?), get(TOKEN)?, lease).await
    }

    /// At a socket, with a token and a lease. An executor connects once for each task that has a lease (its token is in
    /// [`crate::executor::Lease`]).
    ///
    /// # Errors
    ///
    /// When the gate does not take it in.
    pub async fn connect(socket: &Path, token: String, lease: Lease) -> Result<Gate, GateError> {
        let (from, mut to) = UnixStream::connect(socket).await?.into_split();
        let call = Call::Register(proto::Register { token });
        frame::write(&mut to, &proto::Call { call: Some(call) }).await?;
        let mut gate = Gate { from: Frames::new(from), to, lease, id: 0 };
        match gate.hear().await? {
            Event::Registered(_) => Ok(gate),
            Event::Answer(_) => Err(GateError::Closed),
        }
    }

    /// The lease that commands show.
    #[must_use]
    pub fn lease(&self) -> &Lease {
        &self.lease
    }

    /// Shows another lease from now on: one under the task's own, `[…, n]`, to outrank a delegate.
    pub fn set_lease(&mut self, lease: Lease) {
        self.lease = lease;
    }

    /// Commands an actuator; returns when the driver has it, or why it has not.
    ///
    /// # Errors
    ///
    /// When the connection is gone. The robot stands.
    pub async fn command(
        &mut self,
        actuator: &str,
        data: impl Into<Bytes> + Send,
    ) -> Result<Answer, GateError> {
        let (lease, data) = (Some(self.lease.clone()), data.into());
        self.id += 1;
        let (id, actuator) = (self.id, actuator.to_owned());
        self.ask(Call::Command(proto::Command { id, lease, actuator, data, format: String::new() }))
            .await
    }

    /// Says that this program lives, while it does not move the robot.
    ///
    /// # Errors
    ///
    /// When the connection is gone.
    pub async fn retain(&mut self) -> Result<(), GateError> {
        let call = Call::Retain(proto::Retain {});
        Ok(frame::write(&mut self.to, &proto::Call { call: Some(call) }).await?)
    }

    /// Lets another task (by its uid) drive with `lease`: this one's with a number appended that is newer than what was used
    /// before.
    ///
    /// # Errors
    ///
    /// When the connection is gone.
    pub async fn delegate(&mut self, lease: Lease, task: &str) -> Result<Answer, GateError> {
        self.id += 1;
        let (id, lease, task) = (self.id, Some(lease), task.to_owned());
        self.ask(Call::Delegate(proto::Delegate { id, lease, task })).await
    }

    async fn ask(&mut self, call: Call) -> Result<Answer, GateError> {
        frame::write(&mut self.to, &proto::Call { call: Some(call) }).await?;
        loop {
            // An answer to a question that was given up is passed over.
            match self.hear().await? {
                Event::Answer(answer) if answer.id == self.id => return Ok(answer),
                Event::Answer(_) | Event::Registered(_) => {}
            }
        }
    }

    async fn hear(&mut self) -> Result<Event, GateError> {
        loop {
            match self.from.next::<proto::Event>().await? {
                Some(proto::Event { event: Some(event) }) => return Ok(event),
                // Something newer than this program.
                Some(_) => {}
                None => return Err(GateError::Closed),
            }
        }
    }
}

/// From `NODE.GROUP:EPOCH[,NUMBER…]`.
fn lease(text: &str) -> Result<Lease, GateError> {
    let refused = || GateError::Lease(text.to_owned());
    let (_, numbers) = text.rsplit_once(':').ok_or_else(refused)?;
    let mut numbers = numbers.split(',');
    let epoch = numbers.next().and_then(|n| n.parse().ok()).ok_or_else(refused)?;
    let sequence: Option<Vec<u32>> = numbers.map(|n| n.parse().ok()).collect();
    Ok(Lease { epoch, sequence: sequence.ok_or_else(refused)? })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn leases_of_the_environment() {
        let read = lease("tb-1.body:6,1").expect("a lease");
        assert_eq!((read.epoch, read.sequence), (6, vec![1]));
        for bad in ["", "6", "tb-1.body:", "tb-1.body:x", "tb-1.body:6,", "tb-1.body:-1"] {
            assert!(matches!(lease(bad), Err(GateError::Lease(_))), "{bad}");
        }
    }
}
