//! Query parameters, in Kubernetes' names.

use std::collections::HashMap;
use std::str::FromStr;
use std::time::Duration;

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

/// How long a watch lasts that names no time. Clients come back by themselves; connections of clients that are gone without a
/// word do not stay for ever.
const LASTS: Duration = Duration::from_secs(45 * 60);
/// What is longer than a day is meant to be for ever, and may be more than a clock can count.
const LONGEST: Duration = Duration::from_secs(24 * 60 * 60);

/// The parameters of one request.
#[derive(Debug)]
pub(crate) struct Query {
    pairs: Vec<(String, String)>,
    /// Of a parameter that is there several times, the last one.
    last: HashMap<String, String>,
}

impl Query {
    pub(crate) fn read(uri: &Uri) -> Result<Self, Failure> {
        let pairs = axum::extract::Query::<Vec<(String, String)>>::try_from_uri(uri)
            .map_err(|error| Failure::bad_request(format!("unreadable query: {error}")))?;
        let pairs = pairs.0;
        Ok(Self { last: pairs.iter().cloned().collect(), pairs })
    }

    /// A parameter that is there and not empty.
    pub(crate) fn text(&self, name: &str) -> Option<&str> {
        self.last.get(name).map(String::as_str).filter(|value| !value.is_empty())
    }

    /// Every value of a parameter, in order.
    pub(crate) fn all(&self, name: &str) -> Vec<String> {
        self.pairs.iter().filter(|(key, _)| key == name).map(|(_, value)| value.clone()).collect()
    }

    /// A parameter of another type.
    pub(crate) fn parse<T: FromStr>(&self, name: &str) -> Result<Option<T>, Failure> {
        let Some(value) = self.text(name) else { return Ok(None) };
        let parsed = value.parse().map_err(|_| {
            Failure::bad_request(format!("query parameter {name}: {value:?} is not understood"))
        });
        parsed.map(Some)
    }

    /// Whether a parameter is on. As Kubernetes reads it: everything but `false`, in any case, and `0`, also without a value.
    pub(crate) fn flag(&self, name: &str) -> bool {
        let value = self.last.get(name);
        value.is_some_and(|value| !value.eq_ignore_ascii_case("false") && value != "0")
    }

    /// `timeoutSeconds` of what lasts.
    pub(crate) fn lasts(&self) -> Result<Duration, Failure> {
        let seconds = self.parse::<u64>("timeoutSeconds")?.filter(|seconds| *seconds > 0);
        Ok(seconds.map_or(LASTS, Duration::from_secs).min(LONGEST))
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

#[cfg(test)]
mod tests {
    use super::*;

    fn query(text: &str) -> Query {
        Query::read(&format!("/x?{text}").parse().unwrap()).unwrap()
    }

    #[test]
    fn flags_are_read_as_kubernetes_does() {
        for on in
            ["watch=true", "watch=True", "watch=1", "watch=", "watch", "watch=yes", "watch=%74rue"]
        {
            assert!(query(on).flag("watch"), "{on}");
        }
        for off in ["", "watch=false", "watch=False", "watch=FALSE", "watch=0", "other=true"] {
            assert!(!query(off).flag("watch"), "{off}");
        }
    }

    #[test]
    fn nothing_lasts_longer_than_a_day() {
        let lasts = |text: &str| query(text).lasts().map(|lasts| lasts.as_secs()).ok();
        assert_eq!(lasts("timeoutSeconds=7"), Some(7));
        assert_eq!(lasts("timeoutSeconds=18446744073709551615"), Some(86_400));
        assert_eq!(lasts("timeoutSeconds=0"), Some(2_700));
        assert_eq!(lasts(""), Some(2_700));
        assert_eq!(lasts("timeoutSeconds=-1"), None);
    }
}
