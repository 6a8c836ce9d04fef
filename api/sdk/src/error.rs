//! What can go wrong, by what the caller can do about it.

use std::fmt;
use std::path::PathBuf;

use muster_api::direct::MESSAGE_MAX;
use muster_api::wire::framework::v1 as proto;

/// Why a call was not done.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{reason}: {message}")]
pub struct CallRefused {
    /// What kind of refusal it is.
    pub reason: Reason,
    /// A sentence for people.
    pub message: String,
    /// What is wrong where in the call; empty when no single place is.
    pub causes: Vec<Cause>,
}

/// One thing that is wrong with a call.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Cause {
    /// Its place: `launches[0].spec.resources.cpu`.
    pub field: String,
    /// What is wrong there.
    pub message: String,
}

/// What kind of refusal it is.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[non_exhaustive]
pub enum Reason {
    /// The call means nothing, or a task's spec is refused: change it.
    Invalid,
    /// An offer was rescinded, expired or answered before: wait for the next one.
    OfferGone,
    /// The tasks want more than was offered.
    ExceedsOffer,
    /// Another one was first: wait for the next offer.
    Conflict,
    /// The namespace's quota is used up.
    Quota,
    /// There is no such task or executor.
    NotFound,
    /// The controller could not do it now: try again.
    Unavailable,
    /// The session broke before the answer came. Whether it was done, status updates tell.
    Disconnected,
    /// The framework has ended: nothing is sent any more.
    Ended,
    /// A reason that this version of the SDK does not know.
    Other,
}

impl fmt::Display for Reason {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Reason::Invalid => "invalid",
            Reason::OfferGone => "the offer is gone",
            Reason::ExceedsOffer => "more than was offered",
            Reason::Conflict => "another one was first",
            Reason::Quota => "over quota",
            Reason::NotFound => "not found",
            Reason::Unavailable => "unavailable",
            Reason::Disconnected => "disconnected",
            Reason::Ended => "ended",
            Reason::Other => "refused",
        })
    }
}

impl CallRefused {
    pub(crate) fn disconnected() -> Self {
        let message = "the session broke before the answer came".to_owned();
        CallRefused { reason: Reason::Disconnected, message, causes: Vec::new() }
    }

    pub(crate) fn too_long(bytes: usize) -> Self {
        let message =
            format!("{bytes} bytes are more than the {MESSAGE_MAX} that a message may have");
        let cause = Cause { field: "message.data".to_owned(), message: message.clone() };
        CallRefused { reason: Reason::Invalid, message, causes: vec![cause] }
    }

    /// By the agent, of a message.
    pub(crate) fn not_taken() -> Self {
        let message = "the executor is away, or does not keep up with what it is sent".to_owned();
        CallRefused { reason: Reason::Unavailable, message, causes: Vec::new() }
    }

    pub(crate) fn ended() -> Self {
        let message = "the framework's session is over".to_owned();
        CallRefused { reason: Reason::Ended, message, causes: Vec::new() }
    }
}

impl From<proto::Refusal> for CallRefused {
    fn from(refusal: proto::Refusal) -> Self {
        use proto::RefusalReason as Wire;
        let reason = match refusal.reason() {
            Wire::Unspecified => Reason::Other,
            Wire::Invalid => Reason::Invalid,
            Wire::OfferGone => Reason::OfferGone,
            Wire::ExceedsOffer => Reason::ExceedsOffer,
            Wire::Conflict => Reason::Conflict,
            Wire::Quota => Reason::Quota,
            Wire::NotFound => Reason::NotFound,
            Wire::Unavailable => Reason::Unavailable,
        };
        let cause = |cause: proto::Cause| Cause { field: cause.field, message: cause.message };
        let causes = refusal.causes.into_iter().map(cause).collect();
        CallRefused { reason, message: refusal.message, causes }
    }
}

/// Why a framework ended without being stopped.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{reason}: {message}")]
pub struct FrameworkError {
    /// One word: `AlreadyExists`, `Forbidden`, `UnknownFramework`, `Invalid`, `Cut`, or the name of a gRPC code.
    pub reason: String,
    /// A sentence for people.
    pub message: String,
}

/// Why a framework could not begin.
#[derive(Debug, thiserror::Error)]
pub enum ConnectError {
    /// The kubeconfig names no controller that can be dialled.
    #[error("cannot tell which controller to dial")]
    Kubeconfig(#[from] KubeconfigError),
    /// The key, the certificate or the CA cannot be used.
    #[error("the credentials in the kubeconfig cannot be used")]
    Credentials(#[source] rustls::Error),
    /// The file that keeps the framework's id cannot be read.
    #[error("cannot read the state file {}", path.display())]
    StateFile {
        /// Which.
        path: PathBuf,
        /// Why.
        #[source]
        source: std::io::Error,
    },
    /// A radius is around a position, and there is none.
    #[error("a radius is given without a position")]
    RadiusWithoutPosition,
}

/// Why a kubeconfig cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum KubeconfigError {
    /// A file cannot be read.
    #[error("cannot read {}", path.display())]
    Read {
        /// Which.
        path: PathBuf,
        /// Why.
        #[source]
        source: std::io::Error,
    },
    /// A file is no kubeconfig.
    #[error("{} is no kubeconfig", path.display())]
    Syntax {
        /// Which.
        path: PathBuf,
        /// Why.
        #[source]
        source: Box<dyn std::error::Error + Send + Sync>,
    },
    /// Something that is referred to, or needed, is not there.
    #[error("the kubeconfig has no {0}")]
    Missing(String),
    /// Data that should be base64 is not.
    #[error("{0} is not base64")]
    Base64(&'static str),
    /// A token that could not be sent.
    #[error("the token has characters that no token has")]
    Token,
    /// The server's address cannot be dialled.
    #[error("{0:?} is not the address of a controller; write https://HOST:PORT")]
    Server(String),
}
