//! A plan's index: a short word that is the same while the plan would do the same.
//!
//! It covers what would be created and changed, and what the scheduler would do about it: which task goes where with which
//! leases, who waits, who is ended for whom, what sets do to their tasks. It leaves out what changes all the time and decides nothing: scores, revisions,
//! the numbers in the sentences of those that wait.

use ring::digest::{SHA256, digest};
use serde_json::{Value, json};

/// Letters of an index: 48 bits, against mistakes and not against malice.
const LENGTH: usize = 12;

/// The index of what the controller answered, with the changes that apply would make. `requests`: the objects and patches
/// that apply would send, whole; what is printed of a Secret hides its values.
pub(super) fn of(answer: &Value, requests: &[&Value]) -> String {
    let parts = json!([
        requests,
        every(&answer["changes"], &["action", "kind", "namespace", "name", "fields"]),
        every(&answer["placements"], &["namespace", "name", "node", "leases"]),
        every(&answer["waits"], &["namespace", "name"]),
        every(&answer["preemptions"], &["namespace", "name", "node", "victims"]),
        every(
            &answer["sets"],
            &["namespace", "name", "begins", "later", "changes", "ends", "held"]
        ),
    ]);
    let digest = digest(&SHA256, parts.to_string().as_bytes());
    let letters = digest.as_ref().iter().map(|byte| format!("{byte:02x}"));
    letters.collect::<String>()[..LENGTH].to_owned()
}

/// These fields of every entry, in an order that does not depend on that of the answer.
fn every(list: &Value, fields: &[&str]) -> Vec<Value> {
    let entries = list.as_array().into_iter().flatten();
    let chosen = |entry: &Value| fields.iter().map(|field| entry[*field].clone()).collect();
    let mut chosen: Vec<Value> = entries.map(chosen).collect();
    chosen.sort_by_cached_key(Value::to_string);
    chosen
}

#[cfg(test)]
mod tests {
    use super::*;

    fn answer() -> Value {
        json!({
            "changes": [
                {"action": "create", "kind": "Task", "namespace": "n", "name": "a", "fields": []},
                {"action": "update", "kind": "Task", "namespace": "n", "name": "b", "fields": [{"path": "spec.priority", "to": 2}]},
            ],
            "placements": [{"namespace": "n", "name": "a", "node": "r1", "score": 1.5, "leases": []}],
            "waits": [{"namespace": "n", "name": "c", "why": [{"node": "r1", "message": "is 21.3 m away"}]}],
            "preemptions": [{"namespace": "n", "name": "d", "node": "r2", "victims": ["n/e"]}],
            "revision": "7",
        })
    }

    #[test]
    fn only_what_would_be_done_counts() {
        let of = |answer: &Value| super::of(answer, &[]);
        let index = of(&answer());
        assert_eq!(index.len(), LENGTH);
        let (one, other) = (json!({"command": ["a"]}), json!({"command": ["b"]}));
        assert_ne!(super::of(&answer(), &[&one]), super::of(&answer(), &[&other]));
        let same: [fn(&mut Value); 4] = [
            |a| a["revision"] = json!("8"),
            |a| a["placements"][0]["score"] = json!(1.6),
            |a| a["waits"][0]["why"][0]["message"] = json!("is 20.9 m away"),
            |a| a["changes"].as_array_mut().expect("a list").reverse(),
        ];
        for (i, change) in same.iter().enumerate() {
            let mut other = answer();
            change(&mut other);
            assert_eq!(of(&other), index, "{i}");
        }
        let different: [fn(&mut Value); 5] = [
            |a| a["placements"][0]["node"] = json!("r2"),
            |a| a["changes"][1]["fields"][0]["to"] = json!(3),
            |a| a["waits"] = json!([]),
            |a| a["preemptions"][0]["victims"] = json!(["n/e", "n/f"]),
            |a| a["placements"][0]["leases"] = json!([{"group": "body", "epoch": 2}]),
        ];
        for (i, change) in different.iter().enumerate() {
            let mut other = answer();
            change(&mut other);
            assert_ne!(of(&other), index, "{i}");
        }
    }
}
