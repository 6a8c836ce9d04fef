//! Frameworks against a controller that does what the test tells it.

mod common;

use std::time::Duration;

use common::{Controller, SELDOM_MS, Session, soon};
use muster_api::wire::framework::v1 as proto;
use muster_sdk::{
    ConnectError, Event, EventStream, Filter, Framework, FrameworkError, FrameworkHandle, Launch,
    Position, Reason, Scheduler, SchedulerDriver,
};
use proto::call::Call as Say;
use proto::event::Event as Tell;
use tokio::sync::mpsc;
use tokio::task::JoinHandle;

async fn next(events: &mut EventStream) -> Event {
    soon(events.next()).await.expect("an event")
}

/// A registered framework of the id `f1`.
async fn registered(controller: &mut Controller) -> (FrameworkHandle, EventStream, Session) {
    let (handle, mut events) = Framework::builder("deliver")
        .position(3.0, 4.0)
        .radius(20.0)
        .filter(Filter::robots().free_actuators())
        .failover_timeout(Duration::from_millis(2500))
        .state_file(controller.path("state"))
        .connect(Some(&controller.kubeconfig()))
        .await
        .expect("configured");
    let mut session = controller.session().await;
    let subscribe = session.subscribe("f1", SELDOM_MS).await;
    assert_eq!((subscribe.name.as_str(), subscribe.namespace.as_str()), ("deliver", "team"));
    assert_eq!(subscribe.framework_id, "");
    assert_eq!(subscribe.position.expect("a position").radius, Some(20.0));
    assert!(subscribe.filter.expect("a filter").any_actuator);
    assert_eq!(subscribe.failover_timeout_seconds, Some(2.5));
    assert_eq!(next(&mut events).await, Event::Registered { framework_id: "f1".to_owned() });
    (handle, events, session)
}

fn offer(id: &str) -> proto::Offer {
    proto::Offer { id: id.to_owned(), node: "tb1".to_owned(), ..proto::Offer::default() }
}

fn update(version: u64, state: proto::TaskState) -> proto::Update {
    let state = state.into();
    proto::Update { task: "t1".to_owned(), version, state, ..proto::Update::default() }
}

#[tokio::test]
async fn offers_are_launched_on_and_the_answer_comes_back() {
    let mut controller = Controller::start().await;
    let (handle, mut events, mut session) = registered(&mut controller).await;
    session.say(Tell::Offers(proto::Offers { offers: vec![offer("1"), offer("2")] })).await;
    let Event::Offers(offers) = next(&mut events).await else { panic!("no offers") };
    let launch = |offer| Launch::process(["true"]).cpu("500m").on(offer);
    let launches = [launch(&offers[0]), launch(&offers[1]).name("b"), launch(&offers[0])];
    let controller_side = async {
        let (id, Say::Accept(accept)) = session.call().await else { panic!("no Accept") };
        assert_eq!(accept.offers, ["1", "2"]);
        assert_eq!(accept.launches.len(), 3);
        let name = |name: &str| proto::Launched { name: name.to_owned(), ..Default::default() };
        session.answer(id, vec![name("a"), name("b"), name("c")]).await;
    };
    let (launched, ()) = tokio::join!(handle.launch_tasks(launches), controller_side);
    let names: Vec<String> = launched.expect("done").into_iter().map(|l| l.name).collect();
    assert_eq!(names, ["a", "b", "c"]);
}

#[tokio::test]
async fn a_refusal_says_what_is_wrong_where() {
    let mut controller = Controller::start().await;
    let (handle, _events, mut session) = registered(&mut controller).await;
    let controller_side = async {
        let (id, _) = session.call().await;
        let cause = proto::Cause { field: "launches[0].spec".into(), message: "no".into() };
        let refusal = proto::Refusal {
            reason: proto::RefusalReason::OfferGone.into(),
            message: "not offered (any more): 1".to_owned(),
            causes: vec![cause],
        };
        session
            .say(Tell::Answer(proto::Answer { id, refusal: Some(refusal), ..Default::default() }))
            .await;
    };
    let launch = Launch::process(["true"]).on(&offer("1"));
    let (refused, ()) = tokio::join!(handle.launch_tasks([launch]), controller_side);
    let refused = refused.expect_err("refused");
    assert_eq!(refused.reason, Reason::OfferGone);
    assert_eq!(refused.causes[0].field, "launches[0].spec");
    assert_eq!(refused.to_string(), "the offer is gone: not offered (any more): 1");
}

/// Passes on what it is called back with.
struct Recorder(mpsc::UnboundedSender<String>);

impl Recorder {
    fn note(&self, what: impl Into<String>) {
        self.0.send(what.into()).expect("a test");
    }
}

impl Scheduler for Recorder {
    async fn registered(&mut self, _: &FrameworkHandle, framework_id: &str) {
        self.note(format!("registered {framework_id}"));
    }

    async fn status_update(&mut self, _: &FrameworkHandle, update: &proto::Update) {
        self.note(format!("{} {:?}", update.version, update.state()));
    }

    async fn framework_message(&mut self, handle: &FrameworkHandle, message: proto::Message) {
        let sent = handle.send_framework_message(&message.executor, message.data).await;
        self.note(format!("sent back {sent:?}"));
    }

    async fn error(&mut self, _: &FrameworkHandle, error: &FrameworkError) {
        self.note(error.to_string());
    }
}

/// A framework that is run by a driver.
async fn driven(
    controller: &mut Controller,
) -> (Session, mpsc::UnboundedReceiver<String>, JoinHandle<Result<(), FrameworkError>>) {
    let (handle, events) = Framework::builder("deliver")
        .connect(Some(&controller.kubeconfig()))
        .await
        .expect("configured");
    let (note, mut notes) = mpsc::unbounded_channel();
    let driver = tokio::spawn(SchedulerDriver::new(handle, events).run(Recorder(note)));
    let mut session = controller.session().await;
    session.subscribe("f1", SELDOM_MS).await;
    assert_eq!(soon(notes.recv()).await.expect("a note"), "registered f1");
    (session, notes, driver)
}

#[tokio::test]
async fn an_update_is_called_back_once_and_acknowledged_whenever_it_is_repeated() {
    let mut controller = Controller::start().await;
    let (mut session, mut notes, driver) = driven(&mut controller).await;
    for _ in 0..3 {
        session.say(Tell::Update(update(7, proto::TaskState::Running))).await;
        let (id, Say::Acknowledge(ack)) = session.call().await else { panic!("no Acknowledge") };
        assert_eq!((id.as_str(), ack.task.as_str(), ack.version), ("", "t1", 7));
    }
    session.say(Tell::Update(update(9, proto::TaskState::Failed))).await;
    assert_eq!(soon(notes.recv()).await.expect("a note"), "7 Running");
    assert_eq!(soon(notes.recv()).await.expect("a note"), "9 Failed");
    let cut = proto::Error { reason: "Cut".to_owned(), message: "another one".to_owned() };
    session.say(Tell::Error(cut)).await;
    let error = soon(driver).await.expect("no panic").expect_err("cut");
    assert_eq!(error.reason, "Cut");
    assert_eq!(soon(notes.recv()).await.expect("a note"), "Cut: another one");
    assert_eq!(notes.recv().await, None, "nothing was called back twice");
}

#[tokio::test]
async fn a_run_that_has_not_heard_its_id_is_known_by_its_nonce() {
    let mut controller = Controller::start().await;
    let framework = Framework::builder("deliver").connect(Some(&controller.kubeconfig())).await;
    let (_handle, mut events) = framework.expect("configured");
    let mut lost = controller.session().await;
    let (_, Say::Subscribe(first)) = lost.call().await else { panic!("no Subscribe") };
    drop(lost);
    let again = controller.session().await.subscribe("f1", SELDOM_MS).await;
    assert!(!first.nonce.is_empty());
    assert_eq!((again.framework_id.as_str(), again.nonce), ("", first.nonce));
    assert_eq!(next(&mut events).await, Event::Registered { framework_id: "f1".to_owned() });
}

#[tokio::test]
async fn messages_of_four_mebibytes_pass_both_ways() {
    let mut controller = Controller::start().await;
    let (mut session, mut notes, _driver) = driven(&mut controller).await;
    let data = bytes::Bytes::from(vec![7; 4 << 20]);
    let (executor, node) = ("e".into(), "tb1".into());
    let message = proto::Message { executor, node, data: data.clone(), mark: 0 };
    session.say(Tell::Message(message)).await;
    let (id, Say::Message(back)) = session.call().await else { panic!("no Message") };
    assert_eq!((back.executor.as_str(), back.data == data), ("e", true));
    session.answer(id, Vec::new()).await;
    assert_eq!(soon(notes.recv()).await.expect("a note"), "sent back Ok(())");
}

#[tokio::test]
async fn a_framework_comes_back_with_its_id_and_its_wishes() {
    let mut controller = Controller::start().await;
    let (handle, mut events, mut session) = registered(&mut controller).await;
    let wish = async {
        let moved = handle.set_position(Some(Position::at(8.0, 9.0))).await;
        (moved, handle.suppress_offers().await)
    };
    let controller_side = async {
        for _ in 0..2 {
            let (id, _) = session.call().await;
            session.answer(id, Vec::new()).await;
        }
    };
    let (done, ()) = tokio::join!(wish, controller_side);
    assert_eq!(done, (Ok(()), Ok(())));
    session.say(Tell::Update(update(3, proto::TaskState::Running))).await;
    assert!(matches!(next(&mut events).await, Event::Update(_)));

    // What is under way when the stream breaks: a launch fails, a kill is said again.
    let launch = tokio::spawn({
        let handle = handle.clone();
        async move { handle.launch_tasks([Launch::process(["true"])]).await }
    });
    assert!(matches!(session.call().await.1, Say::Accept(_)));
    let kill = tokio::spawn({
        let handle = handle.clone();
        async move { handle.kill_task("t1", Some(Duration::from_millis(1))).await }
    });
    assert!(matches!(session.call().await.1, Say::Kill(_)));
    drop(session);
    assert_eq!(next(&mut events).await, Event::Disconnected);
    let refused = soon(launch).await.expect("no panic").expect_err("nobody answers");
    assert_eq!(refused.reason, Reason::Disconnected);

    let mut session = controller.session().await;
    let subscribe = session.subscribe("f1", SELDOM_MS).await;
    assert_eq!(subscribe.framework_id, "f1");
    assert_eq!(subscribe.position.expect("a position").x, 8.0);
    assert_eq!(next(&mut events).await, Event::Reregistered);
    assert!(matches!(session.call().await.1, Say::Suppress(_)));
    let (id, Say::Kill(again)) = session.call().await else { panic!("no Kill") };
    assert_eq!(again.grace_period_seconds, Some(1), "rounded up");
    session.answer(id, Vec::new()).await;
    assert_eq!(soon(kill).await.expect("no panic"), Ok(()));

    // The update was handed out before and is still being worked on; what is asked for comes again.
    session.say(Tell::Update(update(3, proto::TaskState::Running))).await;
    let (asked, ()) = tokio::join!(handle.reconcile_tasks([]), async {
        let (id, _) = session.call().await;
        session.say(Tell::Update(update(3, proto::TaskState::Running))).await;
        session.answer(id, Vec::new()).await;
    });
    assert_eq!(asked, Ok(()));
    session.say(Tell::Offers(proto::Offers::default())).await;
    assert!(matches!(next(&mut events).await, Event::Update(_)));
    assert!(matches!(next(&mut events).await, Event::Offers(_)), "not twice");
}

#[tokio::test]
async fn a_silent_connection_is_given_up() {
    let mut controller = Controller::start().await;
    let (_handle, mut events) = Framework::builder("deliver")
        .connect(Some(&controller.kubeconfig()))
        .await
        .expect("configured");
    let mut silent = controller.session().await;
    // Heartbeats are due twenty times a second, and none comes.
    silent.subscribe("f1", 50).await;
    assert!(matches!(next(&mut events).await, Event::Registered { .. }));
    assert_eq!(next(&mut events).await, Event::Disconnected);
    silent.left().await;
    let mut session = controller.session().await;
    assert_eq!(session.subscribe("f1", SELDOM_MS).await.framework_id, "f1");
    assert_eq!(next(&mut events).await, Event::Reregistered);
}

#[tokio::test]
async fn the_next_run_takes_over_and_a_torn_down_framework_is_forgotten() {
    let mut controller = Controller::start().await;
    let (handle, mut events, mut session) = registered(&mut controller).await;
    assert_eq!(handle.stop(true).await, Ok(()));
    session.left().await;
    assert_eq!(soon(events.next()).await, None);
    assert_eq!(handle.revive_offers().await.expect_err("over").reason, Reason::Ended);

    let builder = Framework::builder("deliver").state_file(controller.path("state"));
    let (handle, mut events) =
        builder.connect(Some(&controller.kubeconfig())).await.expect("configured");
    let mut session = controller.session().await;
    assert_eq!(session.subscribe("f1", SELDOM_MS).await.framework_id, "f1");
    assert_eq!(next(&mut events).await, Event::Reregistered);
    let (stopped, ()) = tokio::join!(handle.stop(false), async {
        let (id, Say::Teardown(_)) = session.call().await else { panic!("no Teardown") };
        session.answer(id, Vec::new()).await;
    });
    assert_eq!(stopped, Ok(()));
    assert_eq!(soon(events.next()).await, None);
    assert!(!controller.path("state").exists());
}

#[tokio::test]
async fn an_id_of_an_earlier_run_that_is_not_known_any_more_is_given_up() {
    let mut controller = Controller::start().await;
    std::fs::write(controller.path("state"), "old\n").expect("written");
    let builder = Framework::builder("deliver").state_file(controller.path("state"));
    let (_handle, mut events) =
        builder.connect(Some(&controller.kubeconfig())).await.expect("configured");
    let mut session = controller.session().await;
    let (_, Say::Subscribe(subscribe)) = session.call().await else { panic!("no Subscribe") };
    assert_eq!(subscribe.framework_id, "old");
    let error = proto::Error { reason: "UnknownFramework".to_owned(), message: String::new() };
    session.say(Tell::Error(error)).await;
    let mut session = controller.session().await;
    assert_eq!(session.subscribe("new", SELDOM_MS).await.framework_id, "");
    assert_eq!(next(&mut events).await, Event::Registered { framework_id: "new".to_owned() });
    assert_eq!(std::fs::read_to_string(controller.path("state")).expect("kept"), "new\n");
}

#[tokio::test]
async fn who_was_away_for_too_long_begins_anew_and_who_is_ended_does_not() {
    let mut controller = Controller::start().await;
    let (_handle, mut events, session) = registered(&mut controller).await;
    drop(session);
    assert_eq!(next(&mut events).await, Event::Disconnected);
    let unknown = || proto::Error { reason: "UnknownFramework".to_owned(), message: String::new() };
    let mut session = controller.session().await;
    let (_, Say::Subscribe(_)) = session.call().await else { panic!("no Subscribe") };
    session.say(Tell::Error(unknown())).await;
    let mut session = controller.session().await;
    assert_eq!(session.subscribe("f2", SELDOM_MS).await.framework_id, "");
    assert_eq!(next(&mut events).await, Event::Registered { framework_id: "f2".to_owned() });
    session.say(Tell::Error(unknown())).await;
    assert!(
        matches!(next(&mut events).await, Event::Error(error) if error.reason == "UnknownFramework")
    );
}

#[tokio::test]
async fn positions_follow_their_source() {
    let mut controller = Controller::start().await;
    let (handle, _events, mut session) = registered(&mut controller).await;
    let (clicks, source) = mpsc::channel(4);
    for x in [1.0, 2.0] {
        clicks.send(Position::at(x, 0.0).radius(5.0)).await.expect("room");
    }
    drop(clicks);
    let controller_side = async {
        for x in [1.0, 2.0] {
            let (id, Say::SetPosition(new)) = session.call().await else { panic!("no position") };
            assert_eq!(new.position.expect("a position").x, x);
            session.answer(id, Vec::new()).await;
        }
    };
    let (followed, ()) = tokio::join!(handle.follow(source), controller_side);
    assert_eq!(followed, Ok(()));
}

#[tokio::test]
async fn what_cannot_begin_says_why() {
    let controller = Controller::start().await;
    let config = controller.kubeconfig();
    let error = Framework::builder("d").radius(3.0).connect(Some(&config)).await;
    assert!(matches!(error, Err(ConnectError::RadiusWithoutPosition)));
    let error = Framework::builder("d").connect(Some(&controller.path("none"))).await;
    assert!(matches!(error, Err(ConnectError::Kubeconfig(_))));
    let error = Framework::builder("d").state_file("/").connect(Some(&config)).await;
    assert!(matches!(error, Err(ConnectError::StateFile { .. })));
}
