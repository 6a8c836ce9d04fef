//! A kind that has no sheet of its own: its fields.

use jiff::Timestamp;
use k8s_openapi::apimachinery::pkg::apis::meta::v1::ObjectMeta;
use serde_json::Value;

use super::begin;
use crate::output::sheet::Sheet;

pub(super) fn describe(sheet: &mut Sheet, object: &Value, now: Timestamp) {
    let metadata: Option<ObjectMeta> =
        object.get("metadata").and_then(|m| serde_json::from_value(m.clone()).ok());
    begin(sheet, &metadata.unwrap_or_default(), now);
    for (key, value) in object.as_object().into_iter().flatten() {
        if matches!(key.as_str(), "apiVersion" | "kind" | "metadata") {
            continue;
        }
        match value {
            Value::Object(members) if !members.is_empty() => {
                sheet.heading(&title(key));
                for (name, value) in members {
                    sheet.field(&title(name), text(value));
                }
            }
            Value::Object(_) | Value::Null => {}
            scalar => {
                sheet.field(&title(key), text(scalar));
            }
        }
    }
}

/// `lastTimestamp` → `Last timestamp`.
fn title(key: &str) -> String {
    let mut text = String::new();
    for (i, c) in key.chars().enumerate() {
        match c {
            c if i == 0 => text.extend(c.to_uppercase()),
            c if c.is_uppercase() => {
                text.push(' ');
                text.extend(c.to_lowercase());
            }
            c => text.push(c),
        }
    }
    text
}

/// Characters of a value that are shown.
const SHOWN: usize = 400;

fn text(value: &Value) -> String {
    let whole = match value {
        Value::String(text) => text.clone(),
        other => other.to_string(),
    };
    // A site's floor is thousands of them.
    let length = whole.chars().count();
    if length <= SHOWN {
        return whole;
    }
    let shown: String = whole.chars().take(SHOWN / 4).collect();
    format!("{shown}… ({length} characters; `muster get -o yaml` shows all)")
}
