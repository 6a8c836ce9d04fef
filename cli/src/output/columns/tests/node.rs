use jiff::Timestamp;
use serde_json::json;

use crate::output::columns::{Layout, table};
use crate::output::style::Styles;

#[test]
fn a_robot_shows_what_is_left_who_drives_and_where_it_is() {
    let info = muster_api::kind::find_by_word("node").expect("served");
    let robot = json!({
        "apiVersion": "muster.dev/v1alpha1", "kind": "Node",
        "metadata": {"name": "turtlebot-1", "creationTimestamp": "1970-01-01T00:00:00Z"},
        "spec": {"kind": "Robot", "unschedulable": true},
        "status": {
            "allocatable": {"cpu": "2", "memory": "4Gi"},
            "free": {"cpu": "1500m", "memory": "3Gi"},
            "sensors": ["kinect:LaserGen", "kinect:ImageGen"],
            "actuators": ["base:Drive"],
            "leases": [{"group": "body", "epoch": 3, "holder": {"namespace": "default", "name": "gmapping", "uid": "u"}}],
            "pose": {"x": 3, "y": 4.5},
            "battery": {"percent": 9, "charging": true},
            "conditions": [{"type": "Ready", "status": "True"}, {"type": "Battery", "status": "False"}],
            "runtimes": [{"name": "process", "available": true}, {"name": "docker", "available": false}],
            "agentVersion": "0.1.0",
        },
    });
    let registered = json!({
        "apiVersion": "muster.dev/v1alpha1", "kind": "Node",
        "metadata": {"name": "cloud-1"}, "spec": {"kind": "Cloud"},
    });
    let layout = |wide| Layout {
        wide,
        namespaces: true,
        kinds: false,
        now: Timestamp::from_second(65).expect("in range"),
    };
    let text = |wide| {
        table(info, &[robot.clone(), registered.clone()], layout(wide)).text(&Styles::default())
    };
    assert_eq!(
        text(false),
        "NAME          KIND    READY                      CPU     MEMORY    LEASE              POSE        AGE\n\
         turtlebot-1   Robot   True,Cordoned,BatteryLow   1.5/2   3Gi/4Gi   default/gmapping   3.00,4.50   65s\n\
         cloud-1       Cloud   NotJoined                  -       -         -                  -           -\n"
    );
    assert!(
        text(true).contains("9 %+      kinect:ImageGen,LaserGen   base:Drive   process    0.1.0"),
        "{}",
        text(true)
    );
}
