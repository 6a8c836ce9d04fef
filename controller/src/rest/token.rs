//! Join tokens: what an agent shows once to get its certificate.
//!
//! A token is `muster1.ID.SECRET.CAHASH`. The store keeps the SHA-256 of the secret only; the CA's hash lets the agent
//! know the controller before it trusts anything that it says. Tokens are records of the store that the generic REST
//! does not serve.

use http::StatusCode;
use jiff::{SignedDuration, Timestamp};
use muster_api::secret::same;
use ring::rand::SecureRandom as _;
use serde::{Deserialize, Serialize};
use serde_json::{Value, json};

use super::enrol::{self, Name, Right};
use super::failure::Failure;
use super::path::Verb;
use super::{Answer, Call, body};
use crate::context::Context;
use crate::pki::hex;
use crate::store::{Key, Precondition, Resource, Stored, UpdateError};

const TOKENS: Resource = Resource::new("jointokens");
const PREFIX: &str = "muster1";
/// Long enough to walk to the robot.
const DEFAULT_TTL: i64 = 24 * 3600;
/// A token is a secret in a shell history; a year is already long.
const MAX_TTL: i64 = 365 * 24 * 3600;

/// What a token allows.
#[derive(Debug, Clone, Default, Serialize, Deserialize)]
#[serde(rename_all = "camelCase", deny_unknown_fields)]
pub struct TokenSpec {
    /// How long it holds, s. Default: a day.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub ttl_seconds: Option<i64>,
    /// The only node that may use it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub node_name: Option<String>,
    /// How many times it may be used. Default: as often as one likes.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub uses: Option<u32>,
}

#[derive(Debug, Serialize, Deserialize)]
#[serde(rename_all = "camelCase")]
struct Record {
    metadata: Metadata,
    spec: TokenSpec,
    secret_sha256: String,
    expires: Timestamp,
    used: u32,
    /// The key of the agent that used it last.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    used_by: Option<String>,
}

/// What tokens of both sorts have of an object's metadata.
#[derive(Debug, Serialize, Deserialize)]
#[serde(rename_all = "camelCase")]
pub(super) struct Metadata {
    name: String,
    uid: String,
    creation_timestamp: String,
}

impl Metadata {
    pub(super) fn new(context: &Context, id: &str) -> Self {
        Self {
            name: id.to_owned(),
            uid: uuid::Uuid::new_v4().to_string(),
            creation_timestamp: context.stamp(),
        }
    }

    pub(super) fn public(&self, stored: &Stored) -> Value {
        json!({
            "name": self.name,
            "uid": self.uid,
            "creationTimestamp": self.creation_timestamp,
            "resourceVersion": stored.revision.to_string(),
        })
    }
}

#[derive(Debug, Default, Deserialize)]
#[serde(rename_all = "camelCase", default, deny_unknown_fields)]
struct NewToken {
    /// Clients of Kubernetes send these two; what they say is known from the path.
    #[serde(rename = "apiVersion")]
    _api_version: Option<String>,
    #[serde(rename = "kind")]
    _kind: Option<String>,
    spec: TokenSpec,
}

/// A token that was just made. Its text is not kept.
#[derive(Debug, Clone)]
pub struct NewlyMade {
    /// What the agent is given.
    pub token: String,
    /// Its public name.
    pub id: String,
    /// When it ends.
    pub expires: Timestamp,
}

pub(super) async fn answer(call: Call, verb: Verb, id: Option<String>) -> Answer {
    match (verb, id) {
        (Verb::Create, None) => create(call).await,
        (Verb::List, None) => {
            let items = call.context.store.list(TOKENS, None).items;
            let items: Vec<Value> = items.iter().filter_map(|stored| public(stored)).collect();
            Ok(super::json(
                StatusCode::OK,
                &json!({
                    "kind": "JoinTokenList", "apiVersion": muster_api::API_VERSION,
                    "metadata": {"resourceVersion": call.context.store.revision().to_string()},
                    "items": items,
                }),
            ))
        }
        (Verb::Get, Some(id)) => {
            let stored = call.context.store.get(&Key::cluster(TOKENS, id.as_str()));
            let shown = stored.and_then(|stored| public(&stored)).ok_or_else(|| unknown(&id))?;
            Ok(super::json(StatusCode::OK, &shown))
        }
        (Verb::Delete, Some(id)) => {
            let key = Key::cluster(TOKENS, id.as_str());
            call.context.store.delete(key, Precondition::Any).await.map_err(|_| unknown(&id))?;
            Ok(super::json(
                StatusCode::OK,
                &json!({
                    "kind": "Status", "apiVersion": "v1", "metadata": {}, "status": "Success",
                    "details": {"name": id, "group": muster_api::GROUP, "kind": "jointokens"},
                }),
            ))
        }
        _ => Err(Failure::method(call.request.method())),
    }
}

async fn create(call: Call) -> Answer {
    let Call { context, request, .. } = call;
    let (parts, body) = request.into_parts();
    let new: NewToken = match body::optional_json(&parts.headers, body).await? {
        Value::Null => NewToken::default(),
        body => body::typed("JoinToken", body)?,
    };
    let made = make(&context, new.spec).await?;
    let stored = context.store.get(&Key::cluster(TOKENS, made.id.as_str()));
    let mut shown = stored.and_then(|stored| public(&stored)).unwrap_or_default();
    shown["status"]["token"] = made.token.into();
    Ok(super::json(StatusCode::CREATED, &shown))
}

/// Makes a token. For the `demo` and for tests it is also a way past REST.
///
/// # Errors
/// When the spec makes no sense or the store fails.
pub async fn make(context: &Context, spec: TokenSpec) -> Result<NewlyMade, Failure> {
    let ttl = spec.ttl_seconds.unwrap_or(DEFAULT_TTL);
    if !(1..=MAX_TTL).contains(&ttl) {
        return Err(Failure::bad_request(format!(
            "spec.ttlSeconds: {ttl} is not in 1..={MAX_TTL}"
        )));
    }
    if spec.uses == Some(0) {
        return Err(Failure::bad_request("spec.uses: 0 would be a token for nothing"));
    }
    let expires = context.clock.now() + SignedDuration::from_secs(ttl);
    let (id, secret) = (hex(&random::<5>()?), hex(&random::<32>()?));
    let record = Record {
        metadata: Metadata::new(context, &id),
        spec,
        secret_sha256: hash(&secret),
        expires,
        used: 0,
        used_by: None,
    };
    let value = serde_json::to_value(&record).expect("texts and numbers serialize");
    let key = Key::cluster(TOKENS, id.as_str());
    context
        .store
        .create(key, value)
        .await
        .map_err(|error| Failure::internal(crate::app::chain(&error)))?;
    let token = format!("{PREFIX}.{id}.{secret}.{}", context.pki.ca_hash());
    Ok(NewlyMade { token, id, expires })
}

/// Uses a token for an agent, or says why it does not hold. One that asks again with the same key, because an answer did not
/// reach it, uses it once. `name`: what the node's is to it.
pub(super) async fn spend(
    context: &Context,
    token: &str,
    (node, key): (&str, &str),
    name: Name,
) -> Result<Right, Failure> {
    let parts: Vec<&str> = token.trim().split('.').collect();
    let &[PREFIX, id, secret, ca] = &parts[..] else {
        return Err(refused("it is not a join token"));
    };
    if ca != context.pki.ca_hash() {
        return Err(refused("it was made by another controller"));
    }
    let now = context.clock.now();
    let token = Key::cluster(TOKENS, id);
    let spent = context.store.update(&token, |_, value| {
        let mut record: Record =
            serde_json::from_value(value).map_err(|_| refused("its record is damaged"))?;
        if !same(record.secret_sha256.as_bytes(), hash(secret).as_bytes()) {
            // The same words as for an id that does not exist: ids are not to be probed.
            return Err(refused("it is not known here"));
        }
        if record.expires <= now {
            return Err(refused(&format!("it expired at {}", record.expires)));
        }
        if record.spec.node_name.as_deref().is_some_and(|only| only != node) {
            return Err(refused("it is for another node"));
        }
        if name == Name::Own || record.used_by.as_deref() == Some(key) {
            return Ok(None);
        }
        if record.spec.uses.is_some_and(|uses| record.used >= uses) {
            return Err(refused("it is used up"));
        }
        if name == Name::Taken && record.spec.node_name.is_none() {
            return Err(enrol::taken(node));
        }
        record.used += 1;
        record.used_by = Some(key.to_owned());
        Ok(Some(serde_json::to_value(&record).expect("texts and numbers serialize")))
    });
    match spent.await {
        Ok(stored) => Ok(match stored.value().pointer("/spec/nodeName") {
            Some(_) => Right::ThisNode,
            None => Right::AnyNode,
        }),
        Err(UpdateError::Refused(failure)) => Err(failure),
        Err(UpdateError::Store(crate::store::StoreError::NotFound { .. })) => {
            Err(refused("it is not known here"))
        }
        Err(UpdateError::Store(error)) => Err(Failure::internal(crate::app::chain(&error))),
    }
}

fn refused(why: &str) -> Failure {
    Failure::unauthorized(format!("the join token was refused: {why}"))
}

fn unknown(id: &str) -> Failure {
    let message = format!("jointokens.{} {id:?} not found", muster_api::GROUP);
    Failure::new(StatusCode::NOT_FOUND, "NotFound", message)
}

/// A token as it is shown: without anything that would let somebody in.
fn public(stored: &Stored) -> Option<Value> {
    let record: Record = stored.parse().ok()?;
    Some(json!({
        "kind": "JoinToken",
        "apiVersion": muster_api::API_VERSION,
        "metadata": record.metadata.public(stored),
        "spec": record.spec,
        "status": {"expires": record.expires, "used": record.used},
    }))
}

pub(super) fn hash(secret: &str) -> String {
    hex(ring::digest::digest(&ring::digest::SHA256, secret.as_bytes()).as_ref())
}

pub(super) fn random<const N: usize>() -> Result<[u8; N], Failure> {
    let mut bytes = [0; N];
    ring::rand::SystemRandom::new()
        .fill(&mut bytes)
        .map_err(|_| Failure::internal("the system has no randomness to give"))?;
    Ok(bytes)
}

#[cfg(test)]
pub(super) mod tests {
    use std::sync::{Arc, Mutex};

    use super::*;
    use crate::config::Config;
    use crate::context::Clock;
    use crate::events::Recorder;
    use crate::pki::Pki;

    /// A clock that the test moves.
    #[derive(Debug)]
    pub(in super::super) struct Hand(Mutex<Timestamp>);

    impl Hand {
        pub(in super::super) fn advance(&self, seconds: i64) {
            *self.0.lock().unwrap() += SignedDuration::from_secs(seconds);
        }
    }

    impl Clock for Hand {
        fn now(&self) -> Timestamp {
            *self.0.lock().unwrap()
        }
    }

    pub(in super::super) async fn context(dir: &tempfile::TempDir) -> (Context, Arc<Hand>) {
        let clock = Arc::new(Hand(Mutex::new("2026-11-22T12:00:00Z".parse().unwrap())));
        let pki = Pki::open(dir.path(), clock.now()).unwrap();
        let config = Config {
            data_dir: dir.path().to_owned(),
            listen: "127.0.0.1:0".parse().unwrap(),
            kubeconfig: dir.path().join("kubeconfig"),
            kubeconfig_asked: true,
            advertise: Vec::new(),
            encryption_key: None,
            certificate_ttl: crate::pki::TTL,
            requests_per_second: crate::config::REQUESTS_PER_SECOND,
        };
        let (store, address) = (crate::store::memory::start().await, config.listen);
        let (events, _) = Recorder::new();
        let metrics = crate::metrics::recorder().unwrap();
        let mut context = Context::new(store, pki, config, address, metrics, events);
        context.clock = Arc::clone(&clock) as Arc<dyn Clock>;
        (context, clock)
    }

    #[tokio::test]
    async fn a_token_ends_when_it_says() {
        let dir = tempfile::tempdir().unwrap();
        let (context, clock) = context(&dir).await;
        let spec = TokenSpec { ttl_seconds: Some(60), ..TokenSpec::default() };
        let made = make(&context, spec).await.unwrap();
        spend(&context, &made.token, ("a", "1"), Name::Free).await.unwrap();
        clock.advance(59);
        spend(&context, &made.token, ("b", "2"), Name::Free).await.unwrap();
        clock.advance(1);
        let refused = spend(&context, &made.token, ("c", "3"), Name::Free).await.unwrap_err();
        assert_eq!(refused.code(), 401);
        assert!(refused.message().contains("expired at 2026-11-22T12:01:00Z"), "{refused:?}");
    }

    #[tokio::test(flavor = "multi_thread", worker_threads = 2)]
    async fn a_token_for_one_use_is_used_once_however_many_try() {
        let dir = tempfile::tempdir().unwrap();
        let (context, _) = context(&dir).await;
        let spec = TokenSpec { uses: Some(1), ..TokenSpec::default() };
        let made = make(&context, spec).await.unwrap();
        let tries = (0..8).map(|n| {
            let (context, token, key) = (&context, made.token.as_str(), format!("key {n}"));
            async move { spend(context, token, (&format!("n{n}"), &key), Name::Free).await }
        });
        let outcomes = futures::future::join_all(tries).await;
        let used: Vec<usize> = (0..8).filter(|n| outcomes[*n].is_ok()).collect();
        assert_eq!(used.len(), 1);
        // Who used it, and did not hear so, asks again: it is used once still.
        for n in 0..8 {
            let asks = (&*format!("n{n}"), &*format!("key {n}"));
            let again = spend(&context, &made.token, asks, Name::Free).await;
            assert_eq!(again.is_ok(), used == [n], "{again:?}");
        }
    }

    #[tokio::test]
    async fn specs_that_make_no_sense_are_refused() {
        let dir = tempfile::tempdir().unwrap();
        let (context, _) = context(&dir).await;
        for spec in [
            TokenSpec { ttl_seconds: Some(0), ..TokenSpec::default() },
            TokenSpec { ttl_seconds: Some(MAX_TTL + 1), ..TokenSpec::default() },
            TokenSpec { uses: Some(0), ..TokenSpec::default() },
        ] {
            assert_eq!(make(&context, spec).await.unwrap_err().code(), 400);
        }
    }
}
