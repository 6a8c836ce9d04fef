//! JSON with its resourceVersion spliced in.
//!
//! The revision is known only to the writer task, and rendering is the expensive part of a write. So callers render
//! everything around the revision on their own threads, and the writer joins three pieces.

use bytes::Bytes;
use serde_json::{Map, Value};

/// An object rendered but for its revision.
#[derive(Debug)]
pub(super) struct Template {
    head: Vec<u8>,
    tail: Vec<u8>,
    pub(super) uid: Box<str>,
}

impl Template {
    /// Renders `value`, leaving out its `metadata.resourceVersion`.
    pub(super) fn new(value: &Value) -> Result<Self, &'static str> {
        let object = value.as_object().ok_or("it is not a JSON object")?;
        let metadata = object
            .get("metadata")
            .and_then(Value::as_object)
            .ok_or("`metadata` is not a JSON object")?;
        let uid = metadata.get("uid").and_then(Value::as_str).unwrap_or_default().into();

        let mut head = Vec::with_capacity(256);
        let mut tail = Vec::with_capacity(1024);
        let mut before = true;
        head.push(b'{');
        for (index, (field, value)) in object.iter().enumerate() {
            let out = if before { &mut head } else { &mut tail };
            if index > 0 {
                out.push(b',');
            }
            write(out, field);
            out.push(b':');
            if field == "metadata" {
                out.extend_from_slice(b"{\"resourceVersion\":\"");
                before = false;
                tail.push(b'"');
                write_rest(&mut tail, metadata);
            } else {
                write(out, value);
            }
        }
        tail.push(b'}');
        Ok(Self { head, tail, uid })
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

fn write<T: serde::Serialize + ?Sized>(out: &mut Vec<u8>, value: &T) {
    serde_json::to_writer(out, value).expect("JSON trees serialize, and a Vec takes every byte");
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

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
    fn only_objects_with_metadata_are_rendered() {
        for bad in [json!([]), json!({}), json!({"metadata": "x"})] {
            assert!(Template::new(&bad).is_err(), "{bad}");
        }
        let empty = Template::new(&json!({"metadata": {}})).unwrap();
        assert_eq!(empty.at(1), &b"{\"metadata\":{\"resourceVersion\":\"1\"}}"[..]);
    }
}
