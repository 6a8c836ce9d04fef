//! Tokens of users: what a person or a program shows with every request instead of a certificate.
//!
//! A token is `musteru1.ID.SECRET`, sent as `Authorization: Bearer`. The store keeps the SHA-256 of the secret only. What its
//! user may is what Access objects give the user's name and groups; the token itself gives nothing. It ends by itself, or when
//! it is deleted.

use std::time::Duration;

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use http::StatusCode;
use jiff::{SignedDuration, Timestamp};
use muster_api::kind::access::check_subject_name;
use muster_api::secret::same;
use muster_api::validate::{Violations, element_path};
use serde::{Deserialize, Serialize};
use serde_json::{Value, json};

use super::failure::Failure;
use super::path::Verb;
use super::token::{Metadata, hash, random};
use super::{Answer, Call, body};
use crate::audit::Named;
use crate::auth::Identity;
use crate::context::Context;
use crate::pki::hex;
use crate::store::{Key, Op, Precondition, Resource, Stored};

const TOKENS: Resource = Resource::new("usertokens");
const PREFIX: &str = "musteru1";
/// A day's work.
const DEFAULT_TTL: i64 = 8 * 3600;
/// A token is a secret in a file; a year is already long.
const MAX_TTL: i64 = 365 * 24 * 3600;
/// How long a token that has ended is still listed: who finds it refused may look why.
const KEPT: SignedDuration = SignedDuration::from_hours(24 * 7);

/// Whose a token is.
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(rename_all = "camelCase", deny_unknown_fields)]
struct UserTokenSpec {
    /// The user.
    user: String,
    /// The groups that the user is in, by this token.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    groups: Vec<String>,
    /// How long it holds, s. Default: eight hours.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    ttl_seconds: Option<i64>,
}

#[derive(Debug, Serialize, Deserialize)]
#[serde(rename_all = "camelCase")]
struct Record {
    metadata: Metadata,
    spec: UserTokenSpec,
    secret_sha256: String,
    expires: Timestamp,
}

#[derive(Debug, Deserialize)]
#[serde(rename_all = "camelCase", deny_unknown_fields)]
struct NewToken {
    /// Clients of Kubernetes send these two; what they say is known from the path.
    #[serde(rename = "apiVersion", default)]
    _api_version: Option<String>,
    #[serde(rename = "kind", default)]
    _kind: Option<String>,
    spec: UserTokenSpec,
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
                    "kind": "UserTokenList", "apiVersion": muster_api::API_VERSION,
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
            let gone = call.context.store.delete(key, Precondition::Any).await;
            let gone = gone.map_err(|_| unknown(&id))?;
            Ok(super::json(
                StatusCode::OK,
                &json!({
                    "kind": "Status", "apiVersion": "v1", "metadata": {}, "status": "Success",
                    "details": {"name": id, "group": muster_api::GROUP, "kind": "usertokens", "uid": &*gone.uid},
                }),
            ))
        }
        _ => Err(Failure::method(call.request.method())),
    }
}

async fn create(call: Call) -> Answer {
    let Call { context, request, .. } = call;
    let (parts, body) = request.into_parts();
    let new: NewToken = body::typed("UserToken", body::json(&parts.headers, body).await?)?;
    let user = Named {
        kind: Some("User".to_owned()),
        name: Some(new.spec.user.clone()),
        ..Named::default()
    };
    let (token, stored) = make(&context, new.spec).await?;
    let mut shown = public(&stored).unwrap_or_default();
    shown["status"]["token"] = token.into();
    // With this and the controller's address a kubeconfig is whole.
    shown["status"]["certificateAuthorityData"] = STANDARD.encode(context.pki.ca()).into();
    let mut response = super::json(StatusCode::CREATED, &shown);
    response.extensions_mut().insert(user);
    Ok(response)
}

async fn make(
    context: &Context,
    spec: UserTokenSpec,
) -> Result<(String, std::sync::Arc<Stored>), Failure> {
    check(&spec)?;
    let now = context.clock.now();
    let expires = now + SignedDuration::from_secs(spec.ttl_seconds.unwrap_or(DEFAULT_TTL));
    let (id, secret) = (hex(&random::<5>()?), hex(&random::<32>()?));
    let record = Record {
        metadata: Metadata::new(context, &id),
        spec,
        secret_sha256: hash(&secret),
        expires,
    };
    let value = serde_json::to_value(&record).expect("texts and numbers serialize");
    let mut ops = vec![Op::create(Key::cluster(TOKENS, id.as_str()), value)];
    ops.extend(ended(context, now));
    let written = context.store.apply(ops).await;
    let mut written = written.map_err(|error| match crate::objects::is_race(&error) {
        // Another one took the ended ones away.
        true => Failure::unavailable("other tokens were made at the same moment; try again"),
        false => Failure::internal(crate::app::chain(&error)),
    })?;
    Ok((format!("{PREFIX}.{id}.{secret}"), written.swap_remove(0)))
}

/// Takes away the records of tokens that ended long ago.
fn ended(context: &Context, now: Timestamp) -> Vec<Op> {
    let all = context.store.list(TOKENS, None).items;
    let long_ago = all
        .iter()
        .filter(|stored| stored.parse::<Record>().is_ok_and(|record| record.expires + KEPT <= now));
    long_ago.map(|stored| Op::remove(stored.key.clone(), stored.revision)).collect()
}

fn check(spec: &UserTokenSpec) -> Result<(), Failure> {
    let mut violations = Violations::new();
    if let Err(why) = check_subject_name(&spec.user) {
        violations.invalid("spec.user", why).suggest("the name that Access objects give roles to");
    }
    for (i, group) in spec.groups.iter().enumerate() {
        if let Err(why) = check_subject_name(group) {
            violations.invalid(element_path("spec.groups", i), why);
        }
    }
    if let Some(ttl) = spec.ttl_seconds.filter(|ttl| !(1..=MAX_TTL).contains(ttl)) {
        violations.invalid("spec.ttlSeconds", format!("{ttl} is not in 1..={MAX_TTL}"));
    }
    match violations.is_empty() {
        true => Ok(()),
        false => Err(Failure::invalid_body("UserToken", &violations)),
    }
}

/// Who shows this token; or why it does not hold, for who shows it.
pub(crate) fn identity(context: &Context, token: &str) -> Result<Identity, String> {
    let parts: Vec<&str> = token.split('.').collect();
    let &[PREFIX, id, secret] = &parts[..] else {
        return Err("it is no token of a user".to_owned());
    };
    // The same words whether the id is known or not: ids are not to be probed.
    let unknown = || "it is not known here, or was taken back".to_owned();
    let stored = context.store.get(&Key::cluster(TOKENS, id)).ok_or_else(unknown)?;
    let record: Record = stored.parse().map_err(|_| "its record is damaged".to_owned())?;
    if !same(record.secret_sha256.as_bytes(), hash(secret).as_bytes()) {
        return Err(unknown());
    }
    if record.expires <= context.clock.now() {
        return Err(format!("it expired at {}", record.expires));
    }
    let UserTokenSpec { user, groups, .. } = record.spec;
    Ok(Identity::User { name: user, groups, token: Some(id.to_owned()) })
}

/// How long what somebody showed goes on to hold; none: it does not. A certificate does as long as its connection.
pub(crate) fn holds_for(context: &Context, identity: &Identity) -> Option<Duration> {
    let Identity::User { token: Some(id), .. } = identity else { return Some(Duration::MAX) };
    let stored = context.store.get(&Key::cluster(TOKENS, id.as_str()))?;
    let record: Record = stored.parse().ok()?;
    let left = record.expires.duration_since(context.clock.now());
    Duration::try_from(left).ok().filter(|left| !left.is_zero())
}

fn unknown(id: &str) -> Failure {
    let message = format!("usertokens.{} {id:?} not found", muster_api::GROUP);
    Failure::new(StatusCode::NOT_FOUND, "NotFound", message)
}

/// A token as it is shown: without anything that would let somebody in.
fn public(stored: &Stored) -> Option<Value> {
    let record: Record = stored.parse().ok()?;
    Some(json!({
        "kind": "UserToken",
        "apiVersion": muster_api::API_VERSION,
        "metadata": record.metadata.public(stored),
        "spec": record.spec,
        "status": {"expires": record.expires},
    }))
}

#[cfg(test)]
mod tests {
    use super::super::token::tests::context;
    use super::*;

    fn spec(user: &str, ttl: i64) -> UserTokenSpec {
        UserTokenSpec { user: user.to_owned(), groups: vec!["lab".into()], ttl_seconds: Some(ttl) }
    }

    #[tokio::test]
    async fn a_token_is_its_user_until_it_ends_or_is_taken_back() {
        let dir = tempfile::tempdir().unwrap();
        let (context, clock) = context(&dir).await;
        let (token, stored) = make(&context, spec("ada", 60)).await.unwrap();
        let ada = identity(&context, &token).unwrap();
        let id = Some(stored.key.name.to_string());
        assert_eq!(
            ada,
            Identity::User { name: "ada".into(), groups: vec!["lab".into()], token: id.clone() }
        );
        assert_eq!(holds_for(&context, &ada), Some(Duration::from_secs(60)));
        clock.advance(59);
        assert!(identity(&context, &token).is_ok());
        assert_eq!(holds_for(&context, &ada), Some(Duration::from_secs(1)));
        clock.advance(1);
        assert_eq!(holds_for(&context, &ada), None);
        let why = identity(&context, &token).unwrap_err();
        assert_eq!(why, "it expired at 2026-11-22T12:01:00Z");

        let (token, stored) = make(&context, spec("ada", 60)).await.unwrap();
        let again = identity(&context, &token).unwrap();
        assert!(again.is(&ada) && again != ada, "by a newer token");
        context.store.delete(stored.key.clone(), Precondition::Any).await.unwrap();
        assert_eq!(holds_for(&context, &again), None);
        assert!(identity(&context, &token).unwrap_err().contains("taken back"));
        // The first one is still listed, and goes when it has been over for long.
        assert_eq!(context.store.list(TOKENS, None).items.len(), 1);
        clock.advance(8 * 24 * 3600);
        make(&context, spec("bob", 60)).await.unwrap();
        assert_eq!(context.store.list(TOKENS, None).items.len(), 1);
    }

    #[tokio::test]
    async fn what_is_stored_and_listed_does_not_let_anybody_in() {
        let dir = tempfile::tempdir().unwrap();
        let (context, _) = context(&dir).await;
        let (token, stored) = make(&context, spec("ada", 60)).await.unwrap();
        let secret = token.split('.').nth(2).unwrap();
        assert!(!stored.value().to_string().contains(secret));
        let shown = public(&stored).unwrap();
        assert!(!shown.to_string().contains(&hash(secret)), "{shown}");
        let id = token.split('.').nth(1).unwrap();
        let tries = [
            format!("{PREFIX}.{id}.{}", "0".repeat(64)),
            format!("{PREFIX}.ffffffffff.{secret}"),
            format!("{PREFIX}.{id}.{}", hash(secret)),
        ];
        let told: Vec<String> =
            tries.iter().map(|shown| identity(&context, shown).unwrap_err()).collect();
        assert!(told.iter().all(|why| *why == told[0]), "{told:?}");
        assert!(identity(&context, &format!("muster1.{id}.{secret}.x")).is_err());
    }

    #[test]
    fn specs_that_make_no_sense_are_refused_with_their_place() {
        let wrong = UserTokenSpec {
            user: "muster:node:r1".into(),
            groups: vec!["muster:admins".into()],
            ttl_seconds: Some(0),
        };
        let causes = check(&wrong).unwrap_err().causes();
        let fields: Vec<&str> = causes.iter().map(|(field, _)| field.as_str()).collect();
        assert_eq!(fields, ["spec.user", "spec.groups[0]", "spec.ttlSeconds"]);
    }
}
