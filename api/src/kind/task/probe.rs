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

/// A check that is made again and again while the task runs: exactly one of `exec`, `http`, `tcp` and `topic`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
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
    /// A ROS 1 topic that is published often enough, as the node sees it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub topic: Option<TopicCheck>,
    /// How long after the start of an attempt the first check is made.
    #[serde(default)]
    pub initial_delay: Span,
    /// From one check to the next.
    #[serde(default = "default_period")]
    pub period: Span,
    /// After how long a check that has no answer has failed. A topic's answers at once, but for the first, which takes as
    /// long as `topic.within` when too little comes.
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

/// Messages of a ROS 1 topic, of whatever type, counted by the node's agent as they arrive there.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "camelCase", deny_unknown_fields)]
pub struct TopicCheck {
    /// Its name. One that does not begin with a slash is in `ROS_NAMESPACE` of the task's environment, or else in the
    /// agent's `--ros-namespace`.
    pub name: String,
    /// Messages a second at least, by the node's clock.
    pub min_hz: f64,
    /// Over how long they are counted.
    #[serde(default = "default_within")]
    pub within: Span,
    /// The ROS master, `http://HOST:PORT`. None: `ROS_MASTER_URI` of the task's environment, or else the agent's.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub master: Option<String>,
}

/// Of a topic that says no other time.
fn default_within() -> Span {
    Span::from_secs(2)
}

/// A robot's agent counts for no longer than anybody waits for a readiness.
const MAX_WITHIN: Span = Span::from_secs(600);
/// No topic is published so often.
const MAX_HZ: f64 = 10_000.0;

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
        ("topic", probe.topic.is_some()),
    ]
    .into_iter()
    .filter_map(|(name, given)| given.then_some(name))
    .collect();
    match given.as_slice() {
        [] => {
            violations.required(path).suggest("give `exec`, `http`, `tcp` or `topic`");
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
    if let Some(topic) = &probe.topic {
        topic_rules(topic, &format!("{path}.topic"), violations);
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

/// Whether this is a global or relative name of ROS.
pub(super) fn is_topic(name: &str) -> bool {
    let part = |part: &str| {
        let mut letters = part.chars();
        letters.next().is_some_and(|first| first.is_ascii_alphabetic() || first == '_')
            && letters.all(|c| c.is_ascii_alphanumeric() || c == '_')
    };
    name.strip_prefix('/').unwrap_or(name).split('/').all(part)
}

fn topic_rules(topic: &TopicCheck, path: &str, violations: &mut Violations) {
    let name = &topic.name;
    if !is_topic(name) {
        let private = name.starts_with('~');
        let reason = format!("{name:?} is not the name of a ROS topic");
        violations.invalid(format!("{path}.name"), reason).suggest(if private {
            "write the node's name before it: /node/topic; here nobody knows which node is meant"
        } else {
            "letters, digits, _ and /, as in /scan or front/scan"
        });
    }
    let within = topic.within.as_duration().as_secs_f64();
    if !(topic.min_hz > 0.0 && topic.min_hz <= MAX_HZ) {
        violations
            .invalid(format!("{path}.minHz"), format!("{} is not a rate in Hz", topic.min_hz))
            .suggest("messages a second, more than 0; try 5, somewhat below what is published");
    } else if topic.within > MAX_WITHIN {
        violations
            .invalid(
                format!("{path}.within"),
                format!("{} is more than {MAX_WITHIN}", topic.within),
            )
            .suggest("leave it out for 2s");
    } else if topic.min_hz * within < 1.0 {
        let reason = format!("{} has no room for a message at {} Hz", topic.within, topic.min_hz);
        let seconds = (2.0 / topic.min_hz).ceil();
        violations.invalid(format!("{path}.within"), reason).suggest(format!("try \"{seconds}s\""));
    }
    if let Some(master) = topic.master.as_deref().filter(|master| !is_master(master)) {
        violations
            .invalid(
                format!("{path}.master"),
                format!("{master:?} is not the address of a ROS master"),
            )
            .suggest("http://HOST:PORT, as in ROS_MASTER_URI; for example http://localhost:11311");
    }
}

pub(super) fn is_master(text: &str) -> bool {
    let rest = text.strip_prefix("http://").map(|rest| rest.strip_suffix('/').unwrap_or(rest));
    let parts = rest.and_then(|rest| rest.rsplit_once(':'));
    parts.is_some_and(|(host, port)| {
        let good = |c: char| c.is_ascii_alphanumeric() || "-._[]:".contains(c);
        !host.is_empty() && host.chars().all(good) && port.parse::<u16>().is_ok_and(|p| p > 0)
    })
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
