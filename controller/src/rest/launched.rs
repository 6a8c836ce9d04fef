//! What says that a framework launched a task: a controlling reference to it, the finalizer that waits for its
//! acknowledgement, its label. The controller writes them; what a client makes up would send word to a framework that it has
//! no session of, in any namespace, and let the client's executors speak with it.

use muster_api::kind::framework::{ACKNOWLEDGE_FINALIZER, FRAMEWORK_LABEL};
use muster_api::validate::Violations;
use serde_json::Value;

const SUGGESTION: &str = "leave it out: tasks that a framework launches through its session get it";

/// Refuses what of that a client's object says and the present one, if any, does not. Leaving it out is free.
pub(super) fn check(present: &Value, new: &Value) -> Violations {
    let mut violations = Violations::new();
    let (before, metadata) = (&present["metadata"], &new["metadata"]);
    let list = |value: &Value| value.as_array().cloned().unwrap_or_default();
    let known = list(&before["ownerReferences"]);
    for (i, owner) in list(&metadata["ownerReferences"]).iter().enumerate() {
        if launches(owner) && !known.contains(owner) {
            let reason = "only the controller says that a framework controls an object";
            let at = format!("metadata.ownerReferences[{i}]");
            violations.forbidden(at, reason).suggest(SUGGESTION);
        }
    }
    let known = list(&before["finalizers"]);
    for (i, finalizer) in list(&metadata["finalizers"]).iter().enumerate() {
        if finalizer == ACKNOWLEDGE_FINALIZER && !known.contains(finalizer) {
            let reason = "only the controller makes an object wait for a framework";
            violations.forbidden(format!("metadata.finalizers[{i}]"), reason).suggest(SUGGESTION);
        }
    }
    let label = &metadata["labels"][FRAMEWORK_LABEL];
    if !label.is_null() && *label != before["labels"][FRAMEWORK_LABEL] {
        let reason = "only the controller says which framework launched an object";
        violations
            .forbidden(format!("metadata.labels[{FRAMEWORK_LABEL:?}]"), reason)
            .suggest(SUGGESTION);
    }
    violations
}

/// Of any version: what reads as a framework to anybody is refused.
fn launches(owner: &Value) -> bool {
    owner["kind"] == "Framework"
        && owner["controller"] == true
        && owner["apiVersion"].as_str().is_none_or(|version| version.starts_with(muster_api::GROUP))
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    fn object() -> Value {
        let owner = json!({
            "apiVersion": muster_api::API_VERSION, "kind": "Framework", "name": "f", "uid": "u", "controller": true,
        });
        json!({"metadata": {
            "ownerReferences": [owner], "finalizers": ["example.dev/own", ACKNOWLEDGE_FINALIZER],
            "labels": {FRAMEWORK_LABEL: "f", "app": "x"},
        }})
    }

    #[test]
    fn a_client_does_not_make_up_what_a_framework_launched() {
        let refused = check(&Value::Null, &object());
        let places: Vec<&str> = refused.iter().map(|violation| violation.path.as_str()).collect();
        assert_eq!(
            places,
            [
                "metadata.ownerReferences[0]",
                "metadata.finalizers[1]",
                "metadata.labels[\"muster.dev/framework\"]"
            ]
        );
        assert!(check(&object(), &object()).is_empty(), "what is there stays");
        assert!(check(&object(), &json!({"metadata": {}})).is_empty(), "and may be taken off");
        let mut other = object();
        other["metadata"]["ownerReferences"][0]["uid"] = "other".into();
        other["metadata"]["labels"][FRAMEWORK_LABEL] = "other".into();
        assert_eq!(check(&object(), &other).iter().count(), 2);
    }
}
