//! Probes: what is looked at to tell whether a running task has started, can serve, and is alive.
//!
//! The semantics are Kubernetes'. A start-up probe holds the other two back until it has succeeded once; a liveness
//! or start-up probe that fails ends the attempt, which counts as a failure for `restartPolicy`; a readiness probe
//! only says whether the task is Ready.

use std::net::{IpAddr, Ipv4Addr};

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::TaskSpec;
use crate::duration::Span;
use crate::validate::{Violations, element_path};

/// A check that is made again and again while the task runs: exactly one of `exec`, `http` and `tcp`.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "camelCase", deny_unknown_fields)]
pub struct Probe {
    /// A program inside the task; it succeeds when it returns 0.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub exec: Option<ExecCheck>,
    /// A GET in the task's network; it succeeds when the status is 200 to 399.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub http: Option<HttpCheck>,
    /// A connection in the task's network; it succeeds when it is accepted.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub tcp: Option<TcpCheck>,
    /// How long after the start of an attempt the first check is made.
    #[serde(default)]
    pub initial_delay: Span,
    /// From one check to the next.
    #[serde(default = "default_period")]
    pub period: Span,
    /// After how long a check that has no answer has failed.
    #[serde(default = "default_timeout")]
    pub timeout: Span,
    /// Successes in a row until it has succeeded; other than 1 for readiness only.
    #[serde(default = "default_success_threshold")]
    pub success_threshold: u32,
    /// Failures in a row until it has failed.
    #[serde(default = "default_failure_threshold")]
    pub failure_threshold: u32,
}

/// A program inside the task: in its control group and with its user, directory and environment; of a container, inside
/// the container.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "camelCase", deny_unknown_fields)]
pub struct ExecCheck {
    /// The program and its arguments; passed as they are, without a shell.
    pub command: Vec<String>,
}

/// A GET in the task's network.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "camelCase", deny_unknown_fields)]
pub struct HttpCheck {
    /// Path and query.
    #[serde(default = "default_path")]
    pub path: String,
    /// The port.
    pub port: u16,
    /// An IP address, or `localhost`; none: 127.0.0.1 in the task's own network.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub host: Option<String>,
    /// How it is spoken.
    #[serde(default)]
    pub scheme: Scheme,
    /// Headers to send; `Host` replaces the one that follows from the address.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub headers: Vec<HttpHeader>,
}

/// How a check over HTTP is spoken.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub enum Scheme {
    /// In the clear.
    #[default]
    #[serde(rename = "HTTP")]
    Http,
    /// Over TLS 1.3; whatever certificate is shown is taken.
    #[serde(rename = "HTTPS")]
    Https,
}

/// A header of a check over HTTP.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "camelCase", deny_unknown_fields)]
pub struct HttpHeader {
    /// Name.
    pub name: String,
    /// Value.
    #[serde(default)]
    pub value: String,
}

/// A connection in the task's network.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "camelCase", deny_unknown_fields)]
pub struct TcpCheck {
    /// The port.
    pub port: u16,
    /// An IP address, or `localhost`; none: 127.0.0.1 in the task's own network.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub host: Option<String>,
}

fn default_period() -> Span {
    Span::from_secs(10)
}

fn default_timeout() -> Span {
    Span::from_secs(1)
}

fn default_success_threshold() -> u32 {
    1
}

fn default_failure_threshold() -> u32 {
    3
}

fn default_path() -> String {
    "/".to_owned()
}

/// Checks in quicker succession cost a robot more than they tell.
const MIN_PERIOD: Span = Span::from_millis(100);

/// The address that a check's `host` means; none: it is neither an address nor `localhost`.
#[must_use]
pub fn address(host: Option<&str>) -> Option<IpAddr> {
    match host {
        None | Some("localhost") => Some(Ipv4Addr::LOCALHOST.into()),
        Some(text) => text.parse().ok(),
    }
}

/// The rules of the three probes of a task.
pub(super) fn rules(spec: &TaskSpec, violations: &mut Violations) {
    for (field, probe) in
        [("readiness", &spec.readiness), ("liveness", &spec.liveness), ("startup", &spec.startup)]
    {
        let Some(probe) = probe else { continue };
        let path = format!("spec.{field}");
        if spec.run.executor.is_some() {
            violations
                .forbidden(&path, "an executor's work has no processes of its own to look at")
                .suggest("leave it out; the executor itself says how its works are");
            continue;
        }
        check_rules(probe, &path, violations);
        timing_rules(probe, &path, field == "readiness", violations);
    }
}

fn check_rules(probe: &Probe, path: &str, violations: &mut Violations) {
    let given: Vec<&str> = [
        ("exec", probe.exec.is_some()),
        ("http", probe.http.is_some()),
        ("tcp", probe.tcp.is_some()),
    ]
    .into_iter()
    .filter_map(|(name, given)| given.then_some(name))
    .collect();
    match given.as_slice() {
        [] => {
            violations.required(path).suggest("give `exec`, `http` or `tcp`");
        }
        [_] => {}
        [first, second, ..] => {
            violations
                .forbidden(path, format!("has both `{first}` and `{second}`"))
                .suggest("keep one of them");
        }
    }
    if let Some(exec) = &probe.exec
        && exec.command.first().is_none_or(String::is_empty)
    {
        violations
            .required(format!("{path}.exec.command"))
            .suggest("for example [\"test\", \"-e\", \"ready\"]");
    }
    if let Some(http) = &probe.http {
        http_rules(http, &format!("{path}.http"), violations);
    }
    if let Some(tcp) = &probe.tcp {
        address_rules(tcp.port, tcp.host.as_deref(), &format!("{path}.tcp"), violations);
    }
}

fn http_rules(http: &HttpCheck, path: &str, violations: &mut Violations) {
    address_rules(http.port, http.host.as_deref(), path, violations);
    let place = format!("{path}.path");
    if !http.path.starts_with('/') {
        violations
            .invalid(place, format!("{:?} is not an absolute path", http.path))
            .suggest("begin it with '/'");
    } else if !http.path.bytes().all(|b| b.is_ascii_graphic()) {
        violations
            .invalid(place, format!("{:?} is not the path of a URL", http.path))
            .suggest("write what is not ASCII, and spaces, as %20 and the like");
    }
    for (i, header) in http.headers.iter().enumerate() {
        let path = element_path(&format!("{path}.headers"), i);
        let token = |b: u8| b.is_ascii_alphanumeric() || b"!#$%&'*+-.^_`|~".contains(&b);
        if header.name.is_empty() || !header.name.bytes().all(token) {
            let reason = format!("{:?} is not the name of a header", header.name);
            violations.invalid(format!("{path}.name"), reason);
        }
        if !header.value.bytes().all(|b| b == b' ' || b == b'\t' || b.is_ascii_graphic()) {
            let reason = format!("{:?} is not the value of a header", header.value);
            violations.invalid(format!("{path}.value"), reason);
        }
    }
}

fn address_rules(port: u16, host: Option<&str>, path: &str, violations: &mut Violations) {
    if port == 0 {
        violations
            .invalid(format!("{path}.port"), "0 is not a port")
            .suggest("a number from 1 to 65535");
    }
    if address(host).is_none() {
        let host = host.unwrap_or_default();
        violations
            .invalid(format!("{path}.host"), format!("{host:?} is not an IP address"))
            .suggest("leave it out for 127.0.0.1 in the task's own network; a name goes into the header Host");
    }
}

fn timing_rules(probe: &Probe, path: &str, readiness: bool, violations: &mut Violations) {
    if probe.period < MIN_PERIOD {
        violations
            .invalid(
                format!("{path}.period"),
                format!("{} is less than the shortest allowed, {MIN_PERIOD}", probe.period),
            )
            .suggest("leave it out for 10s");
    }
    if probe.timeout == Span::default() {
        violations
            .invalid(format!("{path}.timeout"), "0s lets no check succeed")
            .suggest("leave it out for 1s");
    }
    let place = format!("{path}.successThreshold");
    if probe.success_threshold == 0 {
        violations.invalid(place, "0 is less than the smallest allowed, 1");
    } else if probe.success_threshold > 1 && !readiness {
        violations
            .invalid(place, "only readiness can ask for more than one success")
            .suggest("leave it out");
    }
    if probe.failure_threshold == 0 {
        violations
            .invalid(format!("{path}.failureThreshold"), "0 is less than the smallest allowed, 1");
    }
}
