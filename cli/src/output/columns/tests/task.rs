use jiff::Timestamp;
use serde_json::{Value, json};

use crate::output::columns::{Layout, table};
use crate::output::style::Styles;

fn task(name: &str, resources: Value, status: Value) -> Value {
    json!({
        "apiVersion": "muster.dev/v1alpha1", "kind": "Task",
        "metadata": {"name": name, "namespace": "lab", "creationTimestamp": "1970-01-01T00:00:00Z"},
        "spec": {"resources": resources, "run": {"process": {"command": ["x"]}}},
        "status": status,
    })
}

fn text(wide: bool, namespaces: bool) -> String {
    let info = muster_api::kind::find_by_word("task").expect("served");
    let refusal =
        |node: &str, reason: &str| json!({"node": node, "reason": reason, "message": "m"});
    let objects = [
        task(
            "gmapping",
            json!({"cpu": "500m", "memory": "64Mi", "sensors": ["k:L"], "actuators": ["b:D"]}),
            json!({"phase": "Running", "node": "r1", "score": 2.345, "attempt": 1,
                   "lease": {"name": "r1.body", "epoch": 4}, "usage": {"cpu": "153m", "memory": "12Mi"}}),
        ),
        task(
            "second",
            json!({"actuators": ["b:D"]}),
            json!({"phase": "Pending", "attempt": 0,
                   "why": [refusal("c1", "WrongKind"), refusal("r1", "LeaseHeld"), refusal("r2", "LeaseHeld")]}),
        ),
        task(
            "crash",
            json!({}),
            json!({"phase": "Failed", "node": "c1", "attempt": 3, "exitCode": 137, "signal": 9,
                   "reason": "OOMKilled", "message": "out of memory"}),
        ),
    ];
    let now = Timestamp::from_second(300).expect("in range");
    table(info, &objects, Layout { wide, namespaces, kinds: false, now }).text(&Styles::default())
}

#[test]
fn the_plain_table_says_where_and_why() {
    assert_eq!(
        text(false, true),
        "NAMESPACE   NAME       PHASE     NODE   SCORE   CLASS      ATTEMPT   AGE   REASON\n\
         lab         gmapping   Running   r1     2.35m   AR-CR-SR   1         5m    -\n\
         lab         second     Pending   -      -       AR         -         5m    LeaseHeld×2,WrongKind\n\
         lab         crash      Failed    c1     -       none       3         5m    OOMKilled\n"
    );
}

#[test]
fn the_wide_table_adds_readiness_lease_usage_and_end() {
    let text = text(true, false);
    let squeezed: Vec<String> =
        text.lines().map(|l| l.split_whitespace().collect::<Vec<_>>().join(" ")).collect();
    assert_eq!(
        squeezed[1],
        "gmapping Running r1 2.35m AR-CR-SR 1 5m - True 4 0.153/0.5 12Mi/64Mi - -"
    );
    assert_eq!(squeezed[3], "crash Failed c1 - none 3 5m OOMKilled - - - - signal 9 out of memory");
}

#[test]
fn an_object_of_a_newer_controller_keeps_its_row() {
    let info = muster_api::kind::find_by_word("task").expect("served");
    let object = task("new", json!({}), json!({"phase": "Dreaming"}));
    let layout = Layout { wide: false, namespaces: false, kinds: true, now: Timestamp::UNIX_EPOCH };
    let text = table(info, &[object], layout).text(&Styles::default());
    assert!(text.lines().nth(1).expect("a row").starts_with("task/new   ?"), "{text}");
}
