//! JSON with its resourceVersion spliced in.
//!
//! The revision is known only to the writer task, and rendering is the expensive part of a write. So callers render
//! everything around the revision on their own threads, and the writer joins three pieces.

use std::collections::BTreeMap;

use bytes::Bytes;
use serde::Serialize;
use serde_json::value::RawValue;
use serde_json::{Map, Value};

use super::Stored;

/// So many lists and objects may lie in each other in an object. serde_json prints any number of them and reads 127 again:
/// what is deeper could be stored, and never be read.
pub const DEEPEST: usize = 100;
/// The largest object, bytes: a body as large as one may be, with what the server adds to it.
pub const LARGEST: usize = 4 << 20;
const TOO_DEEP: &str = "more than 100 lists and objects lie in each other in it";
const TOO_LARGE: &str = "it is larger than 4 MiB";

/// How `metadata` begins, up to the digits of the revision.
const VERSION: &str = "{\"resourceVersion\":\"";

/// An object rendered but for its revision.
#[derive(Debug)]
pub(super) struct Template {
    head: Vec<u8>,
    tail: Vec<u8>,
    pub(super) uid: Box<str>,
}

impl Template {
    /// Renders `value`, leaving out its `metadata.resourceVersion`. What is not an object with `metadata`, or too deep or too
    /// large to be stored, is refused with the reason.
    pub(super) fn new(value: &Value) -> Result<Self, &'static str> {
        if is_deeper(value, DEEPEST) {
            return Err(TOO_DEEP);
        }
        let object = value.as_object().ok_or("it is not a JSON object")?;
        let metadata = object
            .get("metadata")
            .and_then(Value::as_object)
            .ok_or("`metadata` is not a JSON object")?;
        let uid = metadata.get("uid").and_then(Value::as_str).unwrap_or_default().into();

        let rest = |out: &mut Vec<u8>| write_rest(out, metadata);
        Self::render(object.iter().map(|(field, value)| (field.as_str(), value)), rest, uid)
            .limited()
    }

    /// The object as it is stored, with another status. Everything else is copied as text, which costs a
    /// fraction of reading it into a tree and rendering it again. A status that makes it too deep or too large is refused.
    pub(super) fn with_status(stored: &Stored, status: &RawValue) -> Result<Self, &'static str> {
        if depth(status.get()) >= DEEPEST {
            return Err(TOO_DEEP);
        }
        let mut fields = Self::fields(stored);
        fields.insert("status".to_owned(), status);
        Self::copied(stored, &fields).limited()
    }

    /// The object as it is stored, whatever it is: what is there must be possible to remove.
    pub(super) fn again(stored: &Stored) -> Self {
        Self::copied(stored, &Self::fields(stored))
    }

    fn fields(stored: &Stored) -> BTreeMap<String, &RawValue> {
        serde_json::from_slice(&stored.bytes)
            .expect("stored bytes were rendered from a JSON object")
    }

    fn copied(stored: &Stored, fields: &BTreeMap<String, &RawValue>) -> Self {
        let version = format!("{VERSION}{}\"", stored.revision);
        let metadata = fields.get("metadata").and_then(|m| m.get().strip_prefix(&version));
        let metadata = metadata.expect("a template puts the revision first in metadata");
        let rest = |out: &mut Vec<u8>| out.extend_from_slice(metadata.as_bytes());
        Self::render(fields.iter().map(|(f, v)| (f.as_str(), *v)), rest, stored.uid.clone())
    }

    fn limited(self) -> Result<Self, &'static str> {
        if self.len() > LARGEST { Err(TOO_LARGE) } else { Ok(self) }
    }

    /// `rest` writes what follows the revision in `metadata`.
    fn render<'a, T: Serialize + ?Sized + 'a>(
        fields: impl Iterator<Item = (&'a str, &'a T)>,
        rest: impl Fn(&mut Vec<u8>),
        uid: Box<str>,
    ) -> Self {
        let mut head = Vec::with_capacity(256);
        let mut tail = Vec::with_capacity(1024);
        let mut before = true;
        head.push(b'{');
        for (index, (field, value)) in fields.enumerate() {
            let out = if before { &mut head } else { &mut tail };
            if index > 0 {
                out.push(b',');
            }
            write(out, field);
            out.push(b':');
            if field == "metadata" {
                out.extend_from_slice(VERSION.as_bytes());
                before = false;
                tail.push(b'"');
                rest(&mut tail);
            } else {
                write(out, value);
            }
        }
        tail.push(b'}');
        Self { head, tail, uid }
    }

    /// The size of the rendered object, but for the digits of its revision.
    pub(super) fn len(&self) -> usize {
        self.head.len() + self.tail.len()
    }

    /// The object at `revision`.
    pub(super) fn at(&self, revision: u64) -> Bytes {
        let digits = revision.to_string();
        let mut out = Vec::with_capacity(self.len() + digits.len());
        out.extend_from_slice(&self.head);
        out.extend_from_slice(digits.as_bytes());
        out.extend_from_slice(&self.tail);
        Bytes::from(out)
    }
}

fn write_rest(out: &mut Vec<u8>, metadata: &Map<String, Value>) {
    for (field, value) in metadata.iter().filter(|(field, _)| *field != "resourceVersion") {
        out.push(b',');
        write(out, field);
        out.push(b':');
        write(out, value);
    }
    out.push(b'}');
}

fn write<T: Serialize + ?Sized>(out: &mut Vec<u8>, value: &T) {
    serde_json::to_writer(out, value).expect("JSON trees serialize, and a Vec takes every byte");
}

/// Whether more than `limit` lists and objects lie in each other. Looks no deeper than that.
#[must_use]
pub fn is_deeper(value: &Value, limit: usize) -> bool {
    let below = |value: &Value| is_deeper(value, limit - 1);
    match value {
        Value::Array(_) | Value::Object(_) if limit == 0 => true,
        Value::Array(elements) => elements.iter().any(below),
        Value::Object(members) => members.values().any(below),
        _ => false,
    }
}

/// How many lists and objects lie in each other in a JSON text.
fn depth(json: &str) -> usize {
    let (mut now, mut most, mut quoted, mut escaped) = (0_usize, 0, false, false);
    for byte in json.bytes() {
        match byte {
            _ if escaped => escaped = false,
            b'\\' => escaped = quoted,
            b'"' => quoted = !quoted,
            b'{' | b'[' if !quoted => {
                now += 1;
                most = most.max(now);
            }
            b'}' | b']' if !quoted => now = now.saturating_sub(1),
            _ => {}
        }
    }
    most
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::store::{Key, Resource};
    use serde_json::json;

    fn nested(depth: usize) -> Value {
        (0..depth).fold(json!(1), |inner, _| json!({ "a": inner }))
    }

    #[test]
    fn what_could_not_be_read_again_is_not_rendered() {
        let object = |inner: Value| json!({"metadata": {"name": "n"}, "spec": inner});
        let fits = Template::new(&object(nested(DEEPEST - 1))).unwrap();
        assert!(serde_json::from_slice::<Value>(&fits.at(1)).is_ok());
        assert_eq!(Template::new(&object(nested(DEEPEST))).unwrap_err(), TOO_DEEP);
        assert_eq!(Template::new(&object("x".repeat(LARGEST).into())).unwrap_err(), TOO_LARGE);

        let bytes = Template::new(&object(json!({}))).unwrap().at(1);
        let stored = Stored::new(Key::cluster(Resource::new("xs"), "n"), 1, "".into(), bytes);
        let status = |value: Value| {
            let raw = serde_json::value::to_raw_value(&value).unwrap();
            Template::with_status(&stored, &raw).map(|template| template.at(2))
        };
        let fits = status(nested(DEEPEST - 1)).unwrap();
        assert!(serde_json::from_slice::<Value>(&fits).is_ok());
        assert_eq!(status(nested(DEEPEST)).unwrap_err(), TOO_DEEP);
        assert_eq!(status("[".repeat(500).into()).map(drop), Ok(()), "a text is no list");
        assert_eq!(status("x".repeat(LARGEST).into()).unwrap_err(), TOO_LARGE);
        // What an older version stored goes, however deep it is.
        let spec = format!("{}{}", "[".repeat(500), "]".repeat(500));
        let old = format!("{{\"metadata\":{{\"resourceVersion\":\"1\"}},\"spec\":{spec}}}");
        let old = Stored::new(Key::cluster(Resource::new("xs"), "n"), 1, "".into(), old.into());
        assert!(
            Template::again(&old).at(22).starts_with(b"{\"metadata\":{\"resourceVersion\":\"22\"}")
        );
    }

    #[test]
    fn the_revision_replaces_whatever_the_caller_sent() {
        let value = json!({
            "apiVersion": "v1", "kind": "X", "spec": {"a": [1, "é\u{0}"]},
            "metadata": {"name": "n", "resourceVersion": "7", "uid": "u"},
        });
        let template = Template::new(&value).unwrap();
        let bytes = template.at(42);
        let mut expected = value;
        expected["metadata"]["resourceVersion"] = "42".into();
        assert_eq!(serde_json::from_slice::<Value>(&bytes).unwrap(), expected);
        assert_eq!(bytes.len(), bytes.as_ref().len());
        assert_eq!(&*template.uid, "u");
    }

    #[test]
    fn another_status_leaves_everything_else_as_it_is() {
        let value = json!({
            "apiVersion": "v1", "kind": "X", "spec": {"metadata": {"resourceVersion": "7"}, "text": "\"}é\u{0}"},
            "metadata": {"name": "n", "uid": "u", "labels": {"status": "{"}},
        });
        let stored = |value: &Value, revision| {
            let bytes = Template::new(value).unwrap().at(revision);
            Stored::new(Key::cluster(Resource::new("xs"), "n"), revision, "u".into(), bytes)
        };
        for status in [json!({"phase": "Bound"}), json!({}), json!(null)] {
            let raw = serde_json::value::to_raw_value(&status).unwrap();
            let mut expected = value.clone();
            expected["status"] = status;
            let first = Template::with_status(&stored(&value, 7), &raw).unwrap();
            assert_eq!(first.at(8), stored(&expected, 8).bytes);
            let again = Template::with_status(&stored(&expected, 8), &raw).unwrap();
            assert_eq!(again.at(1234), stored(&expected, 1234).bytes);
            assert_eq!(&*again.uid, "u");
        }
    }

    #[test]
    fn only_objects_with_metadata_are_rendered() {
        for bad in [json!([]), json!({}), json!({"metadata": "x"})] {
            assert!(Template::new(&bad).is_err(), "{bad}");
        }
        let empty = Template::new(&json!({"metadata": {}})).unwrap();
        assert_eq!(empty.at(1), &b"{\"metadata\":{\"resourceVersion\":\"1\"}}"[..]);
    }
}
