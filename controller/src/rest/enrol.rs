//! Which agent speaks for a node.
//!
//! A Node's status has the keys of its agent's certificate. A session needs the Node and one of these
//! keys: so a deleted Node takes its agent's credential with it, one that was registered anew does not
//! admit the agent of before, and an agent that joins in another's place locks that out.

use http::StatusCode;
use muster_api::kind::node::{Node, NodeKind};
use serde_json::json;

use super::create;
use super::failure::Failure;
use crate::context::Context;
use crate::objects::{self, NODES, node_key};

/// Who asks to speak for a node.
pub(super) struct Candidate<'a> {
    pub(super) node: &'a str,
    pub(super) kind: NodeKind,
    /// Of the certificate that it will have.
    pub(super) key: String,
    /// Of the one that it shows, if it is a node's.
    pub(super) shown: Option<&'a str>,
    /// Of the one by which the present session of the node's began.
    pub(super) speaking: Option<&'a str>,
}

/// By what right somebody becomes a node's agent.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Right {
    /// A token for any node: for names that nobody has joined under.
    AnyNode,
    /// A token for this node: also in the place of the agent that it had.
    ThisNode,
    /// Its present certificate.
    Renewal,
}

/// Whether this is a key of the node's agent.
pub(crate) fn is_agent_of(node: &Node, key: &str) -> bool {
    node.status.as_ref().is_some_and(|status| status.agent_keys.iter().any(|one| one == key))
}

/// What the name of a node is to a candidate.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Name {
    /// No agent has joined as this node.
    Free,
    /// Another one has.
    Taken,
    /// It has itself, by this key: the answer did not reach it.
    Own,
}

fn name_for(node: &Node, key: &str) -> Name {
    match has_joined(node) {
        _ if is_agent_of(node, key) => Name::Own,
        true => Name::Taken,
        false => Name::Free,
    }
}

/// Whether an agent has joined as this node.
fn has_joined(node: &Node) -> bool {
    node.status.as_ref().is_some_and(|status| !status.agent_keys.is_empty())
}

/// 409 for a name that is taken.
pub(super) fn taken(node: &str) -> Failure {
    let message = format!(
        "{node} has joined already; a replacement needs a token made for it: muster token create --node {node}"
    );
    Failure::new(StatusCode::CONFLICT, "Conflict", message)
}

/// What [`enrol`] would refuse, before a token is spent on it.
pub(super) fn check(context: &Context, candidate: &Candidate<'_>) -> Result<Name, Failure> {
    let stored = context.store.get(&node_key(candidate.node));
    let Some(node) = stored.and_then(|stored| objects::read::<Node>(&stored)) else {
        return Ok(Name::Free);
    };
    check_kind(&node, candidate)?;
    Ok(name_for(&node, &candidate.key))
}

/// A robot does not become a server because somebody mistyped a name.
fn check_kind(node: &Node, candidate: &Candidate<'_>) -> Result<(), Failure> {
    let (name, is, says) = (candidate.node, node.spec.kind, candidate.kind);
    if is == says {
        return Ok(());
    }
    let message = format!("node {name:?} is registered as {is:?}, not as {says:?}");
    Err(Failure::new(StatusCode::CONFLICT, "Conflict", message))
}

/// Writes into the Node, which is made when it is missing, that the candidate is its agent.
pub(super) async fn enrol(
    context: &Context,
    candidate: &Candidate<'_>,
    right: Right,
) -> Result<(), Failure> {
    let name = candidate.node;
    loop {
        let Some(stored) = context.store.get(&node_key(name)) else {
            if right == Right::Renewal {
                let message = format!("there is no node {name:?} any more; a join token is needed");
                return Err(Failure::unauthorized(message));
            }
            match create::create_object(context, NODES, new_node(candidate)).await {
                Ok(_) => continue,
                // Somebody registered it in between.
                Err(failure) if failure.code() == 409 => continue,
                Err(failure) => return Err(failure),
            }
        };
        let mut node: Node = objects::read(&stored)
            .ok_or_else(|| Failure::internal(format!("node {name:?} does not read as one")))?;
        check_kind(&node, candidate)?;
        if right == Right::AnyNode && name_for(&node, &candidate.key) == Name::Taken {
            return Err(taken(name));
        }
        if right == Right::Renewal && !candidate.shown.is_some_and(|key| is_agent_of(&node, key)) {
            let message = format!(
                "the certificate is not that of node {name:?}'s agent any more; a join token is needed"
            );
            return Err(Failure::unauthorized(message));
        }
        let keys = &mut node.status.get_or_insert_default().agent_keys;
        // The answer to a renewal may get lost, and then the certificate that was shown is all there is; a session goes on by
        // that of its beginning.
        let stays = [candidate.shown, candidate.speaking];
        keys.retain(|key| right == Right::Renewal && stays.contains(&Some(key.as_str())));
        keys.insert(0, candidate.key.clone());
        match context.store.apply_one(objects::replace(&stored, &node)).await {
            Ok(_) => return Ok(()),
            Err(error) if objects::is_race(&error) => tokio::task::yield_now().await,
            Err(error) => return Err(Failure::internal(crate::app::chain(&error))),
        }
    }
}

fn new_node(candidate: &Candidate<'_>) -> serde_json::Value {
    json!({
        "apiVersion": muster_api::API_VERSION,
        "kind": "Node",
        "metadata": {"name": candidate.node},
        "spec": {"kind": candidate.kind},
    })
}
