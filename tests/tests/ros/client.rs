//! The client by itself: types, messages both ways, restarts.

use std::time::Duration;

use bytes::Bytes;
use muster_ros1::ALL;
use muster_ros1::geometry_msgs::{Point, PointStamped, Twist, Vector3};
use muster_ros1::nav_msgs::Odometry;
use muster_ros1::node::{MasterState, PublishOptions, SubscribeOptions};
use muster_ros1::sensor_msgs::Image;
use muster_ros1::std_msgs::{self, Header};
use muster_ros1::xmlrpc::Value;
use muster_tests::Ros;
use muster_tests::ros::registered;
use muster_tests::wait::{self, DEADLINE};

/// An image as `image.py` makes it.
fn image() -> Image {
    let (width, height) = (1920u32, 1080u32);
    let data: Bytes = (0..width * height * 3).map(|n| (n % 251) as u8).collect();
    let header = Header { frame_id: "camera".to_owned(), ..Header::default() };
    Image {
        header,
        height,
        width,
        encoding: "rgb8".to_owned(),
        is_bigendian: 0,
        step: width * 3,
        data,
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn checksums_are_those_of_rosmsg() {
    let ros = Ros::start().await;
    // Debian has no definitions of rosgraph_msgs apart from the generated code.
    let known: Vec<_> = ALL.iter().filter(|d| !d.name.starts_with("rosgraph_msgs/")).collect();
    let names: Vec<&str> = known.iter().map(|d| d.name).collect();
    assert!(names.len() > 60, "{names:?}");
    let mut rosmsg = ros.script("md5.py", &names);
    for description in known {
        assert_eq!(rosmsg.line().await, format!("{} {}", description.name, description.md5));
    }
    let clock = ros.output(
        "/usr/bin/python3",
        &["-c", "from rosgraph_msgs.msg import Clock; print(Clock._md5sum)"],
    );
    let ours = ALL.iter().find(|d| d.name == "rosgraph_msgs/Clock").expect("it is known");
    assert_eq!(clock.await.trim(), ours.md5);
}

#[tokio::test(flavor = "multi_thread")]
async fn rostopic_and_this_client_read_each_other() {
    let ros = Ros::start().await;
    let node = ros.node("talker").await;
    let publisher = node
        .advertise::<PointStamped>(
            "/clicked",
            PublishOptions { latch: true, queue: 1, ..Default::default() },
        )
        .unwrap();
    let header = Header {
        seq: 0,
        stamp: muster_ros1::time::Time { sec: 5, nsec: 250 },
        frame_id: "map".to_owned(),
    };
    publisher.publish(&PointStamped { header, point: Point { x: 1.5, y: -2.25, z: 1e-9 } });
    registered(&node).await;
    let echo = ros.output("rostopic", &["echo", "-n", "1", "/clicked"]).await;
    for line in
        ["secs: 5", "nsecs:       250", "frame_id: \"map\"", "x: 1.5", "y: -2.25", "z: 1e-09"]
    {
        assert!(echo.contains(line), "{line}: {echo}");
    }
    assert_eq!(
        ros.output("rostopic", &["type", "/clicked"]).await.trim(),
        "geometry_msgs/PointStamped"
    );

    let mut twists = node.subscribe::<Twist>("cmd_vel", SubscribeOptions::default()).unwrap();
    let twist = "{linear: {x: 0.5}, angular: {z: -1.25}}";
    let _pub =
        ros.spawn("rostopic", &["pub", "-r", "20", "/cmd_vel", "geometry_msgs/Twist", twist]);
    let (received, how) =
        tokio::time::timeout(DEADLINE, twists.next()).await.expect("in time").expect("a Twist");
    let of = |x, z| Vector3 { x, y: 0.0, z };
    assert_eq!(received, Twist { linear: of(0.5, 0.0), angular: of(0.0, -1.25) });
    assert!(how.from.caller.starts_with("/rostopic_") && how.from.kind == "geometry_msgs/Twist");

    // The slave API, as rosnode uses it.
    let info = ros.output("rosnode", &["info", "/talker"]).await;
    assert!(info.contains(" * /clicked [geometry_msgs/PointStamped]"), "{info}");
    assert!(info.contains(" * /cmd_vel [geometry_msgs/Twist]"), "{info}");
    assert!(info.contains("direction: inbound") && info.contains("transport: TCPROS"), "{info}");
    let counted = node.count("/tf", Duration::from_millis(500)).unwrap();
    assert_eq!(counted.hertz(), None, "not watched for so long yet");
    drop(ros.output("rosnode", &["kill", "/talker"]).await);
    let why = tokio::time::timeout(DEADLINE, node.ended()).await.expect("in time");
    assert!(why.contains("user request"), "{why}");
}

#[tokio::test(flavor = "multi_thread")]
async fn large_images_pass_both_ways() {
    let ros = Ros::start().await;
    let node = ros.node("eye").await;
    let mut publisher = ros.script("image.py", &["publish"]);
    let checksum = publisher.line().await;
    let mut images = node.subscribe::<Image>("/image", SubscribeOptions::default()).unwrap();
    let (received, how) =
        tokio::time::timeout(DEADLINE, images.next()).await.expect("in time").expect("an Image");
    assert_eq!(how.from.caller, "/image_publish");
    assert!(
        received == Image { header: received.header.clone(), ..image() },
        "it is as it was sent"
    );
    assert_eq!(received.header.frame_id, "camera");
    publisher.kill().await;
    drop(images);

    let mut checker = ros.script("image.py", &["check"]);
    checker.line_with("ready").await;
    let publisher = node.advertise::<Image>("/image", PublishOptions::default()).unwrap();
    wait::until("connected", || async {
        (publisher.subscribers() > 0).then_some(()).ok_or_else(String::new)
    })
    .await;
    publisher.publish(&image());
    assert_eq!(checker.line().await, format!("1920 1080 camera {checksum}"));
}

#[tokio::test(flavor = "multi_thread")]
async fn a_type_that_does_not_fit_is_told_and_not_read() {
    let ros = Ros::start().await;
    let node = ros.node("reader").await;
    let _pub = ros.spawn("rostopic", &["pub", "-r", "20", "/odom", "std_msgs/String", "data: x"]);
    let wrong = node.subscribe::<Odometry>("/odom", SubscribeOptions::default()).unwrap();
    wait::until("refused for its type", || async {
        let status = wrong.status();
        let refused = status.trouble.as_ref().is_some_and(|t| t.contains("std_msgs/String"));
        if refused { Ok(()) } else { Err(format!("{status:?}")) }
    })
    .await;
    assert_eq!(wrong.status().connected, 0);
    drop(wrong);
    let mut any = node.subscribe_any("/odom", SubscribeOptions::default()).unwrap();
    let incoming = tokio::time::timeout(DEADLINE, any.next()).await.expect("in time");
    assert_eq!(incoming.from.kind, "std_msgs/String");
}

#[tokio::test(flavor = "multi_thread")]
async fn restarts_of_master_and_publisher_are_survived() {
    let ros = Ros::start().await;
    let node = ros.node("survivor").await;
    let mut strings =
        node.subscribe::<std_msgs::String>("/chatter", SubscribeOptions::default()).unwrap();
    let publisher = node.advertise::<std_msgs::Int32>("/count", PublishOptions::default()).unwrap();
    let mut first =
        ros.spawn("rostopic", &["pub", "-r", "20", "/chatter", "std_msgs/String", "data: first"]);
    let mut next = async || {
        let (message, _) = tokio::time::timeout(DEADLINE, strings.next())
            .await
            .expect("in time")
            .expect("a String");
        message.data
    };
    assert_eq!(next().await, "first");
    // A publisher that dies without a word stays in the master's list; the next one is heard all the same.
    first.kill().await;
    let mut second =
        ros.spawn("rostopic", &["pub", "-r", "20", "/chatter", "std_msgs/String", "data: second"]);
    while next().await != "second" {}
    second.kill().await;

    let mut state = node.state();
    ros.kill_core();
    let gone = state.wait_for(|state| matches!(state, MasterState::Gone { .. }));
    drop(tokio::time::timeout(DEADLINE, gone).await.expect("in time").expect("the node is there"));
    ros.start_core().await;
    registered(&node).await;
    // The new master knows nothing of what was before, but what this node told it again.
    let _third =
        ros.spawn("rostopic", &["pub", "-r", "20", "/chatter", "std_msgs/String", "data: third"]);
    while next().await != "third" {}
    let mut echo = ros.spawn("rostopic", &["echo", "/count"]);
    wait::until("connected", || async {
        (publisher.subscribers() > 0).then_some(()).ok_or_else(String::new)
    })
    .await;
    publisher.publish(&std_msgs::Int32 { data: 42 });
    assert_eq!(echo.line().await, "data: 42");

    // What is not wanted any more is taken back.
    node.shut_down().await;
    drop(publisher);
    let listed = async || ros.output("rosnode", &["list"]).await.contains("/survivor");
    let mut tries = 0;
    // A master on a busy machine may not have answered in time: once more.
    while listed().await {
        tries += 1;
        assert!(tries < 4, "it stays listed");
        let again = ros.node("survivor").await;
        let options = SubscribeOptions::default();
        let _strings = again.subscribe::<std_msgs::String>("/chatter", options).unwrap();
        registered(&again).await;
        again.shut_down().await;
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn parameters_are_read_and_followed() {
    let ros = Ros::start().await;
    let node = ros.node("settings").await;
    let master = node.master();
    assert!(!master.has_param("/speed").await.unwrap());
    assert!(master.param("/speed").await.unwrap_err().is_refusal());
    master.set_param("/speed", Value::Double(0.5)).await.unwrap();
    assert_eq!(ros.output("rosparam", &["get", "/speed"]).await.trim(), "0.5");
    assert_eq!(master.search_param("speed").await.unwrap(), "/speed");
    let mut speed = node.follow_param("/speed").unwrap();
    let mut until = async |wanted: Option<Value>| {
        let followed = speed.wait_for(|value| *value == wanted);
        drop(
            tokio::time::timeout(DEADLINE, followed)
                .await
                .expect("in time")
                .expect("the node is there"),
        );
    };
    until(Some(Value::Double(0.5))).await;
    drop(ros.output("rosparam", &["set", "/speed", "[1, two]"]).await);
    until(Some(Value::Array(vec![Value::Int(1), "two".into()]))).await;
    drop(ros.output("rosparam", &["delete", "/speed"]).await);
    until(None).await;
    // roscore says that it has started `rosout` when there is a process; that registers later.
    wait::until("rosout is registered", || async {
        let state = master.system_state().await.map_err(|error| error.to_string())?;
        let has = |users: &[(String, Vec<String>)], topic: &str| {
            users.iter().any(|(t, nodes)| t == topic && nodes.iter().any(|n| n == "/rosout"))
        };
        let there = has(&state.subscribers, "/rosout") && has(&state.publishers, "/rosout_agg");
        if there { Ok(()) } else { Err(format!("{state:?}")) }
    })
    .await;
    let types = master.topic_types().await.unwrap();
    assert!(types.contains(&("/rosout".to_owned(), "rosgraph_msgs/Log".to_owned())), "{types:?}");
    let state = master.system_state().await.unwrap();
    assert!(
        state.subscribers.iter().any(|(topic, nodes)| topic == "/rosout" && nodes == &["/rosout"])
    );
    assert!(master.pid().await.unwrap() > 1);
    assert!(
        master.published_topics("").await.unwrap().iter().any(|(topic, _)| topic == "/rosout_agg")
    );
    let found = master.lookup_node("/rosout").await.unwrap();
    assert!(found.starts_with("http://127.0.0.1:"), "{found}");
    assert!(master.lookup_node("/nobody").await.unwrap_err().is_refusal());
}
