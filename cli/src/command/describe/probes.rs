//! A task's probes, and what each says now.

use muster_api::kind::task::probe::{Probe, Scheme, address};
use muster_api::kind::task::{LIVENESS_FAILED, STARTING_UP, STARTUP_FAILED, TaskSpec, TaskStatus};
use muster_api::phase::TaskPhase;

use super::task::command_line;
use crate::output::sheet::Sheet;

pub(super) fn describe(sheet: &mut Sheet, spec: &TaskSpec, status: &TaskStatus) {
    let all = [
        ("Start-up", &spec.startup, start_up(status)),
        ("Readiness", &spec.readiness, readiness(spec, status)),
        ("Liveness", &spec.liveness, liveness(spec, status)),
    ];
    if all.iter().all(|(_, probe, _)| probe.is_none()) {
        return;
    }
    sheet.heading("Probes");
    for (name, probe, verdict) in all {
        if let Some(probe) = probe {
            sheet.list(name, [check(probe), timing(probe), verdict]);
        }
    }
}

fn check(probe: &Probe) -> String {
    let at = |host: &Option<String>, port: u16| {
        let host = address(host.as_deref());
        host.map_or_else(
            || format!("port {port}"),
            |ip| std::net::SocketAddr::new(ip, port).to_string(),
        )
    };
    if let Some(exec) = &probe.exec {
        format!("runs {}", command_line(&exec.command))
    } else if let Some(http) = &probe.http {
        let scheme = match http.scheme {
            Scheme::Http => "http",
            Scheme::Https => "https",
        };
        format!("gets {scheme}://{}{}", at(&http.host, http.port), http.path)
    } else if let Some(tcp) = &probe.tcp {
        format!("connects to {}", at(&tcp.host, tcp.port))
    } else if let Some(topic) = &probe.topic {
        let at = topic.master.as_ref().map(|master| format!(" at {master}")).unwrap_or_default();
        let (name, hz, within) = (&topic.name, topic.min_hz, topic.within);
        format!("counts {name}{at}: at least {hz} Hz over {within}")
    } else {
        "a check that this command does not know".to_owned()
    }
}

fn timing(probe: &Probe) -> String {
    let mut text = format!("every {}", probe.period);
    if probe.topic.is_none() {
        text.push_str(&format!(", answer within {}", probe.timeout));
    }
    if !probe.initial_delay.as_duration().is_zero() {
        text.push_str(&format!(", first after {}", probe.initial_delay));
    }
    if probe.success_threshold > 1 {
        text.push_str(&format!(", succeeds with {} in a row", probe.success_threshold));
    }
    text.push_str(&format!(", fails with {} in a row", probe.failure_threshold));
    text
}

const NOT_MADE: &str = "now: not made, the task does not run";
const HELD_BACK: &str = "now: not made before start-up has succeeded";

fn said(status: &TaskStatus) -> String {
    format!("now: {}", status.message)
}

fn is_held_back(spec: &TaskSpec, status: &TaskStatus) -> bool {
    spec.startup.is_some() && status.reason == STARTING_UP
}

fn start_up(status: &TaskStatus) -> String {
    match status.phase {
        _ if status.reason == STARTUP_FAILED => said(status),
        TaskPhase::Running if status.reason == STARTING_UP => said(status),
        TaskPhase::Running => "now: has succeeded".to_owned(),
        _ => NOT_MADE.to_owned(),
    }
}

fn readiness(spec: &TaskSpec, status: &TaskStatus) -> String {
    match (status.phase, status.ready) {
        (TaskPhase::Running, _) if is_held_back(spec, status) => HELD_BACK.to_owned(),
        (TaskPhase::Running, Some(true)) => "now: succeeds".to_owned(),
        (TaskPhase::Running, _) => said(status),
        _ => NOT_MADE.to_owned(),
    }
}

fn liveness(spec: &TaskSpec, status: &TaskStatus) -> String {
    match status.phase {
        _ if status.reason == LIVENESS_FAILED => said(status),
        TaskPhase::Running if is_held_back(spec, status) => HELD_BACK.to_owned(),
        TaskPhase::Running => "now: has not failed".to_owned(),
        _ => NOT_MADE.to_owned(),
    }
}

#[cfg(test)]
mod tests {
    use serde_json::{Value, json};

    use crate::fake::{Fake, task};

    async fn described(status: Value) -> String {
        let fake = Fake::new();
        let mut object = task("t", status);
        object["spec"]["startup"] = json!({"exec": {"command": ["test", "-e", "a b"]}});
        object["spec"]["readiness"] = json!({
            "http": {"path": "/ready", "port": 80}, "initialDelay": "5s", "successThreshold": 2,
        });
        object["spec"]["liveness"] = json!({"tcp": {"port": 81, "host": "::1"}, "period": "1s"});
        fake.put("tasks/default/t", object);
        let text = fake.run(&["describe", "task/t"]).await.1;
        let probes = text.split("\nProbes\n").nth(1).expect("a section");
        probes.split("\n\n").next().expect("its lines").to_owned()
    }

    #[tokio::test]
    async fn a_topic_is_counted_and_has_no_timeout() {
        let fake = Fake::new();
        let mut object = task("t", json!({"phase": "Running", "ready": true}));
        let topic = json!({"name": "/scan", "minHz": 5.0, "master": "http://robot:11311"});
        object["spec"]["readiness"] = json!({ "topic": topic });
        fake.put("tasks/default/t", object);
        let text = fake.run(&["describe", "task/t"]).await.1;
        let line = "counts /scan at http://robot:11311: at least 5 Hz over 2s";
        assert!(text.contains(line) && text.contains("every 10s, fails with 3 in a row"), "{text}");
    }

    #[tokio::test]
    async fn probes_say_what_they_do_and_how_it_stands() {
        let running = json!({"phase": "Running", "ready": false, "reason": "NotReady",
            "message": "its readiness probe failed: HTTP status 503: no map"});
        assert_eq!(
            described(running).await,
            "  Start-up:      runs test -e \"a b\"\n\
             \x20                every 10s, answer within 1s, fails with 3 in a row\n\
             \x20                now: has succeeded\n\
             \x20 Readiness:     gets http://127.0.0.1:80/ready\n\
             \x20                every 10s, answer within 1s, first after 5s, succeeds with 2 in a row, fails with 3 in a row\n\
             \x20                now: its readiness probe failed: HTTP status 503: no map\n\
             \x20 Liveness:      connects to [::1]:81\n\
             \x20                every 1s, answer within 1s, fails with 3 in a row\n\
             \x20                now: has not failed"
        );
        let starting = json!({"phase": "Running", "ready": false, "reason": "StartingUp",
            "message": "its start-up probe has not succeeded yet"});
        let text = described(starting).await;
        assert!(text.contains("now: its start-up probe has not succeeded yet"), "{text}");
        assert_eq!(text.matches("not made before start-up").count(), 2, "{text}");
        let failed = json!({"phase": "Stopping", "ready": false, "reason": "LivenessFailed",
            "message": "its liveness probe failed 3 times in a row: no answer within 1s"});
        let text = described(failed).await;
        assert!(text.ends_with("3 times in a row: no answer within 1s"), "{text}");
        assert_eq!(text.matches("the task does not run").count(), 2, "{text}");
    }
}
