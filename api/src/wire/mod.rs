//! Generated protobuf messages and their conversions to and from the types of this crate. Nobody
//! else converts them: wire types stop here.

pub mod agent_session;
mod error;
pub mod framework_session;
pub mod pose_stream;

pub use error::WireError;

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
