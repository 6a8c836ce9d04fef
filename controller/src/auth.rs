//! Who asks, and whether they may.
//!
//! The client certificate is verified by TLS against our own CA; its subject says who it is. [`Identity`] is put into
//! the extensions of every request of the connection, where REST handlers and gRPC services find it.

use rustls::pki_types::CertificateDer;

use crate::pki::{ADMINS, NODE_PREFIX, NODES, hex};
use crate::rest::path::{Subresource, Target, Verb};

/// Who is at the other end of a connection.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Identity {
    /// An administrator (`O=muster:admins`): may do everything.
    Admin {
        /// The certificate's common name.
        name: String,
    },
    /// The agent of a node (`O=muster:nodes`): speaks for that node only.
    Node {
        /// The node's name.
        name: String,
        /// SHA-256 of the certificate's public key, hex. The Node says which keys are its agent's
        /// (see `rest::enrol`), so that a name alone admits nobody.
        key: String,
    },
    /// Somebody with a certificate of ours that says neither.
    User {
        /// The certificate's common name.
        name: String,
        /// Its organisations.
        groups: Vec<String>,
    },
    /// Nobody in particular: no client certificate.
    Anonymous,
}

impl Identity {
    /// The identity that a verified client certificate stands for.
    #[must_use]
    pub fn of(certificate: Option<&CertificateDer<'_>>) -> Self {
        let Some(der) = certificate else { return Self::Anonymous };
        let Ok((_, certificate)) = x509_parser::parse_x509_certificate(der) else {
            return Self::Anonymous;
        };
        let subject = certificate.subject();
        let text = |attribute: &x509_parser::x509::AttributeTypeAndValue<'_>| {
            attribute.as_str().unwrap_or_default().to_owned()
        };
        let name = subject.iter_common_name().next().map(text).unwrap_or_default();
        let groups: Vec<String> = subject.iter_organization().map(text).collect();
        if groups.iter().any(|group| group == ADMINS) {
            return Self::Admin { name };
        }
        match name.strip_prefix(NODE_PREFIX) {
            Some(node) if groups.iter().any(|group| group == NODES) => {
                let key = ring::digest::digest(&ring::digest::SHA256, certificate.public_key().raw);
                Self::Node { name: node.to_owned(), key: hex(key.as_ref()) }
            }
            _ => Self::User { name, groups },
        }
    }

    /// The groups that the certificate names, as Kubernetes would show them.
    #[must_use]
    pub fn groups(&self) -> Vec<String> {
        let own = match self {
            Self::Admin { .. } => vec![ADMINS.to_owned()],
            Self::Node { .. } => vec![NODES.to_owned()],
            Self::User { groups, .. } => groups.clone(),
            Self::Anonymous => return vec!["system:unauthenticated".to_owned()],
        };
        own.into_iter().chain(["system:authenticated".to_owned()]).collect()
    }

    /// The name for logs and for answers.
    #[must_use]
    pub fn name(&self) -> String {
        match self {
            Self::Admin { name } | Self::User { name, .. } => name.clone(),
            Self::Node { name, .. } => format!("{NODE_PREFIX}{name}"),
            Self::Anonymous => "anonymous".to_owned(),
        }
    }
}

/// The answer to "may they".
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Permission {
    Granted,
    /// Nobody said who they are: 401.
    WhoAreYou,
    /// They are known, and may not: 403.
    Denied,
}

/// Whether `identity` may do what the request asks. Agents work over gRPC; through REST they see their own Node.
pub(crate) fn permits(identity: &Identity, verb: Verb, target: &Target) -> Permission {
    let open = matches!(target, Target::Health(_) | Target::Version | Target::Join);
    match identity {
        _ if open => Permission::Granted,
        Identity::Admin { .. } => Permission::Granted,
        Identity::Anonymous => Permission::WhoAreYou,
        Identity::Node { name, .. } => match target {
            Target::Objects(object)
                if verb == Verb::Get
                    && object.entry.resource.as_str() == "nodes"
                    && matches!(object.subresource, None | Some(Subresource::Pose))
                    && object.name.as_deref() == Some(name) =>
            {
                Permission::Granted
            }
            Target::Discovery(_) | Target::OpenApi(_) | Target::Review(_) => Permission::Granted,
            _ => Permission::Denied,
        },
        Identity::User { .. } => match target {
            Target::Discovery(_) | Target::OpenApi(_) | Target::Review(_) => Permission::Granted,
            _ => Permission::Denied,
        },
    }
}
