use serde_json::json;

use crate::output::columns::{Layout, table};
use crate::output::style::Styles;

#[test]
fn a_row_says_what_may_move() {
    let info = muster_api::kind::find_by_word("app").expect("served");
    let now = jiff::Timestamp::UNIX_EPOCH;
    let layout = Layout { wide: false, namespaces: false, kinds: false, now };
    let part = |name: &str, sensors: serde_json::Value| json!({"name": name, "template": {"spec": {"resources": {"sensors": sensors}}}});
    let object = json!({
        "apiVersion": "muster.dev/v1alpha1", "kind": "Application", "metadata": {"name": "corridor"},
        "spec": {"home": "youbot", "parts": [part("camera", json!(["x:Y"])), part("amcl", json!([]))]},
        "status": {"phase": "Running"},
    });
    assert_eq!(
        table(info, &[object], layout).text(&Styles::default()),
        "NAME       HOME     PARTS   MIGRATABLE   AWAY   POLICY    PHASE     AGE\n\
         corridor   youbot   2       amcl         -      Optimal   Running   -\n"
    );
}
