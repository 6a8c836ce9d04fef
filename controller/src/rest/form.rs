//! What a client wants to be sent: whole objects, their metadata, or a table of them.

use axum::response::Response;
use bytes::Bytes;
use http::{HeaderMap, StatusCode, header};
use jiff::Timestamp;
use muster_api::table::{columns, is_named};
use serde_json::{Value, json};

use super::failure::Failure;
use super::query::Query;
use super::registry::Entry;
use crate::store::Stored;

/// The form of an answer.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub(super) enum Form {
    /// As they are.
    Whole,
    /// `PartialObjectMetadata` of this version of `meta.k8s.io`.
    Metadata(&'static str),
    /// A `Table` of this version of `meta.k8s.io`, with as much of each object beside its row.
    Table(Include, &'static str),
}

/// The versions of `meta.k8s.io`, which have the same forms; older tools ask for the second.
const META: [&str; 2] = ["meta.k8s.io/v1", "meta.k8s.io/v1beta1"];

/// `includeObject` of a table.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub(super) enum Include {
    None,
    Metadata,
    Object,
}

impl Form {
    /// The first form of the Accept header that is served.
    pub(super) fn read(headers: &HeaderMap, query: &Query) -> Result<Self, Failure> {
        let accept = headers.get(header::ACCEPT).and_then(|value| value.to_str().ok());
        let Some(accept) = accept.filter(|accept| !accept.trim().is_empty()) else {
            return Ok(Self::Whole);
        };
        for clause in accept.split(',') {
            let mut parts = clause.split(';').map(str::trim);
            let media = parts.next().unwrap_or_default();
            let parameters: Vec<(&str, &str)> =
                parts.filter_map(|part| part.split_once('=')).collect();
            let of = |name: &str| parameters.iter().find(|(n, _)| *n == name).map(|(_, v)| *v);
            let version =
                format!("{}/{}", of("g").unwrap_or_default(), of("v").unwrap_or_default());
            let version = META.into_iter().find(|known| *known == version);
            match (media, of("as"), version) {
                ("application/json" | "application/*" | "*/*", None, _) => {
                    return Ok(Self::Whole);
                }
                ("application/json", Some("Table"), Some(version)) => {
                    return Ok(Self::Table(Include::read(query)?, version));
                }
                (
                    "application/json",
                    Some("PartialObjectMetadata" | "PartialObjectMetadataList"),
                    Some(version),
                ) => return Ok(Self::Metadata(version)),
                _ => {}
            }
        }
        Err(Failure::new(
            StatusCode::NOT_ACCEPTABLE,
            "NotAcceptable",
            "only the following media types are accepted: application/json",
        ))
    }

    /// An object as one answer.
    pub(super) fn answer(self, code: StatusCode, entry: &Entry, stored: &Stored) -> Response {
        super::raw(code, self.object(entry, stored))
    }

    /// An object by itself: what a GET answers and what an event of a watch carries.
    pub(super) fn object(self, entry: &Entry, stored: &Stored) -> Bytes {
        match self {
            Self::Whole => entry.render(stored),
            Self::Metadata(_) => self.item(entry, stored),
            Self::Table(..) => {
                let mut table = self.head(entry, &stored.revision.to_string(), "").into_bytes();
                table.extend_from_slice(&self.item(entry, stored));
                // In a watch it stands in a line of its own.
                table.extend_from_slice(self.tail().trim_end().as_bytes());
                table.into()
            }
        }
    }

    /// How a list begins; `more` is what its metadata has beside the revision.
    pub(super) fn head(self, entry: &Entry, revision: &str, more: &str) -> String {
        let metadata = format!("{{\"resourceVersion\":\"{revision}\"{more}}}");
        match self {
            Self::Whole => format!(
                "{{\"kind\":\"{}List\",\"apiVersion\":\"{}\",\"metadata\":{metadata},\"items\":[",
                entry.info.kind,
                entry.info.api_version()
            ),
            Self::Metadata(version) => format!(
                "{{\"kind\":\"PartialObjectMetadataList\",\"apiVersion\":\"{version}\",\"metadata\":{metadata},\"items\":["
            ),
            Self::Table(_, version) => format!(
                "{{\"kind\":\"Table\",\"apiVersion\":\"{version}\",\"metadata\":{metadata},\"columnDefinitions\":{},\"rows\":[",
                definitions(entry)
            ),
        }
    }

    /// One object of a list.
    pub(super) fn item(self, entry: &Entry, stored: &Stored) -> Bytes {
        match self {
            Self::Whole => entry.render(stored),
            Self::Metadata(version) => partial(&entry.value(stored), version).to_string().into(),
            Self::Table(include, version) => {
                row(entry, &entry.value(stored), (include, version)).to_string().into()
            }
        }
    }

    /// The object of a bookmark: how far a watch has come, and, when it is `initial`, that everything was told that there was.
    pub(super) fn bookmark(self, entry: &Entry, revision: u64, initial: bool) -> Value {
        let mut metadata =
            json!({"resourceVersion": revision.to_string(), "creationTimestamp": null});
        if initial {
            metadata["annotations"] = json!({"k8s.io/initial-events-end": "true"});
        }
        let info = entry.info;
        match self {
            Self::Whole => {
                json!({"kind": info.kind, "apiVersion": info.api_version(), "metadata": metadata})
            }
            // Who asked for metadata reads nothing else.
            Self::Metadata(version) => {
                json!({"kind": "PartialObjectMetadata", "apiVersion": version, "metadata": metadata})
            }
            // A table has no annotations; its row's object has.
            Self::Table(_, version) => {
                let object = json!({"kind": "PartialObjectMetadata", "apiVersion": version, "metadata": metadata});
                let rows =
                    if initial { json!([{"cells": [], "object": object}]) } else { json!([]) };
                json!({
                    "kind": "Table", "apiVersion": version, "columnDefinitions": [], "rows": rows,
                    "metadata": {"resourceVersion": revision.to_string()},
                })
            }
        }
    }

    /// How a list ends.
    pub(super) const fn tail(self) -> &'static str {
        "]}\n"
    }
}

impl Include {
    fn read(query: &Query) -> Result<Self, Failure> {
        match query.text("includeObject") {
            None | Some("Metadata") => Ok(Self::Metadata),
            Some("None") => Ok(Self::None),
            Some("Object") => Ok(Self::Object),
            Some(other) => Err(Failure::bad_request(format!(
                "includeObject: {other:?} is not None, Metadata or Object"
            ))),
        }
    }
}

fn partial(object: &Value, version: &str) -> Value {
    json!({
        "kind": "PartialObjectMetadata", "apiVersion": version,
        "metadata": object["metadata"],
    })
}

fn definitions(entry: &Entry) -> Value {
    let name = json!({
        "name": "Name", "type": "string", "format": "name", "priority": 0,
        "description": "The object's name, unique among those of its kind in its namespace.",
    });
    let columns = columns(entry.info).heads().into_iter().map(|head| {
        json!({
            "name": head.name, "type": "string", "format": "", "priority": i32::from(head.wide),
            "description": "",
        })
    });
    is_named(entry.info).then_some(name).into_iter().chain(columns).collect()
}

fn row(entry: &Entry, object: &Value, (include, version): (Include, &str)) -> Value {
    let name = is_named(entry.info).then(|| object["metadata"]["name"].clone());
    let cells = columns(entry.info).cells(object, Timestamp::now());
    let cells = cells.iter().map(|cell| Value::from(cell.text()));
    let cells: Vec<Value> = name.into_iter().chain(cells).collect();
    match include {
        Include::None => json!({ "cells": cells }),
        Include::Metadata => json!({ "cells": cells, "object": partial(object, version) }),
        Include::Object => json!({ "cells": cells, "object": object }),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn read(accept: &'static str) -> Result<Form, u16> {
        let headers = HeaderMap::from_iter([(header::ACCEPT, accept.parse().unwrap())]);
        let query = Query::read(&"/x".parse().unwrap()).unwrap();
        Form::read(&headers, &query).map_err(|failure| failure.code())
    }

    #[test]
    fn the_first_form_that_is_served_is_sent() {
        let kubectl = "application/json;as=Table;v=v1;g=meta.k8s.io,application/json;as=Table;v=v1beta1;g=meta.k8s.io,application/json";
        assert_eq!(read(kubectl), Ok(Form::Table(Include::Metadata, META[0])));
        let older = "application/json;as=Table;v=v1beta1;g=meta.k8s.io, application/json";
        assert_eq!(read(older), Ok(Form::Table(Include::Metadata, META[1])));
        assert_eq!(
            read(
                "application/vnd.kubernetes.protobuf;as=PartialObjectMetadataList;g=meta.k8s.io;v=v1,application/json;as=PartialObjectMetadataList;g=meta.k8s.io;v=v1,application/json"
            ),
            Ok(Form::Metadata(META[0]))
        );
        assert_eq!(read("application/vnd.kubernetes.protobuf,application/json"), Ok(Form::Whole));
        assert_eq!(read("text/html, */*;q=0.1"), Ok(Form::Whole));
        assert_eq!(read("application/vnd.kubernetes.protobuf"), Err(406));
    }
}
