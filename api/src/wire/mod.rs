//! Generated protobuf messages and their conversions to and from the types of this crate. Nobody
//! else converts them: wire types stop here.

pub mod agent_session;
mod error;

pub use error::WireError;

/// Package `muster.agent`.
pub mod agent {
    /// Messages of the session between an agent and the controller.
    #[expect(missing_docs, reason = "generated; the .proto files hold the documentation")]
    #[allow(clippy::all, clippy::allow_attributes, reason = "generated")]
    pub mod v1 {
        include!(concat!(env!("OUT_DIR"), "/muster.agent.v1.rs"));
    }
}
