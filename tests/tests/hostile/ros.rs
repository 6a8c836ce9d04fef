use bytes::Bytes;
use muster_ros1::Message;
use muster_ros1::layout::Layout;
use muster_ros1::message::describe;
use muster_ros1::registry::Registry;
use muster_ros1::tcpros::Header;
use muster_ros1::wire::Wire;
use muster_ros1::xmlrpc;
use muster_ros1::{nav_msgs, sensor_msgs, tf2_msgs};

#[test]
fn calls_and_answers_are_read_as_they_are_written() {
    let inputs = muster_hostile::inputs("xmlrpc");
    muster_hostile::feed(bolero::check!(), inputs, |bytes| {
        let text = String::from_utf8_lossy(bytes);
        // Written once, there is nothing in it any more that XML has no way to write.
        let call =
            |text: &str| xmlrpc::call(text).map(|c| xmlrpc::write_call(&c.method, &c.params));
        if let Ok(once) = call(&text) {
            assert_eq!(call(&once), Ok(once));
        }
        let answer = |text: &str| xmlrpc::answer(text).map(|answer| xmlrpc::write_answer(&answer));
        if let Ok(once) = answer(&text) {
            assert_eq!(answer(&once), Ok(once));
        }
    });
}

#[test]
fn a_master_answers_whatever_is_said() {
    let inputs = muster_hostile::inputs("xmlrpc");
    muster_hostile::feed(bolero::check!(), inputs, |bytes| {
        let Ok(call) = xmlrpc::call(&String::from_utf8_lossy(bytes)) else { return };
        let mut master = Registry::new("http://127.0.0.1:11311/", 1);
        let first = master.handle(&call);
        // Whoever it was, others are answered still.
        let state = xmlrpc::Call { method: "getSystemState".into(), params: vec!["/x".into()] };
        assert!(master.handle(&state).answer.is_ok(), "{first:?}");
    });
}

#[test]
fn connection_headers_are_read_as_they_are_written() {
    let subscriber = Header::new([
        ("callerid", "/listener"),
        ("topic", "/scan"),
        ("md5sum", "*"),
        ("type", "*"),
    ]);
    let inputs = muster_hostile::inputs("headers").and([subscriber.encode()[4..].to_vec()]);
    muster_hostile::feed(bolero::check!(), inputs, |bytes| {
        let Ok(header) = Header::decode(bytes) else { return };
        let again = Header::decode(&header.encode()[4..]).expect("it is a header");
        assert_eq!(format!("{again:?}"), format!("{header:?}"));
        assert_eq!(again.get("topic"), header.get("topic"));
    });
}

/// What decodes is encoded so that it decodes the same.
fn there_and_back<M: Message + std::fmt::Debug>(bytes: &Bytes) {
    let layout = Layout::of(&describe::<M>());
    assert_eq!(layout.check(bytes).is_ok(), M::decode(bytes.clone()).is_ok(), "{}", M::TYPE);
    if let Ok(message) = M::decode(bytes.clone()) {
        let again = M::decode(message.encode().into()).expect("it is one of ours");
        assert_eq!(format!("{again:?}"), format!("{message:?}"), "{}", M::TYPE);
    }
}

#[test]
fn messages_are_decoded_as_they_are_encoded() {
    let mut scan = sensor_msgs::LaserScan::nothing();
    scan.header.frame_id = "base_scan".to_owned();
    scan.ranges = vec![1.5; 9];
    let mut image = sensor_msgs::Image::nothing();
    (image.width, image.height, image.step, image.data) = (4, 2, 4, vec![7; 8].into());
    let mut odometry = nav_msgs::Odometry::nothing();
    odometry.child_frame_id = "base_link".to_owned();
    let mut moved = tf2_msgs::TFMessage::nothing();
    moved.transforms = vec![Wire::nothing()];
    let seeds = [scan.encode(), image.encode(), odometry.encode(), moved.encode()];
    let inputs = muster_hostile::inputs("headers").and(seeds);
    muster_hostile::feed(bolero::check!(), inputs, |bytes| {
        let bytes = Bytes::copy_from_slice(bytes);
        there_and_back::<sensor_msgs::LaserScan>(&bytes);
        there_and_back::<sensor_msgs::Image>(&bytes);
        there_and_back::<nav_msgs::Odometry>(&bytes);
        there_and_back::<tf2_msgs::TFMessage>(&bytes);
    });
}
