//! GET (and POST) …/pods/NAME/exec and …/attach: a program in a task, or what the task writes, over a connection that stops
//! being HTTP.
//!
//! What can be known without asking the task's node is refused as a Status, before the connection changes; the rest comes
//! over the channel for errors, as from a kubelet.
//!
//! | file | is |
//! |---|---|
//! | [`websocket`] | the handshake, and channels in frames: `v5.channel.k8s.io`, `v4.channel.k8s.io` |

mod websocket;

use axum::body::Body;
use axum::response::Response;
use http::{StatusCode, header};
use muster_api::kind::task::Task;
use serde::Deserialize;
use serde_json::{Value, json};

use super::failure::Failure;
use super::path::{Object, Subresource};
use super::query::Query;
use super::{Answer, Call, host, log};
use crate::auth::Identity;
use crate::objects;
use crate::session::execs::{Asked, ExecError, Ready};

/// Who asks for what, for the log and for those who look at the task.
struct Visit {
    who: Identity,
    target: Object,
    task: Task,
    ready: Ready,
    asked: Asked,
}

pub(super) async fn open(call: Call, target: Object) -> Answer {
    let key = target.key()?;
    let asked = read(&call.query, &target)?;
    let stored = call.context.store.get(&key);
    let stored = stored.ok_or_else(|| Failure::not_found(target.entry, &key.name))?;
    let task: Task = objects::read(&stored)
        .ok_or_else(|| Failure::internal(format!("task {} cannot be read", key.name)))?;
    // What a task writes is as much as its log, which may be read.
    if !asked.command.is_empty() {
        host::check_entry(&call.asker, &task)?;
    }
    let Some(live) = call.context.live() else {
        return Err(Failure::unavailable("no agent session service is running"));
    };
    let ready = live.execs.check(&task);
    let ready = ready.map_err(|error| failure(&error).about(target.entry, &key.name))?;
    let visit = Visit { who: call.asker.identity.clone(), target, task, ready, asked };
    websocket::upgrade(call, visit)
}

/// The parameters, in Kubernetes' names and with its defaults.
fn read(query: &Query, target: &Object) -> Result<Asked, Failure> {
    let attach = target.subresource == Some(Subresource::Attach);
    let name = target.name.as_deref().unwrap_or_default();
    log::check_container(query.text("container"), name)?;
    let tty = query.flag("tty");
    let asked = Asked {
        command: if attach { Vec::new() } else { query.all("command") },
        stdin: query.flag("stdin"),
        stdout: query.flag("stdout"),
        // A terminal is one stream.
        stderr: query.flag("stderr") && !tty,
        tty,
    };
    if !attach && asked.command.first().is_none_or(String::is_empty) {
        return Err(Failure::bad_request(
            "you must specify at least one command for the container",
        ));
    }
    if !(asked.stdin || asked.stdout || asked.stderr) {
        return Err(Failure::bad_request("you must specify at least 1 of stdin, stdout, stderr"));
    }
    if attach && (asked.stdin || asked.tty) {
        let why = "a task has no standard input and no terminal; attach without them (no -i, no -t), or exec";
        return Err(Failure::bad_request(why));
    }
    Ok(asked)
}

fn failure(error: &ExecError) -> Failure {
    let text = error.to_string();
    match error {
        ExecError::NotRunning(_) => {
            Failure::bad_request(format!("the task has no program to be run beside: {text}"))
        }
        ExecError::Unsupported(_) => {
            Failure::bad_request(format!("this task cannot be entered: {text}"))
        }
        ExecError::TooMany(_) => {
            Failure::new(StatusCode::TOO_MANY_REQUESTS, "TooManyRequests", text).retry_after(5)
        }
        ExecError::Unreachable(_) => Failure::unavailable(text),
        ExecError::Silent { .. } => Failure::timeout(text),
    }
}

/// How a program ended, as Kubernetes tells it.
fn outcome(end: Option<Result<i32, String>>, node: &str) -> Value {
    match end {
        Some(Ok(0)) => {
            json!({"kind": "Status", "apiVersion": "v1", "metadata": {}, "status": "Success"})
        }
        Some(Ok(code)) => json!({
            "kind": "Status", "apiVersion": "v1", "metadata": {}, "status": "Failure",
            "message": format!("command terminated with non-zero exit code: {code}"),
            "reason": "NonZeroExitCode",
            "details": {"causes": [{"reason": "ExitCode", "message": code.to_string()}]},
            "code": 500,
        }),
        Some(Err(why)) => Failure::internal(why).status(),
        None => Failure::internal(format!("the connection to node {node} broke")).status(),
    }
}

/// Who ran what stands in the log, and under the task.
fn tell(context: &crate::context::Context, visit: &Visit) {
    let Visit { who, task, ready, asked, .. } = visit;
    let who = who.name();
    let attach = asked.command.is_empty();
    tracing::info!(
        target: "audit",
        verb = if attach { "attach" } else { "exec" },
        task = %objects::task_key(task),
        node = %ready.node,
        who,
        command = ?asked.command,
        tty = asked.tty,
        "a client entered a task"
    );
    if let Some(program) = asked.command.first() {
        context.events.task(task, "Exec", format!("{who} runs {program:?} in it"));
    }
}

/// The size of a terminal, as clients say it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "PascalCase")]
struct TerminalSize {
    width: u16,
    height: u16,
}

/// 101: what follows is another protocol.
fn switching(fields: [(header::HeaderName, &str); 4]) -> Result<Response, Failure> {
    let mut response = Response::builder().status(StatusCode::SWITCHING_PROTOCOLS);
    for (name, value) in fields {
        response = response.header(name, value);
    }
    response.body(Body::empty()).map_err(|error| Failure::internal(error.to_string()))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::rest::registry;

    fn asked(attach: bool, query: &str) -> Result<Asked, String> {
        let entry = registry::find("", "pods").unwrap();
        let target = Object {
            entry,
            namespace: Some("a".into()),
            name: Some("t".into()),
            subresource: Some(if attach { Subresource::Attach } else { Subresource::Exec }),
        };
        let query = Query::read(&format!("/x?{query}").parse().unwrap()).unwrap();
        read(&query, &target).map_err(|failure| failure.message().to_owned())
    }

    #[test]
    fn parameters_are_read_as_kubernetes_does() {
        let all = asked(false, "command=sh&command=-c&command=a%20b&stdin=true&stdout=1&stderr");
        let command = ["sh", "-c", "a b"].map(str::to_owned).to_vec();
        assert_eq!(all, Ok(Asked { command, stdin: true, stdout: true, stderr: true, tty: false }));
        let terminal = asked(false, "command=sh&stdout=1&stderr=1&tty=1").unwrap();
        assert!(terminal.tty && !terminal.stderr, "a terminal is one stream");
        let refused = |attach, query: &str| asked(attach, query).unwrap_err();
        assert!(refused(false, "stdout=1").contains("at least one command"));
        assert!(refused(false, "command=sh").contains("at least 1 of"));
        assert!(refused(false, "command=sh&stdout=1&container=x").contains("\"x\" is not valid"));
        assert!(refused(true, "stdout=1&stdin=1").contains("no standard input"));
        assert!(asked(true, "stdout=1&stderr=1&container=task").unwrap().command.is_empty());
    }

    #[test]
    fn ends_are_told_as_kubernetes_does() {
        assert_eq!(outcome(Some(Ok(0)), "n")["status"], "Success");
        let seven = outcome(Some(Ok(7)), "n");
        assert_eq!(seven["reason"], "NonZeroExitCode");
        assert_eq!(seven["details"]["causes"][0], json!({"reason": "ExitCode", "message": "7"}));
        assert_eq!(outcome(Some(Err("no such file".into())), "n")["message"], "no such file");
        assert_eq!(outcome(None, "n")["message"], "the connection to node n broke");
    }
}
