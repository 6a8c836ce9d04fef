//! Query parameters, in Kubernetes' names.

use std::collections::HashMap;
use std::str::FromStr;

use http::Uri;

use super::failure::Failure;

/// What to do with fields that a kind does not have.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum FieldValidation {
    /// Refuse the object. What happens unless the client says otherwise: a misspelt field is a lost intention.
    Strict,
    /// Drop them and say so in a header.
    Warn,
    /// Drop them.
    Ignore,
}

/// The parameters of one request.
#[derive(Debug)]
pub(crate) struct Query(HashMap<String, String>);

impl Query {
    pub(crate) fn read(uri: &Uri) -> Result<Self, Failure> {
        let pairs = axum::extract::Query::<Vec<(String, String)>>::try_from_uri(uri)
            .map_err(|error| Failure::bad_request(format!("unreadable query: {error}")))?;
        Ok(Self(pairs.0.into_iter().collect()))
    }

    /// A parameter that is there and not empty.
    pub(crate) fn text(&self, name: &str) -> Option<&str> {
        self.0.get(name).map(String::as_str).filter(|value| !value.is_empty())
    }

    /// A parameter of another type.
    pub(crate) fn parse<T: FromStr>(&self, name: &str) -> Result<Option<T>, Failure> {
        let Some(value) = self.text(name) else { return Ok(None) };
        let parsed = value.parse().map_err(|_| {
            Failure::bad_request(format!("query parameter {name}: {value:?} is not understood"))
        });
        parsed.map(Some)
    }

    /// A parameter that is on when it is there without a value.
    pub(crate) fn flag(&self, name: &str) -> Result<bool, Failure> {
        match self.0.get(name).map(String::as_str) {
            None | Some("false" | "0") => Ok(false),
            Some("true" | "1" | "") => Ok(true),
            Some(other) => Err(Failure::bad_request(format!(
                "query parameter {name}: {other:?} is not true or false"
            ))),
        }
    }

    pub(crate) fn dry_run(&self) -> Result<bool, Failure> {
        match self.text("dryRun") {
            None => Ok(false),
            Some("All") => Ok(true),
            Some(other) => Err(Failure::bad_request(format!("dryRun: {other:?} is not All"))),
        }
    }

    pub(crate) fn field_validation(&self) -> Result<FieldValidation, Failure> {
        match self.text("fieldValidation") {
            None | Some("Strict") => Ok(FieldValidation::Strict),
            Some("Warn") => Ok(FieldValidation::Warn),
            Some("Ignore") => Ok(FieldValidation::Ignore),
            Some(other) => Err(Failure::bad_request(format!(
                "fieldValidation: {other:?} is not Strict, Warn or Ignore"
            ))),
        }
    }

    /// `resourceVersion`: `None` when it is not there, `Some(0)` for "any".
    pub(crate) fn revision(&self) -> Result<Option<u64>, Failure> {
        self.parse("resourceVersion")
    }
}
