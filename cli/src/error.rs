//! What can go wrong, by class: each class has an exit code, each error a hint where there is a next
//! step. [`CliError::render`] is the one way they are printed.

use std::error::Error;
use std::fmt::Write as _;
use std::io;
use std::path::PathBuf;
use std::time::Duration;

use http::StatusCode;
use kube::core::Status;
use kube::core::response::StatusCause;
use muster_api::manifest::Diagnostic;

use crate::config::ConfigError;
use crate::exit;
use crate::output::human;
use crate::output::style::Styles;

/// Something a command could not do.
#[derive(Debug, thiserror::Error)]
pub(crate) enum CliError {
    /// The command line asks for something that does not exist or does not go together.
    #[error("{message}")]
    Usage { message: String, hint: Option<String> },
    /// No kubeconfig that can be used.
    #[error("cannot tell which controller to ask")]
    Config(#[from] ConfigError),
    /// The controller refused.
    #[error("{}", .0.message)]
    Refused(Box<Refusal>),
    /// Manifests that were refused, by this program or by the controller; every problem at its place.
    #[error("{} in the manifests; nothing was stored", human::count(.0.len(), "problem"))]
    Manifests(Vec<Diagnostic>),
    /// The controller did not answer.
    #[error("cannot reach the controller at {server}")]
    Unreachable { server: String, origin: String, source: Box<dyn Error + Send + Sync> },
    /// The controller answered something that this program does not understand.
    #[error("the answer of {server} to {request} cannot be read")]
    Answer { server: String, request: String, source: serde_json::Error },
    /// What was waited for has not come.
    #[error("timed out after {} while waiting for {what}", human::duration(*.after))]
    Timeout { what: String, after: Duration, hint: Option<String> },
    /// Tasks have ended, so that what is waited for can never come.
    #[error("{what}")]
    Ended { what: String, hint: Option<String> },
    /// What was asked for has not come about and will not.
    #[error("{what}")]
    Failed { what: String, hint: Option<String> },
    /// A file that cannot be read.
    #[error("cannot read {}", path.display())]
    Read { path: PathBuf, source: io::Error },
    /// Standard output is gone for another reason than that its reader left.
    #[error("cannot write to standard output")]
    Output(#[source] io::Error),
    /// Whoever read our output has enough. Not an error for anybody.
    #[error("broken pipe")]
    BrokenPipe,
    /// A daemon run by this program ended with an error.
    #[error("the {name} failed")]
    Daemon { name: &'static str, source: Box<dyn Error + Send + Sync> },
}

/// A refusal of the controller, out of a `metav1.Status`.
#[derive(Debug, Clone)]
pub(crate) struct Refusal {
    /// The class that the HTTP status stands for.
    pub(crate) class: Class,
    /// The reason word, `AlreadyExists`.
    pub(crate) reason: String,
    /// The sentence.
    pub(crate) message: String,
    /// Fields and what is wrong with each.
    pub(crate) causes: Vec<StatusCause>,
    /// The next step.
    pub(crate) hint: Option<String>,
}

/// Classes of errors. Scripts tell them apart by exit code.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Class {
    Failure,
    Usage,
    NotFound,
    Conflict,
    Invalid,
    Unreachable,
    Denied,
    Timeout,
    Ended,
}

impl Class {
    /// The exit code of the class.
    pub(crate) const fn exit(self) -> u8 {
        match self {
            Class::Failure => exit::FAILURE,
            Class::Usage => exit::USAGE,
            Class::NotFound => exit::NOT_FOUND,
            Class::Conflict => exit::CONFLICT,
            Class::Invalid => exit::INVALID,
            Class::Unreachable => exit::UNREACHABLE,
            Class::Denied => exit::DENIED,
            Class::Timeout => exit::TIMEOUT,
            Class::Ended => exit::TASK_ENDED,
        }
    }

    /// The class of an HTTP status that says no.
    pub(crate) fn of_status(code: u16) -> Self {
        match StatusCode::from_u16(code) {
            Ok(StatusCode::NOT_FOUND) => Class::NotFound,
            Ok(StatusCode::CONFLICT | StatusCode::GONE) => Class::Conflict,
            Ok(StatusCode::BAD_REQUEST | StatusCode::UNPROCESSABLE_ENTITY) => Class::Invalid,
            Ok(StatusCode::UNAUTHORIZED | StatusCode::FORBIDDEN) => Class::Denied,
            Ok(StatusCode::REQUEST_TIMEOUT | StatusCode::GATEWAY_TIMEOUT) => Class::Timeout,
            Ok(StatusCode::SERVICE_UNAVAILABLE | StatusCode::BAD_GATEWAY) => Class::Unreachable,
            _ => Class::Failure,
        }
    }
}

impl Refusal {
    /// Reads a Status. `server` and `origin` (the kubeconfig) are named in hints.
    pub(crate) fn of_status(status: Status, server: &str, origin: &str) -> Self {
        let class = Class::of_status(status.code);
        let hint = hint_for(&status, class, server, origin);
        let causes = status.details.map(|d| d.causes).unwrap_or_default();
        Refusal { class, reason: status.reason, message: status.message, causes, hint }
    }
}

fn hint_for(status: &Status, class: Class, server: &str, origin: &str) -> Option<String> {
    let kind = status.details.as_ref().map(|d| d.kind.as_str()).filter(|k| !k.is_empty());
    match (class, kind) {
        (Class::NotFound, Some(kind)) => {
            Some(format!("`muster get {kind}` shows those that exist"))
        }
        (Class::NotFound, None) => Some(format!(
            "is {server} (from {origin}) a muster controller of this version? `muster version` asks it"
        )),
        (Class::Conflict, _) if status.reason == "AlreadyExists" => {
            Some("`muster apply -f` changes what exists already".to_owned())
        }
        (Class::Conflict, _) if status.reason == "Conflict" => {
            Some("somebody changed it meanwhile; run the command again".to_owned())
        }
        (Class::Denied, _) if status.code == StatusCode::UNAUTHORIZED.as_u16() => Some(format!(
            "{origin} holds no credential that {server} accepts; copy the kubeconfig that the controller wrote"
        )),
        (Class::Denied, _) => Some(format!("the credential in {origin} may not do this")),
        (Class::Unreachable, _) => {
            Some("the controller is starting or ending; try again".to_owned())
        }
        _ => None,
    }
}

impl CliError {
    /// A usage error without a hint.
    pub(crate) fn usage(message: impl Into<String>) -> Self {
        CliError::Usage { message: message.into(), hint: None }
    }

    /// The class, for the exit code.
    pub(crate) fn class(&self) -> Class {
        match self {
            CliError::Usage { .. } => Class::Usage,
            CliError::Config(_) | CliError::Unreachable { .. } => Class::Unreachable,
            CliError::Refused(refusal) => refusal.class,
            CliError::Manifests(_) => Class::Invalid,
            CliError::Timeout { .. } => Class::Timeout,
            CliError::Ended { .. } => Class::Ended,
            CliError::Read { source, .. } if source.kind() == io::ErrorKind::NotFound => {
                Class::NotFound
            }
            CliError::Failed { .. }
            | CliError::Answer { .. }
            | CliError::Read { .. }
            | CliError::Output(_)
            | CliError::BrokenPipe
            | CliError::Daemon { .. } => Class::Failure,
        }
    }

    /// The object that was asked for does not exist.
    pub(crate) fn is_not_found(&self) -> bool {
        self.class() == Class::NotFound && matches!(self, CliError::Refused(_))
    }

    /// The next step, where one is known.
    fn hint(&self) -> Option<String> {
        match self {
            CliError::Usage { hint, .. }
            | CliError::Timeout { hint, .. }
            | CliError::Ended { hint, .. }
            | CliError::Failed { hint, .. } => hint.clone(),
            CliError::Config(error) => Some(error.hint()),
            CliError::Refused(refusal) => refusal.hint.clone(),
            CliError::Unreachable { origin, source, .. } => {
                Some(unreachable_hint(origin, &chain(source.as_ref())))
            }
            CliError::Answer { .. } => {
                Some("`muster version` shows whether client and controller fit".to_owned())
            }
            _ => None,
        }
    }

    /// What is printed to standard error, with a newline at its end.
    pub(crate) fn render(&self, styles: &Styles) -> String {
        let mut text = String::new();
        if let CliError::Manifests(diagnostics) = self {
            for diagnostic in diagnostics {
                text.push_str(&human::plain(&diagnostic.to_string()));
                text.push('\n');
            }
        }
        let head = styles.bad.paint("error:");
        // Writing to a String cannot fail, here and below.
        let _ = writeln!(text, "{head} {}", human::lines(&self.to_string()));
        if let CliError::Refused(refusal) = self {
            for cause in refusal.causes.iter().filter(|_| refusal.causes.len() > 1) {
                let _ = writeln!(text, "  {}: {}", cause.field, human::plain(&cause.message));
            }
        }
        let mut next = self.source();
        let mut said = self.to_string();
        while let Some(cause) = next {
            // Errors of libraries often repeat their source in their own text.
            let cause_text = cause.to_string();
            if !said.contains(&cause_text) {
                let _ = writeln!(text, "  caused by: {}", human::plain(&cause_text));
                said = cause_text;
            }
            next = cause.source();
        }
        if let Some(hint) = self.hint() {
            let _ = writeln!(text, "{} {}", styles.dim.paint("hint:"), hint);
        }
        text
    }
}

fn unreachable_hint(origin: &str, chain: &str) -> String {
    if chain.contains("certificate") {
        return format!(
            "{origin} does not trust the certificate of this controller; if it was set up anew, copy its kubeconfig again"
        );
    }
    format!(
        "the address is from {origin}; start a controller with `muster controller`, or name another kubeconfig with --kubeconfig"
    )
}

/// An error and everything that caused it, in one line.
pub(crate) fn chain(error: &(dyn Error + 'static)) -> String {
    let mut text = error.to_string();
    let mut next = error.source();
    while let Some(cause) = next {
        text.push_str(": ");
        text.push_str(&cause.to_string());
        next = cause.source();
    }
    text
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    fn refusal(status: serde_json::Value) -> CliError {
        let status: Status = serde_json::from_value(status).expect("a Status");
        CliError::Refused(Box::new(Refusal::of_status(
            status,
            "https://c:7443",
            "~/.muster/config",
        )))
    }

    #[test]
    fn each_status_has_its_exit_code() {
        for (code, exit) in [
            (400, exit::INVALID),
            (401, exit::DENIED),
            (403, exit::DENIED),
            (404, exit::NOT_FOUND),
            (405, exit::FAILURE),
            (409, exit::CONFLICT),
            (422, exit::INVALID),
            (500, exit::FAILURE),
            (503, exit::UNREACHABLE),
            (504, exit::TIMEOUT),
        ] {
            let error = refusal(json!({"status": "Failure", "code": code, "message": "no"}));
            assert_eq!(error.class().exit(), exit, "{code}");
        }
    }

    #[test]
    fn a_refusal_prints_its_causes_and_the_next_step() {
        let error = refusal(json!({
            "code": 422, "reason": "Invalid", "message": "Task.muster.dev \"t\" is invalid",
            "details": {"kind": "Task", "causes": [
                {"field": "spec.run", "message": "is required"},
                {"field": "spec.priority", "message": "is not a number"},
            ]},
        }));
        assert_eq!(
            error.render(&Styles::default()),
            "error: Task.muster.dev \"t\" is invalid\n  spec.run: is required\n  spec.priority: is not a number\n"
        );
        let error = refusal(json!({
            "code": 404, "reason": "NotFound", "message": "tasks.muster.dev \"t\" not found",
            "details": {"kind": "tasks", "name": "t"},
        }));
        assert_eq!(
            error.render(&Styles::default()),
            "error: tasks.muster.dev \"t\" not found\nhint: `muster get tasks` shows those that exist\n"
        );
    }

    #[test]
    fn an_unreachable_controller_names_server_and_kubeconfig() {
        let error = CliError::Unreachable {
            server: "https://127.0.0.1:1".to_owned(),
            origin: "MUSTER_CONFIG (/x/config)".to_owned(),
            source: Box::new(io::Error::new(
                io::ErrorKind::ConnectionRefused,
                "connection refused",
            )),
        };
        assert_eq!(error.class().exit(), exit::UNREACHABLE);
        assert_eq!(
            error.render(&Styles::default()),
            "error: cannot reach the controller at https://127.0.0.1:1\n  caused by: connection refused\nhint: the address is from MUSTER_CONFIG (/x/config); start a controller with `muster controller`, or name another kubeconfig with --kubeconfig\n"
        );
    }

    #[test]
    fn what_the_server_says_cannot_move_the_cursor() {
        let error = refusal(json!({"code": 500, "message": "a\u{1b}[2Jb\nc"}));
        assert_eq!(error.render(&Styles::default()), "error: a\u{fffd}[2Jb\n  c\n");
    }
}
