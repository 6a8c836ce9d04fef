use serde_json::json;

use crate::fake::taskset;
use crate::output::columns::{Layout, table};
use crate::output::style::Styles;

#[test]
fn a_row_says_how_many_serve_and_what_the_rollout_does() {
    let info = muster_api::kind::find_by_word("ts").expect("served");
    let now = jiff::Timestamp::UNIX_EPOCH;
    let layout = Layout { wide: false, namespaces: false, kinds: false, now };
    let status = json!({
        "desiredReplicas": 3, "replicas": 3, "updatedReplicas": 1, "availableReplicas": 2, "unavailableReplicas": 1,
        "conditions": [{"type": "Progressing", "status": "True", "reason": "Canary"}],
    });
    assert_eq!(
        table(info, &[taskset("a", status), taskset("b", json!(null))], layout)
            .text(&Styles::default()),
        "NAME   DESIRED   CURRENT   UPDATED   AVAILABLE   ROLLOUT   AGE\n\
         a      3         3         1         2           Canary    -\n\
         b      3         -         -         -           -         -\n"
    );
}
