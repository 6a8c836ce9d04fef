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
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Form {
    /// As they are.
    Whole,
    /// `PartialObjectMetadata`.
    Metadata,
    /// A `Table`, with as much of each object beside its row.
    Table(Include),
}

/// `includeObject` of a table.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
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
            match (media, of("as"), of("g"), of("v")) {
                ("application/json" | "application/*" | "*/*", None, _, _) => {
                    return Ok(Self::Whole);
                }
                ("application/json", Some("Table"), Some("meta.k8s.io"), Some("v1")) => {
                    return Ok(Self::Table(Include::read(query)?));
                }
                (
                    "application/json",
                    Some("PartialObjectMetadata" | "PartialObjectMetadataList"),
                    Some("meta.k8s.io"),
                    Some("v1"),
                ) => return Ok(Self::Metadata),
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
            Self::Metadata => self.item(entry, stored),
            Self::Table(_) => {
                let mut table = self.head(entry, &stored.revision.to_string(), "").into_bytes();
                table.extend_from_slice(&self.item(entry, stored));
                table.extend_from_slice(self.tail().as_bytes());
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
            Self::Metadata => format!(
                "{{\"kind\":\"PartialObjectMetadataList\",\"apiVersion\":\"meta.k8s.io/v1\",\"metadata\":{metadata},\"items\":["
            ),
            Self::Table(_) => format!(
                "{{\"kind\":\"Table\",\"apiVersion\":\"meta.k8s.io/v1\",\"metadata\":{metadata},\"columnDefinitions\":{},\"rows\":[",
                definitions(entry)
            ),
        }
    }

    /// One object of a list.
    pub(super) fn item(self, entry: &Entry, stored: &Stored) -> Bytes {
        match self {
            Self::Whole => entry.render(stored),
            Self::Metadata => partial(&entry.value(stored)).to_string().into(),
            Self::Table(include) => row(entry, &entry.value(stored), include).to_string().into(),
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

fn partial(object: &Value) -> Value {
    json!({
        "kind": "PartialObjectMetadata", "apiVersion": "meta.k8s.io/v1",
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

fn row(entry: &Entry, object: &Value, include: Include) -> Value {
    let name = is_named(entry.info).then(|| object["metadata"]["name"].clone());
    let cells = columns(entry.info).cells(object, Timestamp::now());
    let cells = cells.iter().map(|cell| Value::from(cell.text()));
    let cells: Vec<Value> = name.into_iter().chain(cells).collect();
    match include {
        Include::None => json!({ "cells": cells }),
        Include::Metadata => json!({ "cells": cells, "object": partial(object) }),
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
        assert_eq!(read(kubectl), Ok(Form::Table(Include::Metadata)));
        assert_eq!(
            read(
                "application/vnd.kubernetes.protobuf;as=PartialObjectMetadataList;g=meta.k8s.io;v=v1,application/json;as=PartialObjectMetadataList;g=meta.k8s.io;v=v1,application/json"
            ),
            Ok(Form::Metadata)
        );
        assert_eq!(read("application/vnd.kubernetes.protobuf,application/json"), Ok(Form::Whole));
        assert_eq!(read("text/html, */*;q=0.1"), Ok(Form::Whole));
        assert_eq!(read("application/vnd.kubernetes.protobuf"), Err(406));
    }
}
