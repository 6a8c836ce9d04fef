//! Who asks, and whether they may.
//!
//! ```text
//!   certificate (TLS, our own CA) ─▶ Identity, for every request of the connection
//!   Authorization: Bearer …       ─▶ Identity of this request ([`by_token`]); it counts before the certificate
//!     Identity + Access objects ──▶ [`Asker`] ──needs(what)──▶ core::access::decide ──▶ Ok │ 401 │ 403
//! ```
//!
//! [`Identity`] is put into the extensions of every request, where REST handlers and gRPC services find it. Access objects
//! are read anew with every request, so that a right that was taken is gone with the next one; what lasts ends soon after
//! (`until_revoked`).

use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use axum::extract::{Request, State};
use axum::middleware::Next;
use axum::response::Response;
use http::{Extensions, HeaderMap, header};
use muster_api::kind::access::{AUTHENTICATED, Access};
use muster_controller_core::access::{Action, Asked, Denied, Grant, Grants, Verb, Who, decide};
use rustls::pki_types::CertificateDer;

use crate::context::Context;
use crate::objects::{self, ACCESSES};
use crate::pki::{ADMINS, NODE_PREFIX, NODES, hex};
use crate::rest::failure::Failure;
use crate::rest::path::{Object, Target};
use crate::rest::review::Review;
use crate::rest::user_token;
use crate::serve::Stranger;
use crate::store::{Store, Stored};

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
    /// Somebody with a certificate of ours that says neither, or with a token.
    User {
        /// The certificate's common name, or the token's user.
        name: String,
        /// Its organisations, or the token's groups.
        groups: Vec<String>,
        /// The token's id; none: by certificate.
        token: Option<String>,
    },
    /// Nobody in particular: no client certificate, no token.
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
            _ => Self::User { name, groups, token: None },
        }
    }

    /// The identity of somebody of this name and these groups, of whom others ask.
    pub(crate) fn known_as(name: String, groups: Vec<String>) -> Self {
        if groups.iter().any(|group| group == ADMINS) {
            return Self::Admin { name };
        }
        match name.strip_prefix(NODE_PREFIX) {
            Some(node) => Self::Node { name: node.to_owned(), key: String::new() },
            None => Self::User { name, groups, token: None },
        }
    }

    /// Whether both are the same person or program, whatever they show: tokens are renewed.
    pub(crate) fn is(&self, other: &Self) -> bool {
        match (self, other) {
            (Self::User { name, .. }, Self::User { name: other, .. }) => name == other,
            _ => self == other,
        }
    }

    /// The groups that the certificate or the token names, as Kubernetes would show them.
    #[must_use]
    pub fn groups(&self) -> Vec<String> {
        let own = match self {
            Self::Admin { .. } => vec![ADMINS.to_owned()],
            Self::Node { .. } => vec![NODES.to_owned()],
            Self::User { groups, .. } => groups.clone(),
            Self::Anonymous => return vec!["system:unauthenticated".to_owned()],
        };
        own.into_iter().chain([AUTHENTICATED.to_owned()]).collect()
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

/// What Access objects give, as long as they are the same ones.
#[derive(Debug, Default)]
pub struct Rights(Mutex<Known>);

#[derive(Debug, Default)]
struct Known {
    of: Vec<Arc<Stored>>,
    grants: Arc<Grants>,
}

impl Rights {
    /// What a user holds now.
    fn held_by(&self, store: &Store, user: &str, groups: &[String]) -> Vec<Grant> {
        self.now(store).held_by(user, groups)
    }

    fn now(&self, store: &Store) -> Arc<Grants> {
        let present = store.list(ACCESSES, None).items;
        let mut known = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        let same = known.of.len() == present.len()
            && known.of.iter().zip(&present).all(|(known, present)| Arc::ptr_eq(known, present));
        if !same {
            let read = present.iter().filter_map(|stored| objects::read::<Access>(stored));
            let specs: Vec<_> = read.map(|access| access.spec).collect();
            *known = Known { grants: Arc::new(Grants::of(&specs)), of: present };
        }
        Arc::clone(&known.grants)
    }
}

/// Who asks, with what they may at this moment.
#[derive(Debug, Clone)]
pub struct Asker {
    /// Who they are.
    pub identity: Identity,
    pub(crate) who: Who,
    /// A token was shown and does not hold.
    refused: Option<String>,
}

impl Asker {
    /// Who sends a request.
    pub(crate) fn of(context: &Context, extensions: &Extensions) -> Self {
        let identity = extensions.get::<Identity>().cloned().unwrap_or(Identity::Anonymous);
        let refused = extensions.get::<TokenRefused>().map(|refused| refused.0.clone());
        Self { refused, ..Self::with(context, identity) }
    }

    /// Somebody, with what they may now.
    pub(crate) fn with(context: &Context, identity: Identity) -> Self {
        let who = match &identity {
            Identity::Admin { .. } => Who::Admin,
            Identity::Node { name, .. } => Who::Node(name.clone()),
            Identity::User { name, groups, .. } => {
                Who::User(context.rights.held_by(&context.store, name, groups))
            }
            Identity::Anonymous => Who::Nobody,
        };
        Self { identity, who, refused: None }
    }

    /// An administrator, for what works in the controller's own process.
    #[must_use]
    pub fn admin(name: &str) -> Self {
        let identity = Identity::Admin { name: name.to_owned() };
        Self { identity, who: Who::Admin, refused: None }
    }

    pub(crate) fn may(&self, asked: &Asked<'_>) -> bool {
        decide(&self.who, asked).is_ok()
    }

    /// Whether they may.
    ///
    /// # Errors
    /// 401 for who did not say who they are; 403 in Kubernetes' words, with what would allow it.
    pub(crate) fn needs(&self, asked: &Asked<'_>) -> Result<(), Failure> {
        let denied = match decide(&self.who, asked) {
            Ok(()) => return Ok(()),
            Err(denied) => denied,
        };
        match (&denied, asked) {
            (Denied::WhoAreYou, _) => Err(Failure::unauthorized(match &self.refused {
                Some(why) => format!("the token was refused: {why}"),
                None => denied.to_string(),
            })),
            (_, Asked::Right(action)) => {
                Err(Failure::forbidden(&self.identity.name(), action, &denied))
            }
            (_, Asked::Open | Asked::Known) => Err(Failure::denied(denied.to_string())),
        }
    }
}

/// Sessions of agents, frameworks and publishers of poses, as something that needs a right.
pub(crate) fn stream<'a>(
    (resource, subresource): (&'a str, &'a str),
    namespace: Option<&'a str>,
    name: Option<&'a str>,
) -> Asked<'a> {
    Asked::Right(Action {
        verb: Verb::Create,
        group: muster_api::GROUP,
        resource,
        subresource: Some(subresource),
        namespace,
        name,
    })
}

/// How often it is looked whether those who were let in to something that lasts may still have it.
pub(crate) const LOOK_AGAIN: Duration = Duration::from_secs(2);

/// Whether somebody may do this at this moment, also by what they showed: their token may have ended since.
pub(crate) fn still_may(context: &Context, identity: &Identity, asked: &Asked<'_>) -> bool {
    user_token::holds_for(context, identity).is_some()
        && Asker::with(context, identity.clone()).may(asked)
}

/// Returns when a user may not do this any more: [`LOOK_AGAIN`] after the right or the token was taken back, and as soon as
/// the token expires. Administrators and nodes have it by their certificates, which last as long as their connections.
pub(crate) async fn until_revoked(context: &Context, identity: &Identity, asked: &Asked<'_>) {
    if !matches!(identity, Identity::User { .. }) {
        return std::future::pending().await;
    }
    while still_may(context, identity, asked) {
        let holds = user_token::holds_for(context, identity).unwrap_or_default();
        tokio::time::sleep(LOOK_AGAIN.min(holds)).await;
    }
}

/// What a request asks for.
pub(crate) fn asked(verb: Verb, target: &Target) -> Asked<'_> {
    let group = muster_api::GROUP;
    let of = |resource| {
        let (subresource, namespace, name) = (None, None, None);
        Asked::Right(Action { verb, group, resource, subresource, namespace, name })
    };
    match target {
        Target::Health(_) | Target::Version | Target::Join => Asked::Open,
        Target::Discovery(_) | Target::OpenApi(_) => Asked::Known,
        Target::Review(Review::OfOthers) => Asked::Right(Action {
            verb,
            group: "authorization.k8s.io",
            resource: "subjectaccessreviews",
            subresource: None,
            namespace: None,
            name: None,
        }),
        Target::Review(_) => Asked::Known,
        Target::Metrics => of("metrics"),
        Target::Plan => of("plan"),
        Target::Check => of("check"),
        Target::Transaction => of("transaction"),
        Target::Usage => of("usage"),
        Target::Offers => of("offers"),
        Target::Poses => of("poses"),
        Target::Tokens(_) => of("jointokens"),
        Target::UserTokens(_) => of("usertokens"),
        Target::Measured(measured) => Asked::Right(Action {
            verb,
            group: "metrics.k8s.io",
            resource: if measured.pods { "pods" } else { "nodes" },
            subresource: None,
            namespace: measured.namespace.as_deref(),
            name: measured.name.as_deref(),
        }),
        Target::Objects(object) => of_object(verb, object),
    }
}

/// Something done to an object, or to a collection.
pub(crate) fn of_object(verb: Verb, object: &Object) -> Asked<'_> {
    let (info, name) = (object.entry.info, object.name.as_deref());
    let namespace = match info.kind {
        // A Namespace is in itself, as Kubernetes has it.
        "Namespace" => name,
        _ => object.namespace.as_deref(),
    };
    Asked::Right(Action {
        verb,
        group: info.group,
        resource: info.plural,
        subresource: object.subresource.map(|subresource| subresource.as_str()),
        namespace,
        name,
    })
}

/// Why a token was refused, in the extensions of its request.
#[derive(Debug, Clone)]
struct TokenRefused(String);

/// Reads the token of a request, where it has one. A token that does not hold makes its sender nobody, whatever
/// certificate they have: who names a token means it.
pub(crate) async fn by_token(
    State(context): State<Arc<Context>>,
    mut request: Request,
    next: Next,
) -> Response {
    if let Some(shown) = bearer(request.headers()) {
        let identity = shown.and_then(|shown| user_token::identity(&context, shown));
        // Nothing behind this has a use for it.
        request.headers_mut().remove(header::AUTHORIZATION);
        let identity = match identity {
            Ok(identity) => {
                if let Some(stranger) = request.extensions().get::<Stranger>() {
                    stranger.is_known_as(&identity.name());
                }
                identity
            }
            Err(why) => {
                request.extensions_mut().insert(TokenRefused(why));
                Identity::Anonymous
            }
        };
        request.extensions_mut().insert(identity);
    }
    next.run(request).await
}

/// The token of a request; none: it has no credentials in its head.
fn bearer(headers: &HeaderMap) -> Option<Result<&str, String>> {
    let value = headers.get(header::AUTHORIZATION)?;
    let token = value.to_str().ok().and_then(|text| {
        let (scheme, token) = text.split_once(' ')?;
        scheme.eq_ignore_ascii_case("bearer").then(|| token.trim())
    });
    Some(token.ok_or_else(|| "only `Authorization: Bearer TOKEN` is understood".to_owned()))
}
