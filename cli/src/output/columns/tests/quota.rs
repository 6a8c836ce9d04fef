use serde_json::{Value, json};

use crate::output::columns::{Layout, table};
use crate::output::style::Styles;

fn text(status: &Value) -> String {
    let info = muster_api::kind::find_by_word("quotas").expect("served");
    let quota = json!({
        "apiVersion": "muster.dev/v1alpha1", "kind": "Quota",
        "metadata": {"name": "default", "namespace": "lab"},
        "spec": {"hard": {"cpu": "1500m", "leases": 2, "extended": {"gpu": 1}}, "weight": 2},
        "status": status,
    });
    let now = jiff::Timestamp::UNIX_EPOCH;
    let layout = Layout { wide: true, namespaces: true, kinds: false, now };
    table(info, &[quota], layout).text(&Styles::default())
}

#[test]
fn what_is_used_stands_before_what_is_allowed() {
    let used =
        json!({"cpu": "500m", "memory": "64Mi", "leases": 1, "tasks": 3, "extended": {"gpu": 1}});
    assert_eq!(
        text(&json!({"used": used})),
        "NAMESPACE   NAME      CPU       MEMORY   LEASES   TASKS   WEIGHT   AGE   EXTENDED\n\
         lab         default   0.5/1.5   64Mi/-   1/2      3/-     2        -     gpu=1/1\n"
    );
}

#[test]
fn what_is_not_limited_or_not_counted_is_a_dash() {
    assert_eq!(
        text(&Value::Null),
        "NAMESPACE   NAME      CPU     MEMORY   LEASES   TASKS   WEIGHT   AGE   EXTENDED\n\
         lab         default   -/1.5   -        -/2      -       2        -     gpu=-/1\n"
    );
}
