//! A framework: is it there, what is it offered, and why not the other nodes.

use jiff::Timestamp;
use muster_api::kind::framework::Framework;
use muster_api::kind::task::NodeRefusal;
use serde::Deserialize;
use serde_json::{Value, json};

use super::{Asked, advice, refusals_and_hints, refuses};
use crate::command::offers::View;
use crate::output::human;
use crate::output::style::Styles;

/// The part of the controller's answer that only frameworks have.
#[derive(Debug, Default, Deserialize)]
struct AtTheDesk {
    /// None: it has been away since before the controller began.
    #[serde(default)]
    framework: Option<View>,
}

/// The text, and what programs get when the controller has no answer of its own.
pub(super) fn told(
    asked: &Asked<'_>,
    styles: &Styles,
) -> Result<(String, Value), serde_json::Error> {
    let object: Framework = serde_json::from_value(asked.object.clone())?;
    let desk = match asked.answer.clone() {
        Some(answer) => serde_json::from_value::<AtTheDesk>(answer)?,
        None => AtTheDesk::default(),
    };
    let why = asked.refusals().unwrap_or_default();
    let now = Timestamp::now();
    let view = desk.framework.as_ref();
    let mut text = format!("{}\n", headline(&object, view, now));
    let hints = hints(&object, view, &why, now);
    text.push_str(&refusals_and_hints(&why, &hints, styles));
    Ok((text, json!({"why": why, "framework": null})))
}

/// The first line: what is so.
fn headline(object: &Framework, view: Option<&View>, now: Timestamp) -> String {
    let name = object.metadata.name.as_deref().unwrap_or_default();
    let status = object.status.clone().unwrap_or_default();
    let since = |time: Option<Timestamp>| {
        time.map(|t| format!(" for {}", human::age(t, now))).unwrap_or_default()
    };
    let Some(view) = view.filter(|v| v.connected) else {
        let away = since(status.disconnected_at.map(|t| t.0));
        return format!("framework/{name} is away{away} and is offered nothing.");
    };
    let here = since(status.subscribed_at.map(|t| t.0));
    let nodes: Vec<&str> = view.offers.iter().map(|o| o.node.as_str()).collect();
    if nodes.is_empty() {
        return format!("framework/{name} is connected{here} and is offered no node.");
    }
    let count = human::count(nodes.len(), "node");
    format!("framework/{name} is connected{here} and is offered {count}: {}.", nodes.join(", "))
}

fn hints(
    object: &Framework,
    view: Option<&View>,
    why: &[NodeRefusal],
    now: Timestamp,
) -> Vec<String> {
    let mut hints = Vec::new();
    if view.is_none_or(|v| !v.connected) {
        hints.push(while_away(object, now));
    }
    if view.is_some_and(|v| v.connected && v.suppressed) {
        hints.push("it is offered nodes again when it calls Revive".to_owned());
    }
    if refuses(why, &["Declined"]) {
        hints.push(
            "Revive makes the framework see at once what it declined or did not answer".to_owned(),
        );
    }
    hints.extend(advice(why, "the framework's radius"));
    hints
}

/// What the failover timeout does.
fn while_away(object: &Framework, now: Timestamp) -> String {
    let uid = object.metadata.uid.as_deref().unwrap_or_default();
    let timeout = object.spec.failover_timeout.0;
    let status = object.status.clone().unwrap_or_default();
    let time = match status.disconnected_at {
        Some(since) => {
            let left = human::left(timeout.as_duration(), since.0, now);
            format!("within {left} (failover timeout {timeout})")
        }
        None => format!("within its failover timeout, {timeout}"),
    };
    let tasks = match status.tasks {
        0 => "it is removed".to_owned(),
        n => {
            let n = usize::try_from(n).unwrap_or(usize::MAX);
            format!("its {} ended and it is removed", are(n))
        }
    };
    format!(
        "it takes everything up again when it subscribes with its id {uid} {time}; else {tasks}"
    )
}

/// `1 task is`, `3 tasks are`.
fn are(tasks: usize) -> String {
    format!("{} {}", human::count(tasks, "task"), if tasks == 1 { "is" } else { "are" })
}

#[cfg(test)]
mod tests {
    use jiff::{SignedDuration, Timestamp};
    use serde_json::{Value, json};

    use crate::exit;
    use crate::fake::{Fake, framework};

    const WHY: &str = "GET /apis/muster.dev/v1alpha1/namespaces/default/frameworks/deliver/why";

    fn view(connected: bool, suppressed: bool, offers: Value) -> Value {
        json!({
            "uid": "u-1", "namespace": "default", "name": "deliver", "connected": connected,
            "suppressed": suppressed, "share": 0.0, "offers": offers,
        })
    }

    #[tokio::test]
    async fn nodes_that_are_not_offered_say_why() {
        let fake = Fake::new();
        fake.put("frameworks/default/deliver", framework("deliver", json!({"connected": true})));
        let offer = json!({"id": "1", "node": "r1", "ageMs": 5, "free": {}, "actuators": true, "sharedWith": 0});
        let answer = json!({
            "why": [
                {"node": "r2", "reason": "OutOfRange", "message": "is 21.3 m away"},
                {"node": "r3", "reason": "Declined", "message": "was declined; offered again in 4 s, or when it has more"},
            ],
            "framework": view(true, false, json!([offer])),
        });
        fake.answer(WHY, answer.clone());
        assert_eq!(
            fake.run(&["why", "fw/deliver"]).await,
            (
                exit::OK,
                "framework/deliver is connected and is offered 1 node: r1.\n\n\
                 NODE   REFUSED BY   WHY\n\
                 r2     OutOfRange   is 21.3 m away\n\
                 r3     Declined     was declined; offered again in 4 s, or when it has more\n\n\
                 hint: Revive makes the framework see at once what it declined or did not answer\n\
                 hint: `muster get nodes` shows where the robots are; the framework's radius is how far they may be\n"
                    .to_owned()
            )
        );
        let (_, text) = fake.run(&["why", "framework/deliver", "-o", "json"]).await;
        assert_eq!(serde_json::from_str::<Value>(&text).expect("JSON"), answer);
    }

    #[tokio::test]
    async fn one_that_wants_nothing_or_is_away_says_what_brings_it_back() {
        let fake = Fake::new();
        fake.put("frameworks/default/deliver", framework("deliver", json!({"connected": true})));
        let why = |reason: &str| json!([{"node": "r1", "reason": reason, "message": "m"}]);
        fake.answer(
            WHY,
            json!({"why": why("Suppressed"), "framework": view(true, true, json!([]))}),
        );
        let (_, text) = fake.run(&["why", "framework/deliver"]).await;
        assert!(text.contains("hint: it is offered nodes again when it calls Revive"), "{text}");
        // Away for so long that nothing is left, so that the text does not move with the clock.
        let since = Timestamp::now() - SignedDuration::from_hours(9 * 24);
        fake.put(
            "frameworks/default/deliver",
            framework(
                "deliver",
                json!({"connected": false, "disconnectedAt": since.to_string(), "tasks": 2}),
            ),
        );
        fake.answer(
            WHY,
            json!({"why": why("Disconnected"), "framework": view(false, false, json!([]))}),
        );
        let (_, text) = fake.run(&["why", "framework/deliver"]).await;
        assert!(text.starts_with("framework/deliver is away for 9d and is offered nothing.\n"));
        assert!(
            text.ends_with(
                "hint: it takes everything up again when it subscribes with its id u-1 within 0s \
                 (failover timeout 1m); else its 2 tasks are ended and it is removed\n"
            ),
            "{text}"
        );
    }
}
