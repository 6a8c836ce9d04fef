//! Generated protobuf messages and their conversions to and from the types of this crate. Nobody
//! else converts them: wire types stop here.

pub mod agent_session;
mod error;
pub mod framework_session;
pub mod image;
pub mod pose_stream;
mod rope;
mod secret;

pub use error::WireError;
pub use rope::Rope;

/// HTTP/2's windows for sessions, of a stream and of a connection, bytes: the longest message and one more behind it
/// are under way without a word from the other side. With the usual 64 KiB to 1 MiB a long message stands still for a round
/// trip for each window that it fills.
pub const HTTP2_WINDOW: u32 = 8 << 20;
/// Longest HTTP/2 frame that the ends of a session take, bytes. A message of 1 MiB is four of these, or 64 of the usual.
pub const HTTP2_FRAME: u32 = 256 << 10;
/// What one end of a session reads from its socket at once, bytes: TLS itself asks for 4 KiB at a time.
pub const READ_BUFFER: usize = 64 << 10;

/// Package `muster.framework`.
pub mod framework {
    /// Messages of the session between a framework and the controller, with protobuf's JSON mapping.
    #[expect(missing_docs, reason = "generated; the .proto files hold the documentation")]
    #[allow(
        clippy::all,
        clippy::allow_attributes,
        clippy::allow_attributes_without_reason,
        reason = "generated"
    )]
    pub mod v1 {
        include!(concat!(env!("OUT_DIR"), "/muster.framework.v1.rs"));
        include!(concat!(env!("OUT_DIR"), "/muster.framework.v1.serde.rs"));
    }
}

/// Package `muster.executor`.
pub mod executor {
    /// Messages between an agent and an executor.
    #[expect(missing_docs, reason = "generated; the .proto files hold the documentation")]
    #[allow(
        clippy::all,
        clippy::allow_attributes,
        clippy::allow_attributes_without_reason,
        reason = "generated"
    )]
    pub mod v1 {
        include!(concat!(env!("OUT_DIR"), "/muster.executor.v1.rs"));
    }
}

/// Package `muster.agent`.
pub mod agent {
    /// Messages of the session between an agent and the controller.
    #[expect(missing_docs, reason = "generated; the .proto files hold the documentation")]
    #[allow(
        clippy::all,
        clippy::allow_attributes,
        clippy::allow_attributes_without_reason,
        reason = "generated"
    )]
    pub mod v1 {
        include!(concat!(env!("OUT_DIR"), "/muster.agent.v1.rs"));
    }
}

/// Package `muster.gate`.
pub mod gate {
    /// Messages between a robot's gate and those who command its actuators.
    #[expect(missing_docs, reason = "generated; the .proto files hold the documentation")]
    #[allow(
        clippy::all,
        clippy::allow_attributes,
        clippy::allow_attributes_without_reason,
        reason = "generated"
    )]
    pub mod v1 {
        include!(concat!(env!("OUT_DIR"), "/muster.gate.v1.rs"));
    }
}

/// Package `muster.sensor`.
pub mod sensor {
    /// Messages between an agent and the tasks that read its sensors.
    #[expect(missing_docs, reason = "generated; the .proto files hold the documentation")]
    #[allow(
        clippy::all,
        clippy::allow_attributes,
        clippy::allow_attributes_without_reason,
        reason = "generated"
    )]
    pub mod v1 {
        include!(concat!(env!("OUT_DIR"), "/muster.sensor.v1.rs"));
    }
}

/// Package `muster.pose`.
pub mod pose {
    /// Messages of a stream of poses.
    #[expect(missing_docs, reason = "generated; the .proto files hold the documentation")]
    #[allow(
        clippy::all,
        clippy::allow_attributes,
        clippy::allow_attributes_without_reason,
        reason = "generated"
    )]
    pub mod v1 {
        include!(concat!(env!("OUT_DIR"), "/muster.pose.v1.rs"));
    }
}
