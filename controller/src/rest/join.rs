//! POST …/join: a token, or the node's present certificate, against a new certificate.
//!
//! The Node is created when it is missing, so that an agent needs nothing but its token.

use http::StatusCode;
use muster_api::name::check_name;
use serde::Deserialize;
use serde_json::json;

use super::failure::Failure;
use super::{Answer, Call, body, create, token};
use crate::auth::Identity;
use crate::context::Context;
use crate::store::{Key, Resource};

const NODES: Resource = Resource::new("nodes");

#[derive(Debug, Deserialize)]
#[serde(rename_all = "camelCase", deny_unknown_fields)]
struct Request {
    /// Left out by an agent that renews its certificate.
    #[serde(default)]
    token: Option<String>,
    node_name: String,
    /// `Robot` or `Cloud`.
    kind: String,
    /// PKCS #10, PEM.
    csr: String,
}

pub(super) async fn join(call: Call) -> Answer {
    let Call { context, request, identity, .. } = call;
    let (parts, body) = request.into_parts();
    let body = body::json(&parts.headers, body).await?;
    let asked: Request = serde_json::from_value(body)
        .map_err(|error| Failure::bad_request(format!("JoinRequest: {error}")))?;
    if let Err(error) = check_name(&asked.node_name) {
        return Err(Failure::bad_request(format!("nodeName: {error}")));
    }
    if !matches!(asked.kind.as_str(), "Robot" | "Cloud") {
        return Err(Failure::bad_request(format!("kind: {:?} is not Robot or Cloud", asked.kind)));
    }
    // Before the token is spent: a request that cannot be signed must not use it up.
    let certificate = context
        .pki
        .sign_node(&asked.node_name, &asked.csr, context.clock.now())
        .map_err(|error| Failure::bad_request(format!("csr: {}", crate::app::chain(&error))))?;
    check_kind(&context, &asked)?;
    match (&asked.token, &identity) {
        (Some(text), _) => token::spend(&context, text, &asked.node_name).await?,
        (None, Identity::Node { name }) if *name == asked.node_name => {}
        (None, _) => {
            return Err(Failure::unauthorized(
                "a join token is needed, or the node's own certificate",
            ));
        }
    }
    ensure_node(&context, &asked).await?;
    tracing::info!(node = asked.node_name, kind = asked.kind, "joined");
    Ok(super::json(
        StatusCode::OK,
        &json!({
            "certificate": certificate,
            "ca": context.pki.ca(),
        }),
    ))
}

/// A robot does not become a server because somebody mistyped a name.
fn check_kind(context: &Context, asked: &Request) -> Result<(), Failure> {
    let Some(node) = context.store.get(&Key::cluster(NODES, asked.node_name.as_str())) else {
        return Ok(());
    };
    let value = node.value();
    match value["spec"]["kind"].as_str() {
        Some(is) if is != asked.kind => {
            let name = &asked.node_name;
            let message = format!("node {name:?} is registered as {is}, not as {}", asked.kind);
            Err(Failure::new(StatusCode::CONFLICT, "Conflict", message))
        }
        _ => Ok(()),
    }
}

async fn ensure_node(context: &Context, asked: &Request) -> Result<(), Failure> {
    if context.store.get(&Key::cluster(NODES, asked.node_name.as_str())).is_some() {
        return Ok(());
    }
    let object = json!({
        "apiVersion": muster_api::API_VERSION,
        "kind": "Node",
        "metadata": {"name": asked.node_name},
        "spec": {"kind": asked.kind},
    });
    match create::create_object(context, NODES, object).await {
        Ok(_) => Ok(()),
        // Somebody registered it in between.
        Err(failure) if failure.code() == 409 => check_kind(context, asked),
        Err(failure) => Err(failure),
    }
}
