//! What other nodes say of themselves, by their slave API.

use crate::master::{MasterError, unpack};
use crate::xmlrpc::Value;
use crate::xmlrpc::http::{Uri, invoke};

/// A connection of a node's.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Link {
    /// Of an incoming one the publisher's address, of an outgoing one the subscriber's name.
    pub peer: String,
    /// Messages come in by it.
    pub incoming: bool,
    /// The topic.
    pub topic: String,
}

/// The connections of the node at `uri`, asked by the node `caller`.
///
/// # Errors
///
/// It does not answer, or not as a node.
pub async fn links(uri: &Uri, caller: &str) -> Result<Vec<Link>, MasterError> {
    const METHOD: &str = "getBusInfo";
    let answer = invoke(uri, METHOD, &[caller.into()]).await;
    let answer = answer.map_err(|source| MasterError::Call { method: METHOD, source })?;
    unpack(METHOD, &answer, |rows| rows.as_array()?.iter().map(link).collect())
}

fn link(row: &Value) -> Option<Link> {
    let [_, peer, direction, _, topic, ..] = row.as_array()? else { return None };
    Some(Link {
        peer: peer.as_str()?.to_owned(),
        incoming: direction.as_str()? == "i",
        topic: topic.as_str()?.to_owned(),
    })
}
