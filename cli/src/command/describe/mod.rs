//! `muster describe`: everything about objects, for people. One file for each kind that has more to
//! say than its fields.

mod access;
mod any;
mod application;
mod framework;
mod keyed;
mod lease;
mod node;
mod probes;
mod quota;
mod task;
mod taskset;

use jiff::Timestamp;
use k8s_openapi::apimachinery::pkg::apis::meta::v1::ObjectMeta;
use muster_api::condition::{Condition, ConditionStatus};
use muster_api::kind::KindInfo;
use muster_api::kind::event::Event;
use muster_api::kind::quota::Quota;
use muster_api::kind::task::{Cost, NodeChoice, Task};
use muster_api::pose::OperationPosition;
use serde_json::Value;

use super::Outcome;
use crate::args::Select;
use crate::client::Selection;
use crate::error::CliError;
use crate::exit;
use crate::merge::LAST_APPLIED;
use crate::output::columns::event::stamp;
use crate::output::human;
use crate::output::sheet::{Sheet, pairs};
use crate::output::style::Mood;
use crate::output::table::{Cell, Table};
use crate::session::Session;
use crate::target::{self, Named};

/// `muster describe`.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    /// KIND [NAME…] or KIND/NAME…
    #[arg(value_name = "OBJECT", required = true)]
    objects: Vec<String>,
    #[command(flatten)]
    select: Select,
    /// In every namespace
    #[arg(short = 'A', long)]
    all_namespaces: bool,
}

pub(crate) async fn run(args: Args, session: &mut Session) -> Outcome {
    let mut first = true;
    for Named { info, name } in target::parse(&args.objects)? {
        let namespace = (!args.all_namespaces).then(|| session.namespace.clone());
        let objects = match name {
            Some(name) => vec![session.client.get(info, namespace.as_deref(), name).await?],
            None => {
                let selection = args.select.selection();
                session.client.list(info, namespace.as_deref(), &selection).await?.items
            }
        };
        for object in objects {
            if !std::mem::take(&mut first) {
                session.ui.line("\n")?;
            }
            let text = describe(info, object, session).await?;
            session.ui.print(&text)?;
        }
    }
    if first {
        session.ui.note("there is nothing to describe");
    }
    Ok(exit::OK)
}

async fn describe(
    info: &'static KindInfo,
    object: Value,
    session: &Session,
) -> Result<String, CliError> {
    let now = Timestamp::now();
    let events = events(&object, session).await?;
    let mut sheet = Sheet::default();
    let read = |source| CliError::Answer {
        server: session.client.server.clone(),
        request: format!("GET {}", info.plural),
        source,
    };
    match info.kind {
        "Node" => {
            let node = serde_json::from_value(object).map_err(read)?;
            let tasks = holding(None, node::on_it(&node), session).await?;
            node::describe(&mut sheet, &node, &tasks, now);
        }
        "Framework" => {
            let framework = serde_json::from_value(object).map_err(read)?;
            let (namespace, its) = framework::its_tasks(&framework);
            let tasks = holding(namespace, its, session).await?;
            framework::describe(&mut sheet, &framework, &tasks, now);
        }
        "Quota" => {
            let quota: Quota = serde_json::from_value(object).map_err(read)?;
            quota::describe(&mut sheet, &quota, now);
        }
        "Application" => {
            application::describe(&mut sheet, &serde_json::from_value(object).map_err(read)?, now);
        }
        "TaskSet" => {
            let set = serde_json::from_value(object).map_err(read)?;
            let (namespace, its) = taskset::its_tasks(&set);
            let list = session.client.list(target::kind("task")?, namespace, &its).await?;
            let tasks: Vec<Task> =
                list.items.into_iter().filter_map(|o| serde_json::from_value(o).ok()).collect();
            taskset::describe(&mut sheet, &set, &tasks, now);
        }
        "Task" => task::describe(&mut sheet, &serde_json::from_value(object).map_err(read)?, now),
        "ConfigMap" => {
            keyed::config_map(&mut sheet, &serde_json::from_value(object).map_err(read)?, now);
        }
        "Secret" => {
            keyed::secret(&mut sheet, &serde_json::from_value(object).map_err(read)?, now);
        }
        "Lease" => lease::describe(&mut sheet, &serde_json::from_value(object).map_err(read)?, now),
        "Access" => {
            access::describe(&mut sheet, &serde_json::from_value(object).map_err(read)?, now);
        }
        _ => any::describe(&mut sheet, &object, now),
    }
    if info.kind != "Event" {
        sheet.table("Events", event_table(&events, now));
    }
    Ok(sheet.text(&session.ui.styles))
}

/// Name, labels, age: what every object begins with.
fn begin(sheet: &mut Sheet, metadata: &ObjectMeta, now: Timestamp) {
    sheet.field("Name", metadata.name.as_deref().unwrap_or_default());
    sheet.maybe("Namespace", metadata.namespace.as_deref());
    sheet.list("Labels", pairs(metadata.labels.iter().flatten()));
    // The manifest that was applied is long, and what it says stands below.
    let notes = metadata.annotations.iter().flatten().filter(|(k, _)| *k != LAST_APPLIED);
    sheet.list("Annotations", pairs(notes));
    if let Some(created) = &metadata.creation_timestamp {
        sheet.field("Created", when(created.0, now));
    }
    if let Some(deleted) = &metadata.deletion_timestamp {
        sheet.field("Ending", Cell::new(format!("deleted; goes at {}", deleted.0), Mood::Warn));
    }
    let owners = metadata.owner_references.iter().flatten();
    sheet.list("Owned by", owners.map(|o| format!("{}/{}", o.kind.to_lowercase(), o.name)));
    sheet.list("Finalizers", metadata.finalizers.iter().flatten().cloned());
}

/// The selected tasks that hold something of a node; of no namespace: of all.
async fn holding(
    namespace: Option<&str>,
    selection: Selection,
    session: &Session,
) -> Result<Vec<Task>, CliError> {
    let list = session.client.list(target::kind("task")?, namespace, &selection).await?;
    let tasks = list.items.into_iter().filter_map(|o| serde_json::from_value::<Task>(o).ok());
    Ok(tasks.filter(|t| t.status.as_ref().is_some_and(|s| s.phase.holds_node())).collect())
}

/// `3.00,4.00 in "lab"`.
fn position(at: &OperationPosition) -> String {
    let z = if at.z == 0.0 { String::new() } else { format!(",{:.2}", at.z) };
    format!("{:.2},{:.2}{z} in {:?}", at.x, at.y, at.map)
}

fn scored_by(cost: Cost) -> &'static str {
    match cost {
        Cost::Distance => "distance",
        Cost::TravelTime => "travel time",
    }
}

fn which_node(choice: NodeChoice) -> &'static str {
    match choice {
        NodeChoice::Any => "any node",
        NodeChoice::Robot => "Robot",
        NodeChoice::Cloud => "Cloud",
    }
}

/// `5m ago (2026-01-02T03:04:05Z)`.
fn when(then: Timestamp, now: Timestamp) -> String {
    format!("{} ago ({})", human::age(then, now), then.strftime("%Y-%m-%dT%H:%M:%SZ"))
}

fn condition_table(conditions: &[Condition], now: Timestamp) -> Table {
    let mut table = Table::new(["TYPE", "STATUS", "SINCE", "REASON", "MESSAGE"]);
    for condition in conditions {
        let (text, mood) = match condition.status {
            ConditionStatus::True => ("True", Mood::Good),
            ConditionStatus::False => ("False", Mood::Bad),
            ConditionStatus::Unknown => ("Unknown", Mood::Warn),
        };
        let since = condition.last_transition_time.as_ref().map(|t| human::age(t.0, now));
        table.push([
            Cell::from(&condition.r#type),
            Cell::new(text, mood),
            since.unwrap_or_default().into(),
            Cell::from(&condition.reason),
            Cell::from(&condition.message),
        ]);
    }
    table
}

/// The events about an object, oldest first.
async fn events(object: &Value, session: &Session) -> Result<Vec<Event>, CliError> {
    let Some(uid) = object.pointer("/metadata/uid").and_then(Value::as_str) else {
        return Ok(Vec::new());
    };
    let about = Selection { labels: None, fields: Some(format!("involvedObject.uid={uid}")) };
    // Events about objects without a namespace are in the default one; asking all of them is simpler.
    let list = session.client.list(target::kind("event")?, None, &about).await;
    let items = match list {
        Ok(list) => list.items,
        // A description without events is better than none.
        Err(error) if error.is_not_found() => Vec::new(),
        Err(error) => return Err(error),
    };
    let mut events: Vec<Event> =
        items.into_iter().filter_map(|e| serde_json::from_value(e).ok()).collect();
    events.sort_by_key(stamp);
    Ok(events)
}

fn event_table(events: &[Event], now: Timestamp) -> Table {
    let mut table = Table::new(["SEEN", "TYPE", "REASON", "MESSAGE"]);
    for event in events {
        let count = event.count.filter(|c| *c > 1).map(|c| format!(" (×{c})")).unwrap_or_default();
        let kind = event.type_.as_deref().unwrap_or_default();
        let mood = if kind == "Warning" { Mood::Warn } else { Mood::Plain };
        table.push([
            format!("{}{count}", stamp(event).map(|t| human::age(t, now)).unwrap_or_default())
                .into(),
            Cell::new(kind, mood),
            event.reason.clone().unwrap_or_default().into(),
            event.message.clone().unwrap_or_default().into(),
        ]);
    }
    table
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use crate::exit;
    use crate::fake::{Fake, framework, node, task};

    #[tokio::test]
    async fn a_node_says_what_it_has_who_drives_it_and_what_runs_there() {
        let fake = Fake::new();
        fake.put("nodes/r1", node("r1", json!({
            "capacity": {"cpu": "4", "memory": "4Gi"},
            "allocatable": {"cpu": "3500m", "memory": "3Gi"},
            "used": {"cpu": "500m", "memory": "64Mi"},
            "free": {"cpu": "3", "memory": "2944Mi"},
            "sensors": ["kinect:ImageGen"], "actuators": ["base:Drive"],
            "leases": [{"group": "body", "epoch": 4, "holder": {"namespace": "default", "name": "a", "uid": "u"}}],
            "pose": {"x": 1, "y": 2, "source": "static"},
            "conditions": [{"type": "Ready", "status": "True", "reason": "Heard"}],
            "runtimes": [{"name": "docker", "available": false, "message": "no socket"}],
        })));
        let mut a = task(
            "a",
            json!({"phase": "Running", "node": "r1", "usage": {"cpu": "153m", "memory": "12Mi"}}),
        );
        a["spec"]["resources"] = json!({"cpu": "500m", "memory": "64Mi", "actuators": ["base:Drive"], "sensors": ["kinect:ImageGen"]});
        fake.put("tasks/default/a", a);
        let (code, text) = fake.run(&["describe", "node/r1"]).await;
        assert_eq!(code, exit::OK);
        for part in [
            "Kind:            Robot",
            "Ready:           True",
            "cpu      3     0.5    3.5",
            "Pose:            1.00,2.00 in \"map\", from static",
            "kinect:ImageGen   1 task",
            "base:Drive   body    4       default/a",
            "docker    no       -         no socket",
            "default     a      Running   AR-CR-SR",
        ] {
            let squeezed = |t: &str| t.split_whitespace().collect::<Vec<_>>().join(" ");
            assert!(squeezed(&text).contains(&squeezed(part)), "{part:?} is not in\n{text}");
        }
    }

    #[tokio::test]
    async fn a_task_says_where_it_may_run_what_it_needs_and_why_it_waits() {
        let fake = Fake::new();
        let mut object = task(
            "t",
            json!({"phase": "Pending", "why": [{"node": "r1", "reason": "OutOfRange", "message": "is 21.3 m away"}]}),
        );
        object["spec"]["placement"] =
            json!({"at": {"x": 3, "y": 4, "map": "lab"}, "within": 20, "on": "Robot"});
        object["spec"]["resources"] = json!({"cpu": "500m", "actuators": ["base:Drive"]});
        object["metadata"]["uid"] = json!("uid-t");
        fake.put("tasks/default/t", object);
        fake.put("events/default/e", json!({"apiVersion": "v1", "kind": "Event", "metadata": {"name": "e", "namespace": "default"},
            "involvedObject": {"uid": "uid-t"}, "reason": "Waits", "message": "no node", "type": "Warning", "count": 2}));
        let (_, text) = fake.run(&["describe", "task/t"]).await;
        for part in [
            "Phase:           Pending",
            "At:            3.00,4.00 in \"lab\", within 20 m",
            "On:            Robot",
            "Cpu:           0.5",
            "Actuators:     base:Drive",
            "If cut off: stops after 30s",
            "Process:       x",
            "r1     OutOfRange   is 21.3 m away",
            "Warning   Waits    no node",
        ] {
            let squeezed = |t: &str| t.split_whitespace().collect::<Vec<_>>().join(" ");
            assert!(squeezed(&text).contains(&squeezed(part)), "{part:?} is not in\n{text}");
        }
    }
    #[tokio::test]
    async fn a_framework_says_what_it_wants_and_what_it_has() {
        let fake = Fake::new();
        let mut object = framework(
            "deliver",
            json!({"connected": false, "disconnectedAt": "2026-01-02T03:04:05Z", "share": 0.25}),
        );
        object["spec"] = json!({
            "position": {"x": 3, "y": 4, "map": "lab"}, "radius": 8, "failoverTimeout": "5m",
            "filter": {"on": "Robot", "minimum": {"cpu": "500m"}, "actuators": ["base:Drive"], "most": 2},
        });
        fake.put("frameworks/default/deliver", object);
        let mut t = task("t", json!({"phase": "Running", "node": "r1"}));
        t["spec"]["resources"] = json!({"cpu": "500m"});
        fake.put("tasks/default/t", t);
        let (code, text) = fake.run(&["describe", "fw", "deliver"]).await;
        assert_eq!(code, exit::OK);
        let labels = "labelSelector=muster.dev%2Fframework%3Ddeliver";
        assert!(fake.requests().iter().any(|r| r.contains(labels)), "{:?}", fake.requests());
        for part in [
            "Id:              u-1",
            "Connected:       no",
            "Away at most:    5m; its tasks are ended in 0s if it does not come back",
            "Share:           0.25",
            "At:            3.00,4.00 in \"lab\"",
            "Radius:        8 m",
            "Cpu:           0.5 free at least",
            "Actuators:     base:Drive",
            "At once:       2 offers at most",
            "t      Running   r1     CR      -",
        ] {
            assert!(text.contains(part), "{part:?} is not in\n{text}");
        }
    }

    #[tokio::test]
    async fn a_quota_stands_beside_what_the_namespace_has() {
        let fake = Fake::new();
        fake.put(
            "quotas/default/default",
            json!({
                "apiVersion": "muster.dev/v1alpha1", "kind": "Quota",
                "metadata": {"name": "default", "namespace": "default"},
                "spec": {"hard": {"cpu": "4", "leases": 2, "extended": {"gpu": 1}}, "weight": 2},
                "status": {
                    "used": {"cpu": "500m", "memory": "64Mi", "leases": 1, "tasks": 1},
                    "requested": {"cpu": "2", "memory": "64Mi", "leases": 1, "tasks": 2},
                },
            }),
        );
        let (_, text) = fake.run(&["describe", "quota", "default"]).await;
        for line in [
            "Weight:          2",
            "           USED   REQUESTED   HARD",
            "  cpu      0.5    2           4",
            "  memory   64Mi   64Mi        -",
            "  leases   1      1           2",
            "  tasks    1      2           -",
            "  gpu      0      0           1",
        ] {
            assert!(text.lines().any(|l| l == line), "{line:?} is not in\n{text}");
        }
    }
}
