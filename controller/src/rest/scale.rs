//! …/tasksets/NAME/scale: how many tasks a set has, as `autoscaling/v1` Scale. `kubectl scale` and autoscalers know
//! nothing else of a kind.

use axum::body::Body;
use http::StatusCode;
use http_body_util::BodyExt as _;
use muster_api::validate::Violations;
use serde_json::{Value, json};

use super::path::{Object, Verb};
use super::update::{self, Options};
use super::{Answer, Call, body, failure::Failure, patch};

pub(super) async fn answer(call: Call, verb: Verb, target: Object) -> Answer {
    let key = target.key()?;
    if verb == Verb::Get {
        let stored = call.context.store.get(&key);
        let stored = stored.ok_or_else(|| Failure::not_found(target.entry, &key.name))?;
        return Ok(super::json(StatusCode::OK, &scale_of(&stored.value())));
    }
    let options = Options::read(&call, &target)?;
    let Call { context, request, .. } = call;
    let set = Object { subresource: None, ..target };
    let changed = if verb == Verb::Patch {
        let patch = patch::of_request(request, false).await?;
        let make = |present: &Value| {
            let scale = patch::apply(&patch, &scale_of(present))?;
            with_replicas(&set, present, &scale)
        };
        update::change(&context, &set, &options, make).await?
    } else {
        let (parts, body) = request.into_parts();
        let scale = body::json(&parts.headers, body).await?;
        let make = |present: &Value| with_replicas(&set, present, &scale);
        update::change(&context, &set, &options, make).await?
    };
    let object = read(changed.into_body()).await?;
    Ok(super::json(StatusCode::OK, &scale_of(&object)))
}

pub(super) async fn read(body: Body) -> Result<Value, Failure> {
    let whole = body.collect().await;
    let bytes = whole.map_err(|error| Failure::internal(error.to_string()))?.to_bytes();
    body::parse(&bytes)
}

/// A set as what the scale subresource shows of it.
fn scale_of(set: &Value) -> Value {
    let metadata = &set["metadata"];
    let kept = ["name", "namespace", "uid", "resourceVersion", "creationTimestamp"];
    let kept = kept.iter().filter_map(|f| Some(((*f).to_owned(), metadata.get(*f)?.clone())));
    let number = |pointer: &str| set.pointer(pointer).and_then(Value::as_u64).unwrap_or(0);
    json!({
        "apiVersion": "autoscaling/v1",
        "kind": "Scale",
        "metadata": kept.collect::<serde_json::Map<_, _>>(),
        "spec": {"replicas": number("/spec/replicas")},
        "status": {
            "replicas": number("/status/replicas"),
            "selector": set.pointer("/status/selector").and_then(Value::as_str).unwrap_or_default(),
        },
    })
}

/// The set with the number that a Scale asks for. Clients written in Go leave out a 0.
fn with_replicas(target: &Object, present: &Value, scale: &Value) -> Result<Value, Failure> {
    let name = target.name.as_deref().unwrap_or_default();
    let mut violations = Violations::new();
    let asked = scale.pointer("/spec/replicas").filter(|r| !r.is_null());
    let replicas = match asked.map(|r| (r, r.as_u64())) {
        None => 0,
        Some((_, Some(replicas))) => replicas,
        Some((other, None)) => {
            violations.invalid("spec.replicas", format!("{other} is not a number of tasks"));
            0
        }
    };
    if present.pointer("/spec/everyNode") == Some(&Value::Bool(true)) {
        violations
            .forbidden("spec.replicas", "the set has a task on every node that matches")
            .suggest("labels of nodes and the template's placement say on how many");
    }
    if !violations.is_empty() {
        return Err(Failure::invalid(target.entry, name, &violations));
    }
    let mut set = present.clone();
    set["spec"]["replicas"] = replicas.into();
    // The version that the client names is held against the object; none: the newest is meant.
    set["metadata"]["resourceVersion"] = scale["metadata"]["resourceVersion"].clone();
    Ok(set)
}
