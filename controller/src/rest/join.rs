//! POST …/join: a token, or the node's present certificate, against a new certificate.
//!
//! The Node is created when it is missing, so that an agent needs nothing but its token.

use http::StatusCode;
use muster_api::kind::node::NodeKind;
use muster_api::name::check_name;
use rustls_pki_types::CertificateDer;
use rustls_pki_types::pem::PemObject as _;
use serde::Deserialize;
use serde_json::json;

use super::enrol::{self, Candidate, Name, Right};
use super::failure::Failure;
use super::{Answer, Call, body, token};
use crate::audit::Named;
use crate::auth::Identity;
use crate::context::Context;

#[derive(Debug, Deserialize)]
#[serde(rename_all = "camelCase", deny_unknown_fields)]
struct Request {
    /// Left out by an agent that renews its certificate.
    #[serde(default)]
    token: Option<String>,
    node_name: String,
    kind: NodeKind,
    /// PKCS #10, PEM.
    csr: String,
}

pub(super) async fn join(call: Call) -> Answer {
    let Call { context, request, asker, .. } = call;
    let (parts, body) = request.into_parts();
    let body = body::json(&parts.headers, body).await?;
    let asked: Request = serde_json::from_value(body)
        .map_err(|error| Failure::bad_request(format!("JoinRequest: {error}")))?;
    if let Err(error) = check_name(&asked.node_name) {
        return Err(Failure::bad_request(format!("nodeName: {error}")));
    }
    // Before the token is spent: a request that cannot be signed must not use it up.
    let certificate = context
        .pki
        .sign_node(&asked.node_name, &asked.csr, context.clock.now())
        .map_err(|error| Failure::bad_request(format!("csr: {}", crate::app::chain(&error))))?;
    let shown = match &asker.identity {
        Identity::Node { name, key } if *name == asked.node_name => Some(key.as_str()),
        _ => None,
    };
    let (node, kind) = (asked.node_name.as_str(), asked.kind);
    let session = context.live().zip(node.parse().ok());
    let session = session.and_then(|(live, node)| live.sessions.connection(&node));
    let speaking = session.as_ref().map(|session| &*session.key);
    let candidate = Candidate { node, kind, key: key_of(&certificate)?, shown, speaking };
    let name = enrol::check(&context, &candidate)?;
    let right = right(&context, &asked, &asker.identity, (&candidate.key, name)).await?;
    enrol::enrol(&context, &candidate, right).await?;
    // Whoever spoke for the node until now has to show the key that counts; who renews a certificate goes on meanwhile.
    if right != Right::Renewal
        && let (Some(live), Ok(name)) = (context.live(), asked.node_name.parse())
    {
        live.sessions.kick(&name);
    }
    tracing::info!(node = asked.node_name, kind = ?asked.kind, ?right, "joined");
    let answer = json!({ "certificate": certificate, "ca": context.pki.ca() });
    let mut response = super::json(StatusCode::OK, &answer);
    response.extensions_mut().insert(Named {
        kind: Some("Node".to_owned()),
        name: Some(asked.node_name),
        ..Named::default()
    });
    Ok(response)
}

async fn right(
    context: &Context,
    asked: &Request,
    identity: &Identity,
    (key, name): (&str, Name),
) -> Result<Right, Failure> {
    match (&asked.token, identity) {
        (Some(text), _) => token::spend(context, text, (&asked.node_name, key), name).await,
        (None, Identity::Node { name, .. }) if *name == asked.node_name => Ok(Right::Renewal),
        (None, _) => {
            Err(Failure::unauthorized("a join token is needed, or the node's own certificate"))
        }
    }
}

/// The key of a certificate that was just signed.
fn key_of(certificate: &str) -> Result<String, Failure> {
    let der = CertificateDer::from_pem_slice(certificate.as_bytes());
    match der.as_ref().map(|der| Identity::of(Some(der))) {
        Ok(Identity::Node { key, .. }) => Ok(key),
        _ => Err(Failure::internal("a certificate was signed that is no node's")),
    }
}
