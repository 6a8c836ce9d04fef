//! POST …/transaction: objects of one `muster apply --check-index`, all of them in one commit or none.
//!
//! ```text
//!   {"revision": R, "requests": [{"create": …}, {"patch": …}, {"check": …}]}
//!     ──▶ what each would be alone ──▶ refusals │ one transaction: Still(R), then every object
//! ```
//!
//! A plan was made as of a revision; the store's writer lets the transaction pass only while nothing that a plan looks at
//! was written after it. So what is stored is what the plan was about, whoever writes at the same moment.

use std::collections::{BTreeMap, BTreeSet};

use http::StatusCode;
use muster_api::kind::namespace::DEFAULT;
use serde::Deserialize;
use serde_json::{Value, json};

use super::create::{self, With};
use super::failure::Failure;
use super::patch::{self, Change};
use super::path::{Object, Verb};
use super::registry::{self, Entry, View};
use super::update::{self, Options};
use super::{Answer, Call, body};
use crate::auth::{self, Asker};
use crate::context::Context;
use crate::objects::{self, LEASES, NODES, QUOTAS, SITES, TASKS};
use crate::quota::Pass;
use crate::store::{Op, Resource};

/// Whose objects a plan looks at: a change of any of them may be another plan.
const LOOKED_AT: &[Resource] = &[
    NODES,
    LEASES,
    TASKS,
    QUOTAS,
    SITES,
    Resource::new("configmaps"),
    Resource::new("secrets"),
    Resource::new("namespaces"),
];

/// What is asked for.
#[derive(Debug, Deserialize)]
struct Body {
    /// That of the plan.
    revision: String,
    requests: Vec<Request>,
}

/// One object.
#[derive(Debug, Deserialize)]
#[serde(rename_all = "camelCase")]
enum Request {
    /// It is not there yet.
    Create(Value),
    /// It is there, as `metadata.resourceVersion` of the patch says.
    Patch(Patch),
    /// It stays as it is.
    Check(Check),
}

#[derive(Debug, Deserialize)]
#[serde(rename_all = "camelCase")]
struct Named {
    api_version: String,
    kind: String,
    #[serde(default)]
    namespace: Option<String>,
    name: String,
}

#[derive(Debug, Deserialize)]
struct Patch {
    of: Named,
    /// A JSON merge patch.
    patch: Value,
}

#[derive(Debug, Deserialize)]
#[serde(rename_all = "camelCase")]
struct Check {
    of: Named,
    resource_version: String,
}

/// What became of one request.
enum Done {
    /// The operation of this place in the transaction writes it.
    Written,
    /// It is so already.
    As(Value),
}

pub(super) async fn transaction(call: Call) -> Answer {
    let options = Options::of_call(&call)?;
    if options.dry {
        return Err(Failure::bad_request(
            "a transaction has no dry run; each of its objects has one",
        ));
    }
    let Call { context, request, asker, .. } = call;
    let (parts, body) = request.into_parts();
    let body = body::json(&parts.headers, body).await?;
    let body: Body = serde_json::from_value(body)
        .map_err(|error| Failure::bad_request(format!("the body is no transaction: {error}")))?;
    let revision: u64 = body
        .revision
        .parse()
        .map_err(|_| Failure::bad_request(format!("revision {:?} is no number", body.revision)))?;
    body::check_count(body.requests.len())?;
    let mut work = Work::new((&context, &asker), options, revision, &body.requests);
    let refusals = work.take_all(&body.requests);
    if !refusals.is_empty() {
        let told = |(index, failure): (usize, Failure)| json!({ "index": index, "status": failure.status() });
        let refusals: Vec<Value> = refusals.into_iter().map(told).collect();
        return Ok(super::json(StatusCode::OK, &json!({ "refusals": refusals })));
    }
    let Work { ops, done, passes, .. } = work;
    let written = context.store.apply(ops).await;
    drop(passes);
    let written = written.map_err(|error| match objects::is_race(&error) {
        true => Failure::new(
            StatusCode::CONFLICT,
            "Conflict",
            format!("the cluster has moved on: {error}"),
        ),
        false => Failure::internal(crate::app::chain(&error)),
    })?;
    let mut written = written.iter().map(|stored| stored.value());
    let objects: Vec<Value> = done
        .into_iter()
        .map(|done| match done {
            Done::Written => written.next().unwrap_or_default(),
            Done::As(object) => object,
        })
        .collect();
    Ok(super::json(StatusCode::OK, &json!({ "objects": objects })))
}

struct Work<'a> {
    context: &'a Context,
    /// Who has to be allowed each of the requests.
    asker: &'a Asker,
    options: Options,
    /// What the requests create, each as it was sent.
    created: Vec<Value>,
    /// Namespaces among them.
    namespaces: BTreeSet<String>,
    ops: Vec<Op>,
    done: Vec<Done>,
    /// Kept until the commit.
    passes: Vec<Pass>,
}

impl<'a> Work<'a> {
    fn new(
        (context, asker): (&'a Context, &'a Asker),
        options: Options,
        revision: u64,
        requests: &[Request],
    ) -> Self {
        let created = |request: &Request| match request {
            Request::Create(object) => Some(object.clone()),
            Request::Patch(_) | Request::Check(_) => None,
        };
        let created: Vec<Value> = requests.iter().filter_map(created).collect();
        let namespaces = created.iter().filter(|object| object["kind"] == "Namespace");
        let name = |object: &Value| object["metadata"]["name"].as_str().map(str::to_owned);
        Work {
            context,
            asker,
            options,
            namespaces: namespaces.filter_map(name).collect(),
            created,
            // First: what the transaction itself writes is no reason against it.
            ops: vec![Op::Still { revision, of: LOOKED_AT }],
            done: Vec::new(),
            passes: Vec::new(),
        }
    }

    /// Takes every request; those that are refused, by their place.
    fn take_all(&mut self, requests: &[Request]) -> BTreeMap<usize, Failure> {
        let mut refusals = BTreeMap::new();
        for (index, request) in requests.iter().enumerate() {
            if let Err(failure) = self.take(request) {
                refusals.insert(index, failure);
            }
        }
        let created = requests.iter().enumerate();
        let created = created.filter(|(_, request)| matches!(request, Request::Create(_)));
        let places: Vec<usize> = created.map(|(index, _)| index).collect();
        for (n, failure) in create::judge(self.context, With { objects: &self.created }) {
            refusals.entry(places[n]).or_insert(failure);
        }
        refusals
    }

    fn take(&mut self, request: &Request) -> Result<(), Failure> {
        let done = match request {
            Request::Create(object) => self.create(object)?,
            Request::Patch(patch) => self.patch(patch)?,
            Request::Check(check) => self.check(check)?,
        };
        self.done.push(done);
        Ok(())
    }

    fn create(&mut self, object: &Value) -> Result<Done, Failure> {
        let text = |pointer: &str| object.pointer(pointer).and_then(Value::as_str);
        let named = Named {
            api_version: text("/apiVersion").unwrap_or_default().to_owned(),
            kind: text("/kind").unwrap_or_default().to_owned(),
            namespace: text("/metadata/namespace").map(str::to_owned),
            name: text("/metadata/name").unwrap_or_default().to_owned(),
        };
        let target = self.target(&named, Verb::Create)?;
        let (entry, namespace) = (target.entry, target.namespace.as_deref());
        let (by, with) = ((self.context, self.asker), With { objects: &self.created });
        let object = create::prepare_with(by, entry, namespace, object.clone(), with)?;
        let made_here = namespace.is_some_and(|namespace| self.namespaces.contains(namespace));
        if let Some(namespace) = namespace.filter(|_| !made_here) {
            self.ops.extend(create::namespace_guard(self.context, entry.resource, namespace)?);
        }
        self.passes.extend(create::pass_with(self.context, entry.resource, &object, with)?);
        let name = object["metadata"]["name"].as_str().unwrap_or_default();
        let key = entry.key(namespace, name);
        self.ops.push(Op::create(key, object));
        Ok(Done::Written)
    }

    fn patch(&mut self, patch: &Patch) -> Result<Done, Failure> {
        let target = self.target(&patch.of, Verb::Patch)?;
        if patch.patch.pointer("/metadata/resourceVersion").is_none_or(|v| !v.is_string()) {
            return Err(Failure::bad_request("the patch must say of which resourceVersion it is"));
        }
        let key = target.key()?;
        let (entry, name) = (target.entry, &*key.name);
        let present =
            self.context.store.get(&key).ok_or_else(|| Failure::not_found(entry, name))?;
        let change = Change::Merge(patch.patch.clone());
        let make = |present: &Value| patch::apply(&change, present);
        let object = update::becomes(&target, &present, &self.options, make)?;
        match update::operation(&present, &object) {
            Some(op) => {
                self.ops.push(op);
                Ok(Done::Written)
            }
            None => {
                self.ops.push(objects::unchanged(&present));
                Ok(Done::As(present.value()))
            }
        }
    }

    /// The object of a request, when its kind takes the verb and the client may.
    fn target(&self, named: &Named, verb: Verb) -> Result<Object, Failure> {
        let target = target(named, verb)?;
        self.asker.needs(&auth::of_object(verb, &target))?;
        Ok(target)
    }

    fn check(&mut self, check: &Check) -> Result<Done, Failure> {
        let target = self.target(&check.of, Verb::Get)?;
        let key = target.key()?;
        let present = self.context.store.get(&key);
        let same = present.filter(|p| p.revision.to_string() == check.resource_version);
        let present = same.ok_or_else(|| Failure::stale(target.entry, &key.name))?;
        self.ops.push(objects::unchanged(&present));
        Ok(Done::As(present.value()))
    }
}

/// The object of a request, when its kind takes the verb.
fn target(named: &Named, verb: Verb) -> Result<Object, Failure> {
    let Named { api_version, kind, namespace, name } = named;
    let info = muster_api::kind::find(api_version, kind)
        .ok_or_else(|| Failure::bad_request(format!("{api_version} {kind} is not served")))?;
    let entry: &'static Entry = registry::find(info.group, info.plural)
        .filter(|entry| entry.view == View::Stored)
        .ok_or_else(|| Failure::bad_request(format!("{kind} objects are not stored")))?;
    let namespace =
        info.namespaced.then(|| namespace.clone().unwrap_or_else(|| DEFAULT.to_owned()));
    let target = Object { entry, namespace, name: Some(name.clone()), subresource: None };
    match target.allows(verb) {
        true => Ok(target),
        false => Err(Failure::method_not_allowed(verb, &target)),
    }
}
