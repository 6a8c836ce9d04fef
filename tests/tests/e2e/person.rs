//! A person takes a robot from the task that drives it: the task is refused before the person is answered, and does not get the
//! robot back by itself.

use muster_api::kind::lease::Lease;
use muster_api::phase::TaskPhase;
use muster_tests::{Cluster, kernel, wait};

use crate::cli::muster;
use crate::gate::{Robot, condition, drive};

async fn lease(cluster: &Cluster) -> Lease {
    cluster.leases().await.get("robot.body").await.expect("it is there")
}

#[tokio::test(flavor = "multi_thread")]
async fn who_takes_a_robot_has_it_before_the_answer() {
    let mut cluster = Cluster::start().await;
    let robot = Robot::join(&mut cluster).await;
    condition(&cluster, "ActuatorsFenced", "True").await;
    let first = cluster.create("first", drive()).await;
    cluster.phase("first", TaskPhase::Running).await;
    robot.wait("go first").await;

    let refused = muster(&cluster, &["lease", "acquire", "robot"]);
    assert_ne!(refused.0, 0);
    assert!(refused.2.contains("default/first holds it"), "{}", refused.2);
    let taken = muster(&cluster, &["lease", "take", "robot", "--reason", "stuck"]);
    assert_eq!(
        (taken.0, taken.1.as_str()),
        (0, "lease/robot.body taken, epoch 2\n"),
        "{}",
        taken.2
    );
    // The driver has it by now, and writes it down a moment later.
    robot.wait("stop").await;
    let heard = robot.heard();
    let held = lease(&cluster).await.status.expect("a status");
    let holder = held.holder.map(|holder| holder.to_string());
    assert_eq!((held.epoch.0, holder.as_deref()), (2, Some("user admin")));
    // Its task runs on, and says what it is told.
    let uid = first.metadata.uid.expect("set by the server");
    assert!(!kernel::with_env("MUSTER_UID", &uid).is_empty());
    let told = async || match muster(&cluster, &["logs", "first"]).1 {
        said if said.contains("REVOKED") => Ok(()),
        said => Err(said),
    };
    wait::until("REVOKED", told).await;

    // A new task waits, and says for whom.
    cluster.create("second", drive()).await;
    let waits = cluster.task("second", "waiting", |s| !s.why.is_empty()).await;
    let why = waits.status.map(|status| status.why).unwrap_or_default();
    assert!(why.iter().any(|w| w.message.contains("user admin")), "{why:?}");
    // The controller and the agent may be started again meanwhile: the robot stays the person's.
    cluster.kill_controller();
    cluster.start_controller().await;
    condition(&cluster, "Ready", "True").await;
    // It may be told to stop again.
    let since = robot.heard().split_off(heard.len());
    assert!(since.iter().all(|word| word == "stop"), "it stood all the time: {since:?}");
    assert_eq!(lease(&cluster).await.status.map(|s| s.epoch.0), Some(2));

    let back = muster(&cluster, &["lease", "return", "robot"]);
    assert_eq!(
        (back.0, back.1.as_str()),
        (0, "lease/robot.body returned, epoch 2\n"),
        "{}",
        back.2
    );
    // The next one drives; the first one, which runs on, never again.
    robot.wait("go second").await;
    assert!(!robot.heard()[heard.len()..].contains(&"go first".to_owned()));
    let log = cluster.dir().join("controller/audit/audit.jsonl");
    let text = std::fs::read_to_string(&log).expect("the audit log");
    let line = text.lines().find(|line| line.contains("\"subresource\":\"take\"")).expect("a line");
    assert!(line.contains("\"user\":\"admin\"") && line.contains("\"code\":200"), "{line}");
    assert!(line.contains("\"name\":\"robot.body\"") && line.contains("\"first\""), "{line}");
}
