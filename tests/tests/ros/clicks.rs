//! Who clicks in rviz says where a framework works (Avalon, IV-A3).

use muster_sdk::{Event, Framework};
use muster_tests::cluster::binary;
use muster_tests::wait::DEADLINE;
use muster_tests::{AgentOptions, Cluster, Ros};

#[tokio::test(flavor = "multi_thread")]
async fn a_click_moves_a_framework_to_the_robots_near_there() {
    let ros = Ros::start().await;
    let mut cluster = Cluster::start().await;
    for (name, x) in [("near", 0.0), ("far", 10.0)] {
        let options = AgentOptions::robot(name, x, 0.0).flag("--docker-socket", "none");
        cluster.join(options).await;
    }
    let kubeconfig = cluster.kubeconfig();
    let framework = Framework::builder("deliver").position(0.0, 0.0).radius(3.0);
    let (_handle, mut events) = framework.connect(Some(&kubeconfig)).await.expect("it connects");
    let mut next = async || {
        let next = tokio::time::timeout(DEADLINE, events.next());
        next.await.expect("something is said").expect("the framework goes on")
    };
    while !matches!(next().await, Event::Offers(offers) if offers[0].node == "near") {}

    let muster = binary("muster").display().to_string();
    let config = kubeconfig.display().to_string();
    let follow = ["--kubeconfig", &config, "framework", "set-position", "deliver", "--clicked"];
    let mut clicks = ros.spawn(&muster, &follow);
    let click = "{header: {frame_id: map}, point: {x: 10.5, y: 0.0, z: 0.0}}";
    let topic = ["pub", "/clicked_point", "geometry_msgs/PointStamped", click];
    let _latched = ros.spawn("rostopic", &topic);
    let said = clicks.line().await;
    assert_eq!(said, "framework/deliver works at (10.50, 0.00) of map \"map\", within 3.00 m");
    let moved = loop {
        if let Event::Moved(moved) = next().await {
            break moved;
        }
    };
    let position = moved.position.expect("it works somewhere");
    assert_eq!((position.x, position.radius, &*position.map), (10.5, Some(3.0), "map"));
    assert!(!moved.by.is_empty());
    loop {
        if let Event::Offers(offers) = next().await {
            let nodes: Vec<&str> = offers.iter().map(|offer| &*offer.node).collect();
            assert_eq!(nodes, ["far"], "offers of the new place alone");
            assert_eq!(offers[0].score, Some(0.5));
            break;
        }
    }
}
