//! A task that is tried on another node is another object under the same name. Who follows a task follows that one.

use std::collections::BTreeMap;

use muster_api::kind::task::{EarlierTry, Outlook, Task};
use serde_json::Value;

/// Whether a task, as it was seen last, is about to be tried again under another uid.
pub(crate) fn is_tried_again(object: &Value) -> bool {
    object["kind"] == "Task"
        && serde_json::from_value::<Task>(object.clone())
            .is_ok_and(|task| matches!(task.outlook(), Outlook::Again { .. }))
}

/// The uids that a task had on the nodes before.
fn uids_before(object: &Value) -> Vec<String> {
    let earlier = object.pointer("/status/earlier").cloned().unwrap_or_default();
    let earlier: Vec<EarlierTry> = serde_json::from_value(earlier).unwrap_or_default();
    earlier.into_iter().map(|one| one.uid).collect()
}

/// The uid of an object if it is among those that are followed, by uid; one that came in the place of such a one is
/// followed from now on. Gives the uid that it had in `followed` before as well, when that was another.
pub(crate) fn claim<T>(
    followed: &mut BTreeMap<String, T>,
    object: &Value,
) -> Option<(String, Option<String>)> {
    let uid = object.pointer("/metadata/uid").and_then(Value::as_str)?.to_owned();
    if followed.contains_key(&uid) {
        return Some((uid, None));
    }
    let before = uids_before(object).into_iter().find(|before| followed.contains_key(before))?;
    let row = followed.remove(&before)?;
    followed.insert(uid.clone(), row);
    Some((uid, Some(before)))
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    #[test]
    fn a_task_is_followed_to_its_next_uid_and_a_stranger_is_not() {
        let object = |uid: &str, earlier: &[&str]| {
            let earlier: Vec<Value> = earlier.iter().map(|uid| json!({"uid": uid})).collect();
            json!({"kind": "Task", "metadata": {"uid": uid}, "status": {"earlier": earlier}})
        };
        let mut followed = BTreeMap::from([("a".to_owned(), 1)]);
        assert_eq!(claim(&mut followed, &object("a", &[])), Some(("a".to_owned(), None)));
        assert_eq!(claim(&mut followed, &object("x", &["y"])), None);
        let (uid, before) = claim(&mut followed, &object("c", &["a", "b"])).expect("it follows a");
        assert_eq!((uid.as_str(), before.as_deref()), ("c", Some("a")));
        assert_eq!(followed, BTreeMap::from([("c".to_owned(), 1)]));
    }
}
