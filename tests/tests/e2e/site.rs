//! A Site's floor decides how far a robot is: by the way that it has to go, or not at all.

use muster_api::kind::task::TaskStatus;
use muster_tests::{AgentOptions, Cluster, Puppet, wait};
use serde_json::{Value, json};

use crate::cli::muster;

/// Cells of half a metre. The place of the work, (1, 2), is below a wall with its door in the east, above which one robot stands;
/// another one is in a closet.
const FLOOR: [&str; 8] = [
    "........................", //
    "........................", //
    "####################....", //
    "...............#####....", //
    "...............#...#....", //
    "...............#...#....", //
    "...............#####....", //
    "........................", //
];

/// The map's files and a manifest; its name.
fn write(cluster: &Cluster) -> String {
    let write = |name: &str, bytes: &[u8]| {
        let path = cluster.dir().join(name);
        std::fs::write(&path, bytes).expect("the directory is there");
        path.display().to_string()
    };
    let pixels = FLOOR.iter().flat_map(|row| row.bytes()).map(|c| if c == b'#' { 0 } else { 254 });
    let image: Vec<u8> =
        format!("P5\n{} {}\n255\n", FLOOR[0].len(), FLOOR.len()).bytes().chain(pixels).collect();
    write("lab.pgm", &image);
    write("lab.yaml", b"image: lab.pgm\nresolution: 0.5\norigin: [0, 0, 0]\nnegate: 0\noccupied_thresh: 0.65\nfree_thresh: 0.196\n");
    let site = "apiVersion: muster.dev/v1alpha1\nkind: Site\nmetadata: {name: lab}\nspec: {map: map, mapFile: lab.yaml, inflation: 0.2}\n";
    write("site.yaml", site.as_bytes())
}

fn work(actuators: &[&str]) -> Value {
    json!({
        "placement": {"at": {"x": 1.0, "y": 2.0}, "cost": "TravelTime", "on": "Robot"},
        "resources": {"actuators": actuators},
        "run": {"process": {"command": ["sleep", "1000"]}},
        "gracePeriodSeconds": 0,
    })
}

fn robot(name: &str, x: f64, y: f64) -> AgentOptions {
    AgentOptions::robot(name, x, y).flag("--speed", "0.5")
}

async fn placed(cluster: &Cluster, task: &str) -> (String, f64) {
    let task = cluster.task(task, "placed", |s| s.node.is_some()).await;
    let status = task.status.expect("it is placed");
    (status.node.expect("it is placed"), status.score.expect("it has a place to be at"))
}

#[tokio::test(flavor = "multi_thread")]
async fn walls_decide_which_robot_is_the_nearest_and_who_cannot_come() {
    let mut cluster = Cluster::start().await;
    let site = write(&cluster);
    for robot in [robot("behind", 1.0, 3.5), robot("along", 6.0, 2.0), robot("closet", 8.5, 1.25)] {
        cluster.join(robot).await;
    }
    // Without a Site the straight line counts.
    cluster.create("straight", work(&["base:Drive"])).await;
    assert_eq!(placed(&cluster, "straight").await, ("behind".to_owned(), 3.0));
    cluster.delete("straight").await;

    // With one the robot on this side of the wall is the nearer one.
    let said = muster(&cluster, &["apply", "-f", &site]);
    assert_eq!((said.0, said.1.as_str()), (0, "site/lab created\n"), "{}", said.2);
    let info =
        json!({"name": "near", "position": [1.0, 2.0], "radius": 50.0, "cost": "TRAVEL_TIME"});
    let mut framework = Puppet::start(&cluster, info).await;
    framework.holds("the two that can come", |o| o.len() == 2 && !o.contains_key("closet")).await;
    let along = framework.holding["along"]["score"].as_f64().expect("seconds");
    let behind = framework.holding["behind"]["score"].as_f64().expect("seconds");
    assert!((9.5..10.5).contains(&along) && behind > 35.0, "{along} {behind}");
    cluster.create("round", work(&["base:Drive"])).await;
    let (node, score) = placed(&cluster, "round").await;
    assert!(node == "along" && (score - along).abs() < 1e-9, "{node} {score}");

    // Pinned to the one in the closet, a task waits and says why; when the walls are gone, it is placed.
    let mut pinned = work(&[]);
    pinned["placement"]["node"] = "closet".into();
    cluster.create("freed", pinned).await;
    let unreachable =
        |s: &TaskStatus| s.why.iter().any(|w| w.node == "closet" && w.reason == "Unreachable");
    cluster.task("freed", "unreachable", unreachable).await;
    let why = muster(&cluster, &["why", "task/freed"]).1;
    assert!(
        why.contains("has no way to the operation position over the floor of site lab"),
        "{why}"
    );
    let (code, _, error) = muster(&cluster, &["delete", "site", "lab"]);
    assert_eq!(code, 0, "{error}");
    assert_eq!(placed(&cluster, "freed").await.0, "closet");
    framework.holds("all that are there", |o| o.contains_key("closet")).await;

    // A map that is none is refused with its place, and nothing is stored.
    std::fs::write(cluster.dir().join("lab.pgm"), b"P5 24 8 255\n").expect("writable");
    let (code, _, error) = muster(&cluster, &["apply", "-f", &site]);
    assert!(code != 0 && error.contains("site.yaml:4:18: spec.mapFile: "), "{error}");
    assert!(error.contains("lab.pgm: at byte 12: is no PGM image"), "{error}");
    let gone = wait::object(
        kube::Api::<muster_api::kind::site::Site>::all(cluster.client().await),
        "lab",
        "absent",
        |s| s.is_none(),
    );
    assert!(gone.await.is_none());
}
