//! Every refusal as a `metav1.Status`, with the reasons and causes that clients look at.

use std::time::Duration;

use axum::response::{IntoResponse, Response};
use http::{Method, StatusCode};
use muster_api::validate::Violations;
use muster_controller_core::access::{Action, Denied};
use serde_json::{Value, json};

use super::path::{Object, Verb};
use super::registry::Entry;
use crate::audit::Named;
use crate::store::StoreError;

/// A refusal.
#[derive(Debug, Clone)]
pub struct Failure {
    code: StatusCode,
    reason: &'static str,
    message: String,
    details: Value,
    /// Where a list may go on all the same.
    resume: Option<String>,
    /// What was ended all the same.
    ended: Option<Box<[Named]>>,
}

impl Failure {
    pub(crate) fn new(code: StatusCode, reason: &'static str, message: impl Into<String>) -> Self {
        Self {
            code,
            reason,
            message: message.into(),
            details: Value::Null,
            resume: None,
            ended: None,
        }
    }

    /// The HTTP status.
    #[must_use]
    pub fn code(&self) -> u16 {
        self.code.as_u16()
    }

    /// The word for it.
    pub(crate) fn reason(&self) -> &'static str {
        self.reason
    }

    /// What it says to people.
    #[must_use]
    pub fn message(&self) -> &str {
        &self.message
    }

    /// The causes by field: what is wrong with each.
    #[must_use]
    pub fn causes(&self) -> Vec<(String, String)> {
        let causes = self.details["causes"].as_array().into_iter().flatten();
        let text = |cause: &Value, key: &str| cause[key].as_str().unwrap_or_default().to_owned();
        causes.map(|cause| (text(cause, "field"), text(cause, "message"))).collect()
    }

    pub(crate) fn bad_request(message: impl Into<String>) -> Self {
        Self::new(StatusCode::BAD_REQUEST, "BadRequest", message)
    }

    pub(crate) fn unauthorized(message: impl Into<String>) -> Self {
        Self::new(StatusCode::UNAUTHORIZED, "Unauthorized", message)
    }

    pub(crate) fn denied(message: impl Into<String>) -> Self {
        Self::new(StatusCode::FORBIDDEN, "Forbidden", message)
    }

    /// 403 as Kubernetes words it, and why.
    pub(crate) fn forbidden(who: &str, action: &Action<'_>, denied: &Denied) -> Self {
        let Action { verb, group, resource, subresource, namespace, name } = action;
        let qualified = match group.is_empty() {
            true => (*resource).to_owned(),
            false => format!("{resource}.{group}"),
        };
        let named = name.map(|name| format!(" {name:?}")).unwrap_or_default();
        let part = subresource.map(|part| format!("/{part}")).unwrap_or_default();
        let place = match namespace {
            Some(namespace) => format!("in the namespace {namespace:?}"),
            None => "at the cluster scope".to_owned(),
        };
        let mut failure = Self::denied(format!(
            "{qualified}{named} is forbidden: User {who:?} cannot {} resource \"{resource}{part}\" in API group \
             {group:?} {place}: {denied}",
            verb.as_str()
        ));
        failure.details = json!({"name": name, "group": group, "kind": resource});
        failure
    }

    pub(crate) fn unknown_path(path: &str) -> Self {
        let message = format!("the server could not find {path:?}");
        Self::new(StatusCode::NOT_FOUND, "NotFound", message)
    }

    pub(crate) fn method(method: &Method) -> Self {
        let message = format!("{method} is not served here");
        Self::new(StatusCode::METHOD_NOT_ALLOWED, "MethodNotAllowed", message)
    }

    pub(crate) fn method_not_allowed(verb: Verb, object: &Object) -> Self {
        let (verb, kind) = (verb.as_str(), object.entry.qualified());
        Self::new(
            StatusCode::METHOD_NOT_ALLOWED,
            "MethodNotAllowed",
            format!("{verb} is not supported on {kind}"),
        )
    }

    pub(crate) fn timeout(message: impl Into<String>) -> Self {
        Self::new(StatusCode::GATEWAY_TIMEOUT, "Timeout", message)
    }

    /// What came is more than is taken.
    pub(crate) fn too_large(message: impl Into<String>) -> Self {
        Self::new(StatusCode::PAYLOAD_TOO_LARGE, "RequestEntityTooLarge", message)
    }

    /// More is asked at once than is worked on.
    pub(crate) fn too_many() -> Self {
        let message = "too many requests at once; try again";
        let code = StatusCode::TOO_MANY_REQUESTS;
        Self::new(code, "TooManyRequests", message).retry_after(1)
    }

    /// A user asks more often than they may.
    pub(crate) fn too_often(user: &str, after: Duration) -> Self {
        let message =
            format!("User {user:?} asks too often; try again in {:.1} s", after.as_secs_f64());
        let code = StatusCode::TOO_MANY_REQUESTS;
        let seconds = after.as_secs() + u64::from(after.subsec_nanos() > 0);
        Self::new(code, "TooManyRequests", message).retry_after(seconds)
    }

    pub(crate) fn internal(message: impl Into<String>) -> Self {
        Self::new(StatusCode::INTERNAL_SERVER_ERROR, "InternalError", message)
    }

    pub(crate) fn unavailable(message: impl Into<String>) -> Self {
        let mut failure = Self::new(StatusCode::SERVICE_UNAVAILABLE, "ServiceUnavailable", message);
        failure.details = json!({"retryAfterSeconds": 1});
        failure
    }

    pub(crate) fn not_found(entry: &Entry, name: &str) -> Self {
        let message = format!("{} {name:?} not found", entry.qualified());
        Self::new(StatusCode::NOT_FOUND, "NotFound", message).about(entry, name)
    }

    pub(crate) fn already_exists(entry: &Entry, name: &str) -> Self {
        let message = format!("{} {name:?} already exists", entry.qualified());
        Self::new(StatusCode::CONFLICT, "AlreadyExists", message).about(entry, name)
    }

    pub(crate) fn conflict(entry: &Entry, name: &str, why: impl std::fmt::Display) -> Self {
        let message =
            format!("Operation cannot be fulfilled on {} {name:?}: {why}", entry.qualified());
        Self::new(StatusCode::CONFLICT, "Conflict", message).about(entry, name)
    }

    pub(crate) fn stale(entry: &Entry, name: &str) -> Self {
        let why = "the object has been modified; please apply your changes to the latest version \
                   and try again";
        Self::conflict(entry, name, why)
    }

    /// 410: the history that was asked for is gone.
    pub(crate) fn expired(why: impl std::fmt::Display) -> Self {
        Self::new(StatusCode::GONE, "Expired", why.to_string())
    }

    /// Says with which `continue` the rest of a list can still be had.
    pub(crate) fn resumed_by(self, token: String) -> Self {
        Self { resume: Some(token), ..self }
    }

    /// Says what was ended before something was refused, for the audit log.
    pub(crate) fn having_ended(self, ended: Vec<Named>) -> Self {
        Self { ended: Some(ended.into()), ..self }
    }

    /// What was ended before something was refused.
    pub(crate) fn ended(&self) -> &[Named] {
        self.ended.as_deref().unwrap_or_default()
    }

    /// What Kubernetes says to a revision that it has not reached.
    pub(crate) fn ahead(asked: u64, current: u64) -> Self {
        let message = format!("Too large resource version: {asked}, current: {current}");
        let mut failure = Self::timeout(&message);
        failure.details = json!({
            "retryAfterSeconds": 1,
            "causes": [{"reason": "ResourceVersionTooLarge", "message": "Too large resource version"}],
        });
        failure
    }

    /// 422 with every violation as a cause.
    pub(crate) fn invalid(entry: &Entry, name: &str, violations: &Violations) -> Self {
        let what = format!("{} {name:?}", entry.kind_and_group());
        let mut failure = Self::invalid_body(&what, violations);
        let causes = failure.details["causes"].take();
        failure = failure.about(entry, name);
        failure.details["kind"] = entry.info.kind.into();
        failure.details["causes"] = causes;
        failure
    }

    /// The same for a body that is no object.
    pub(crate) fn invalid_body(what: &str, violations: &Violations) -> Self {
        let mut texts: Vec<String> =
            violations.iter().map(|violation| short(violation.to_string())).collect();
        if violations.is_full() {
            texts.push("and more".to_owned());
        }
        let texts = match &texts[..] {
            [only] => only.clone(),
            several => format!("[{}]", several.join(", ")),
        };
        let message = format!("{what} is invalid: {texts}");
        let causes: Vec<Value> = violations
            .iter()
            .map(|violation| {
                json!({
                    "reason": violation.kind.cause_reason(),
                    "message": short(violation.message()),
                    "field": short(violation.path.clone()),
                })
            })
            .collect();
        let mut failure = Self::new(StatusCode::UNPROCESSABLE_ENTITY, "Invalid", message);
        failure.details = json!({"causes": causes});
        failure
    }

    /// Says which object it is about.
    pub(crate) fn about(mut self, entry: &Entry, name: &str) -> Self {
        self.details = json!({"name": name, "group": entry.info.group, "kind": entry.info.plural});
        self
    }

    /// Adds a cause.
    pub(crate) fn because(mut self, reason: &str, message: &str, field: &str) -> Self {
        if self.details.is_null() {
            self.details = json!({});
        }
        self.details["causes"] = json!([{"reason": reason, "message": message, "field": field}]);
        self
    }

    /// Says all its causes.
    pub(crate) fn with_causes(mut self, causes: Vec<Value>) -> Self {
        if self.details.is_null() {
            self.details = json!({});
        }
        self.details["causes"] = causes.into();
        self
    }

    /// Says when it is worth to ask again.
    pub(crate) fn retry_after(mut self, seconds: u64) -> Self {
        if self.details.is_null() {
            self.details = json!({});
        }
        self.details["retryAfterSeconds"] = seconds.into();
        self
    }

    /// What the store refused, as it concerns an object of `entry`.
    pub(crate) fn of_store(entry: &Entry, name: &str, error: &StoreError) -> Self {
        match error {
            StoreError::AlreadyExists { .. } => Self::already_exists(entry, name),
            StoreError::NotFound { .. } => Self::not_found(entry, name),
            StoreError::Conflict { .. } | StoreError::Moved { .. } => Self::stale(entry, name),
            StoreError::UidMismatch { expected, actual, .. } => Self::conflict(
                entry,
                name,
                format!(
                    "Precondition failed: UID in precondition: {expected}, UID in object meta: {actual}"
                ),
            ),
            StoreError::Malformed { .. } => Self::bad_request(error.to_string()),
            StoreError::Closed => Self::unavailable(error.to_string()),
            StoreError::Storage { .. } => Self::internal(crate::app::chain(error)),
        }
    }

    /// The Status object.
    #[must_use]
    pub fn status(&self) -> Value {
        let mut status = json!({
            "kind": "Status",
            "apiVersion": "v1",
            "metadata": {},
            "status": "Failure",
            "message": self.message,
            "reason": self.reason,
            "code": self.code.as_u16(),
        });
        if let Some(token) = &self.resume {
            status["metadata"]["continue"] = token.as_str().into();
        }
        if !self.details.is_null() {
            status["details"] = self.details.clone();
        }
        status
    }
}

/// Longest text about one field, bytes: what it quotes may be megabytes.
const LONGEST: usize = 1024;

/// A text of a length that people read.
fn short(mut text: String) -> String {
    if text.len() > LONGEST {
        text.truncate(text.floor_char_boundary(LONGEST));
        text.push('…');
    }
    text
}

impl IntoResponse for Failure {
    fn into_response(self) -> Response {
        let mut response = super::json(self.code, &self.status());
        if let Some(seconds) = self.details.get("retryAfterSeconds").and_then(Value::as_u64) {
            response.headers_mut().insert(http::header::RETRY_AFTER, seconds.into());
        }
        if self.code == StatusCode::PAYLOAD_TOO_LARGE {
            // The rest of the body stays unread, so an HTTP/1 connection is of no further use, and its client
            // should not find that out with its next request.
            let close = http::HeaderValue::from_static("close");
            response.headers_mut().insert(http::header::CONNECTION, close);
        }
        response
    }
}
