//! The launches of an Accept → Task objects that only need their node.

use std::collections::BTreeSet;

use muster_api::id::TaskUid;
use muster_api::kind::framework::{ACKNOWLEDGE_FINALIZER, FRAMEWORK_LABEL};
use muster_api::kind::task::Task;
use muster_api::wire::framework::v1 as wire;
use muster_api::wire::framework_session::json_of;
use muster_controller_core::hold::Hold;
use muster_controller_core::offer::OfferId;
use serde_json::{Value, json};

use super::{convert, subscribe};
use crate::auth::Asker;
use crate::context::Context;
use crate::objects::TASKS;
use crate::quota::Pass;
use crate::reconcile::desk::{FrameworkUid, Prepared};
use crate::rest::create;
use crate::rest::failure::Failure;
use crate::rest::host;
use crate::store::{Key, Op};
use crate::{configs, depends};

/// Sorts of what is wrong with a launch, the one that is hardest to change first: the refusal has its reason.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
enum Fault {
    /// The spec is refused.
    Invalid,
    /// The namespace's quota does not leave it.
    Quota,
    /// What it depends on is not there, or not yet: the same launch may pass later.
    Unmet,
}

impl Fault {
    fn reason(self) -> wire::RefusalReason {
        match self {
            Fault::Invalid => wire::RefusalReason::Invalid,
            Fault::Quota => wire::RefusalReason::Quota,
            Fault::Unmet => wire::RefusalReason::Unavailable,
        }
    }
}

/// What is wrong with one launch.
type Wrong = (Fault, Vec<wire::Cause>);

/// Checks everything that can be checked without the ledger; all that is wrong is said at once.
pub(super) fn prepare(
    (context, asker): (&Context, &Asker),
    (framework, uid): (&Key, &FrameworkUid),
    accept: &wire::Accept,
) -> Result<(Vec<Prepared>, Option<Op>), wire::Refusal> {
    let namespace = framework.namespace().unwrap_or_default();
    let guard = match create::namespace_guard(context, TASKS, namespace) {
        Ok(guard) => guard,
        Err(failure) => {
            return Err(convert::invalid(vec![wire::Cause {
                field: "launches".to_owned(),
                message: failure.message().to_owned(),
            }]));
        }
    };
    let (mut prepared, mut causes, mut faults) = (Vec::new(), Vec::new(), BTreeSet::new());
    for (i, launch) in accept.launches.iter().enumerate() {
        let offer = match (launch.offer.as_str(), accept.offers.as_slice()) {
            ("", [only]) => parse(only),
            (named, _) => parse(named),
        };
        let Some(offer) = offer else {
            faults.insert(Fault::Invalid);
            causes.push(wire::Cause {
                field: format!("launches[{i}].offer"),
                message: "names none of the offers that the call accepts".to_owned(),
            });
            continue;
        };
        match task_of((context, asker), (framework, uid), launch) {
            Ok((object, task, pass)) => prepared.push(Prepared {
                key: Key::namespaced(
                    TASKS,
                    namespace,
                    task.metadata.name.as_deref().unwrap_or_default(),
                ),
                uid: TaskUid::new(task.metadata.uid.clone().unwrap_or_default()),
                object,
                spec: task.spec,
                offer,
                _pass: pass,
            }),
            Err((fault, wrong)) => {
                faults.insert(fault);
                causes.extend(wrong.into_iter().map(|cause| wire::Cause {
                    field: format!("launches[{i}].{}", cause.field),
                    message: cause.message,
                }));
            }
        }
    }
    match faults.first() {
        None => Ok((prepared, guard)),
        Some(fault) => Err(convert::because(fault.reason(), causes)),
    }
}

/// The offer of an id; none: it is none's.
pub(super) fn parse(id: &str) -> Option<OfferId> {
    id.parse().ok()
}

fn task_of(
    (context, asker): (&Context, &Asker),
    (framework, uid): (&Key, &FrameworkUid),
    launch: &wire::Launch,
) -> Result<(Value, Task, Option<Pass>), Wrong> {
    let spec = launch.spec.as_ref().map(json_of).unwrap_or_default();
    let mut labels: serde_json::Map<String, Value> =
        launch.labels.iter().map(|(k, v)| (k.clone(), v.as_str().into())).collect();
    labels.insert(FRAMEWORK_LABEL.to_owned(), (&*framework.name).into());
    let mut metadata = json!({
        "namespace": framework.namespace(),
        "labels": labels,
        "annotations": launch.annotations,
        "ownerReferences": [subscribe::owner(framework, uid)],
        "finalizers": [ACKNOWLEDGE_FINALIZER],
    });
    if launch.name.is_empty() {
        metadata["generateName"] = format!("{}-", framework.name).into();
    } else {
        metadata["name"] = launch.name.as_str().into();
    }
    let object = json!({
        "apiVersion": muster_api::API_VERSION, "kind": "Task", "metadata": metadata, "spec": spec,
    });
    let wrong = |field: &str, message: String| {
        (Fault::Invalid, vec![wire::Cause { field: field.to_owned(), message }])
    };
    let object = create::prepare_object(context, TASKS, object)
        .map_err(|failure| (Fault::Invalid, causes_of(&failure)))?;
    let reaches = host::check(asker, &Value::Null, &object);
    if !reaches.is_empty() {
        return Err((Fault::Invalid, convert::causes("", &reaches)));
    }
    let task: Task =
        serde_json::from_value(object.clone()).map_err(|error| wrong("spec", error.to_string()))?;
    let namespace = framework.namespace().unwrap_or_default();
    let mut holds = depends::holds(&context.store, namespace, &task.spec);
    holds.extend(configs::holds(&context.store, namespace, &task.spec));
    if !holds.is_empty() {
        let cause = |hold: &Hold| wire::Cause {
            field: hold.field().to_owned(),
            message: format!("{}: {hold}", hold.reason()),
        };
        return Err((Fault::Unmet, holds.iter().map(cause).collect()));
    }
    if task.spec.placement.node.is_some() {
        return Err(wrong(
            "spec.placement.node",
            "is set by the offer that the launch uses; leave it out".to_owned(),
        ));
    }
    if task.spec.reschedule.is_some() {
        return Err(wrong(
            "spec.reschedule",
            "where a framework's task is tried again is the framework's to decide; leave it out"
                .to_owned(),
        ));
    }
    let pass = create::pass(context, TASKS, &object)
        .map_err(|failure| (Fault::Quota, causes_of(&failure)))?;
    Ok((object, task, pass))
}

fn causes_of(failure: &Failure) -> Vec<wire::Cause> {
    let causes = failure.causes();
    if causes.is_empty() {
        let message = failure.message().to_owned();
        return vec![wire::Cause { field: "spec".to_owned(), message }];
    }
    let cause = |(field, message): (String, String)| wire::Cause {
        field: field.strip_prefix("metadata.").unwrap_or(&field).to_owned(),
        message,
    };
    causes.into_iter().map(cause).collect()
}
