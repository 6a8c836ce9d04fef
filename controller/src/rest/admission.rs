//! What is refused before it is stored, and fields that no kind has.

use bytes::Bytes;
use http::HeaderValue;
use muster_api::kind;
use muster_api::validate::{Violation, ViolationKind, Violations};
use serde_json::Value;

use super::failure::Failure;
use super::query::FieldValidation;
use super::registry::Entry;
use crate::store::{DEEPEST, LARGEST, is_deeper};

/// Bytes of all warnings together: as much as Kubernetes sends, and as clients and proxies take of headers.
const WARNINGS: usize = 4 << 10;

/// An object that may be stored, and what the client should hear about it.
#[derive(Debug)]
pub(super) struct Admitted {
    pub(super) object: Value,
    pub(super) warnings: Vec<HeaderValue>,
}

/// Refuses what would be too deep to be read again.
pub(super) fn check_depth(object: &Value) -> Result<(), Failure> {
    match is_deeper(object, DEEPEST) {
        true => Err(Failure::bad_request(format!(
            "more than {DEEPEST} lists and objects lie in each other in the object"
        ))),
        false => Ok(()),
    }
}

/// An object that is only shown as it would be stored; refused where the store would refuse it.
pub(super) fn render(object: &Value) -> Result<Bytes, Failure> {
    check_depth(object)?;
    let text = object.to_string();
    match text.len() > LARGEST {
        true => Err(Failure::bad_request(format!("the object is larger than {LARGEST} bytes"))),
        false => Ok(text.into()),
    }
}

/// Checks that the body is an object of the kind that the path names, and fills in what it leaves out.
pub(super) fn identify(entry: &Entry, object: &mut Value) -> Result<(), Failure> {
    let info = entry.info;
    let Some(fields) = object.as_object_mut() else {
        return Err(Failure::bad_request("the body is not a JSON object"));
    };
    for (field, expected) in [("apiVersion", info.api_version()), ("kind", info.kind.to_owned())] {
        match fields.get(field).and_then(Value::as_str) {
            None | Some("") => {
                fields.insert(field.into(), expected.into());
            }
            Some(found) if found == expected => {}
            Some(found) => {
                return Err(Failure::bad_request(format!(
                    "{field} in the body ({found:?}) does not match the path ({expected:?})"
                )));
            }
        }
    }
    Ok(())
}

/// Checks an object whole; unknown fields are refused or dropped as `mode` says.
pub(super) fn admit(
    entry: &Entry,
    name: &str,
    object: Value,
    mode: FieldValidation,
) -> Result<Admitted, Failure> {
    check_depth(&object)?;
    let violations = match kind::admit(&object) {
        Ok(object) => return Ok(Admitted { object, warnings: Vec::new() }),
        Err(violations) => violations,
    };
    let refused = |violations: &Violations| Failure::invalid(entry, name, violations);
    // Of more than are told nobody can drop every one.
    let droppable = violations.iter().any(is_unknown_field) && !violations.is_full();
    if mode == FieldValidation::Strict || !droppable {
        return Err(refused(&violations));
    }
    let mut object = object;
    let (mut warnings, mut length) = (Vec::new(), 0);
    for unknown in violations.iter().filter(|violation| is_unknown_field(violation)) {
        remove(&mut object, &unknown.path);
        // A text in quotes, in which quotes are escaped.
        let text = format!("299 - {:?}", format!("unknown field {:?}", unknown.path));
        length += text.len();
        if mode == FieldValidation::Warn
            && length <= WARNINGS
            && let Ok(value) = HeaderValue::try_from(text)
        {
            warnings.push(value);
        }
    }
    let object = kind::admit(&object).map_err(|violations| refused(&violations))?;
    Ok(Admitted { object, warnings })
}

fn is_unknown_field(violation: &Violation) -> bool {
    violation.kind == ViolationKind::NotSupported && violation.reason == "is not a field"
}

/// Removes the field at a violation's path: `spec.a[0].b`, `metadata["x y"]`.
fn remove(object: &mut Value, path: &str) {
    let Some(steps) = steps(path) else { return };
    let Some((last, before)) = steps.split_last() else { return };
    let mut place = object;
    for step in before {
        let next = match place {
            Value::Object(fields) => fields.get_mut(step),
            Value::Array(items) => step.parse().ok().and_then(|n: usize| items.get_mut(n)),
            _ => None,
        };
        let Some(next) = next else { return };
        place = next;
    }
    if let Value::Object(fields) = place {
        fields.remove(last);
    }
}

fn steps(path: &str) -> Option<Vec<String>> {
    let mut steps = Vec::new();
    let mut rest = path;
    while !rest.is_empty() {
        rest = rest.strip_prefix('.').unwrap_or(rest);
        if let Some(bracket) = rest.strip_prefix('[') {
            if bracket.starts_with('"') {
                let mut values = serde_json::Deserializer::from_str(bracket).into_iter::<String>();
                steps.push(values.next()?.ok()?);
                rest = bracket.get(values.byte_offset()..)?.strip_prefix(']')?;
            } else {
                let (index, after) = bracket.split_once(']')?;
                steps.push(index.to_owned());
                rest = after;
            }
        } else {
            let end = rest.find(['.', '[']).unwrap_or(rest.len());
            steps.push(rest[..end].to_owned());
            rest = &rest[end..];
        }
    }
    Some(steps)
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    #[test]
    fn a_path_is_followed_to_its_field() {
        let mut object = json!({"a": [{"b": 1, "c": 2}], "x y": {"z.w": 3, "k": 4}});
        remove(&mut object, "a[0].b");
        remove(&mut object, "[\"x y\"][\"z.w\"]");
        remove(&mut object, "a[7].b");
        remove(&mut object, "nowhere.at.all");
        assert_eq!(object, json!({"a": [{"c": 2}], "x y": {"k": 4}}));
    }
}
