//! Our master in roscore's place: rospy, roscpp's rosout, roslaunch and the tools find each other by it.

use muster_ros1::Node;
use muster_ros1::roscore::Roscore;
use muster_ros1::xmlrpc::Value;
use muster_tests::Ros;
use muster_tests::ros::registered;
use muster_tests::wait::{self, DEADLINE};
use tokio::net::TcpListener;

async fn master() -> (Ros, Roscore) {
    let listener = TcpListener::bind("127.0.0.1:0").await.expect("a port");
    let port = listener.local_addr().expect("it has one").port();
    (Ros::with_master(port), Roscore::start(listener, "127.0.0.1").expect("a master"))
}

async fn node(ros: &Ros, name: &str) -> Node {
    let node = ros.node(name).await;
    registered(&node).await;
    node
}

#[tokio::test(flavor = "multi_thread")]
async fn topics_and_tools_work() {
    let (ros, _master) = master().await;
    let strings = ["pub", "-r", "10", "/r1/chatter", "std_msgs/String", "data: one"];
    let _first = ros.spawn("rostopic", &strings);
    // Whoever subscribes before a publisher is there hears of it.
    let echo = ros.output("rostopic", &["echo", "-n", "1", "/r1/chatter"]).await;
    assert!(echo.contains("data: \"one\""), "{echo}");
    let list = ros.output("rostopic", &["list", "-v"]).await;
    assert!(list.contains(" * /r1/chatter [std_msgs/String] 1 publisher"), "{list}");
    assert_eq!(ros.output("rostopic", &["type", "/r1/chatter"]).await.trim(), "std_msgs/String");
    let nodes = ros.output("rosnode", &["list"]).await;
    assert!(nodes.starts_with("/rostopic_"), "{nodes}");
    drop(ros.output("rosnode", &["kill", nodes.trim()]).await);
    wait::until("nobody", async || {
        let nodes = ros.output("rosnode", &["list"]).await;
        if nodes.trim().is_empty() { Ok(()) } else { Err(nodes) }
    })
    .await;
}

#[tokio::test(flavor = "multi_thread")]
async fn parameters_are_set_followed_and_searched() {
    let (ros, _master) = master().await;
    let node = node(&ros, "follower").await;
    let mut speed = node.follow_param("/r1/speed").expect("a name");
    drop(ros.output("rosparam", &["set", "/r1", "{speed: 0.5, name: ada, gains: {p: 1}}"]).await);
    let told = speed.wait_for(|speed| *speed == Some(Value::Double(0.5)));
    drop(tokio::time::timeout(DEADLINE, told).await.expect("in time").expect("the node is there"));
    let list = ros.output("rosparam", &["list"]).await;
    assert_eq!(list.lines().collect::<Vec<_>>(), ["/r1/gains/p", "/r1/name", "/r1/speed"]);
    assert_eq!(ros.output("rosparam", &["get", "/r1/gains"]).await.trim(), "p: 1");
    drop(ros.output("rosparam", &["delete", "/r1"]).await);
    let told = speed.wait_for(Option::is_none);
    drop(tokio::time::timeout(DEADLINE, told).await.expect("in time").expect("the node is there"));
}

#[tokio::test(flavor = "multi_thread")]
async fn roslaunch_starts_its_nodes() {
    let (ros, _master) = master().await;
    let launch = ros.dir().join("test.launch");
    let text = r#"<launch><group ns="r1">
        <param name="speed" value="0.5"/><node pkg="rosout" type="rosout" name="logger"/>
    </group></launch>"#;
    std::fs::write(&launch, text).expect("a directory");
    let _launched = ros.spawn("roslaunch", &[&launch.display().to_string()]);
    wait::until("the node", async || {
        let nodes = ros.output("rosnode", &["list"]).await;
        if nodes.contains("/r1/logger") { Ok(()) } else { Err(nodes) }
    })
    .await;
    assert_eq!(ros.output("rosparam", &["get", "/r1/speed"]).await.trim(), "0.5");
    let info = ros.output("rosnode", &["info", "/r1/logger"]).await;
    assert!(info.contains(" * /r1/logger/get_loggers") || info.contains(" * /rosout"), "{info}");
}

#[tokio::test(flavor = "multi_thread")]
async fn a_name_is_the_newest_nodes_unless_it_is_kept() {
    let (ros, master) = master().await;
    let first = node(&ros, "twin").await;
    let first_topic = first
        .advertise::<muster_ros1::std_msgs::Empty>("/first", Default::default())
        .expect("a name");
    wait::until("the first is registered", async || {
        let list = ros.output("rostopic", &["list"]).await;
        if list.contains("/first") { Ok(()) } else { Err(list) }
    })
    .await;
    let second = node(&ros, "twin").await;
    let topic = second.advertise::<muster_ros1::std_msgs::Empty>("/second", Default::default());
    let _topic = topic.expect("a name");
    let why = tokio::time::timeout(DEADLINE, first.ended()).await.expect("in time");
    assert!(why.contains("new node registered with same name"), "{why}");
    drop((first_topic, first));
    master.keep("/muster", second.api());
    let mut evict = ros.script("intrude.py", &["evict", "/muster"]);
    assert_eq!(evict.line().await, "-1");
    assert_eq!(
        second.master().lookup_node("/muster").await.expect("it is known"),
        second.api().to_string()
    );
}
