use jiff::Timestamp;
use serde_json::json;

use crate::output::columns::{Layout, table};
use crate::output::style::Styles;

#[test]
fn a_framework_shows_where_it_works_and_what_it_has() {
    let info = muster_api::kind::find_by_word("fw").expect("served");
    let framework = |name: &str, spec, status| {
        json!({
            "apiVersion": "muster.dev/v1alpha1", "kind": "Framework",
            "metadata": {"name": name, "uid": "u-1", "creationTimestamp": "1970-01-01T00:00:00Z"},
            "spec": spec, "status": status,
        })
    };
    let objects = [
        framework(
            "deliver",
            json!({
                "position": {"x": 3, "y": 4.5}, "radius": 8.5,
                "filter": {"on": "Robot", "minimum": {"cpu": "500m"}, "anyActuator": true, "most": 2},
            }),
            json!({"connected": true, "offers": 2, "tasks": 1, "share": 0.25}),
        ),
        framework("idle", json!({}), json!({"connected": true, "suppressed": true})),
        framework("lost", json!({"failoverTimeout": "5m"}), json!({"connected": false})),
    ];
    let text = |wide| {
        let now = Timestamp::from_second(65).expect("in range");
        let layout = Layout { wide, namespaces: false, kinds: false, now };
        table(info, &objects, layout).text(&Styles::default())
    };
    assert_eq!(
        text(false),
        "NAME      CONNECTED         POSITION    RADIUS   OFFERS   TASKS   SHARE   AGE\n\
         deliver   True              3.00,4.50   8.5m     2        1       0.25    65s\n\
         idle      True,Suppressed   -           -        0        0       0.00    65s\n\
         lost      False             -           -        0        0       0.00    65s\n"
    );
    let wide = text(true);
    for part in ["FILTER", "Robot; cpu≥0.5; any actuator; most 2", "5m", "u-1"] {
        assert!(wide.contains(part), "{part:?} is not in\n{wide}");
    }
}
