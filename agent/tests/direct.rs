//! Messages of frameworks that come directly, under a real agent: who is let in, and what holds when it breaks.

#![expect(clippy::unwrap_used, reason = "tests")]

mod common;

use common::agent::Agent;
use common::controller::Controller;
use common::executor::Executor;
use common::framework::Framework;
use common::until;
use muster_api::direct::frame::{Header, Kind};
use muster_api::wire::agent::v1 as agent_proto;
use muster_api::wire::executor::v1 as proto;
use proto::call::Call as Say;
use proto::event::Event as Heard;
use serde_json::json;

const SECRET: [u8; 32] = [7; 32];

/// An agent with an executor whose framework may come directly.
fn ready(controller: &Controller, agent: &Agent) -> Executor {
    let spec = json!({ "run": { "process": { "command": ["sleep", "1000"] } } });
    controller.assign_with(agent_proto::Assignment {
        uid: "exec".to_owned(),
        namespace: "lab".to_owned(),
        name: "exec".to_owned(),
        spec: serde_json::to_vec(&spec).unwrap(),
        framework: Some(agent_proto::Framework { id: "f-1".to_owned(), name: "crew".to_owned() }),
        ..Default::default()
    });
    assert_eq!(controller.door(), None, "nobody listens without an executor");
    let executor = Executor::register(agent, "exec", &[]);
    until("the executor", || {
        controller.executors().last().is_some_and(|last| *last == ["exec"]).then_some(())
    });
    controller.ticket("exec", Some(SECRET));
    executor
}

#[track_caller]
fn hears(executor: &mut Executor, expected: &[u8]) {
    let Heard::Message(message) = executor.hear() else { panic!("no message") };
    assert!(message.data == expected, "{} bytes", message.data.len());
}

fn say(executor: &mut Executor, data: &[u8]) {
    executor.say(Say::Message(proto::Message { data: data.to_vec().into() }));
}

/// What executors said through the controller, without marks.
fn relayed(controller: &Controller) -> Vec<Vec<u8>> {
    let messages = controller.messages().into_iter().filter(|message| message.mark == 0);
    messages.map(|message| message.data.to_vec()).collect()
}

#[test]
fn a_framework_comes_and_a_message_that_breaks_off_is_none() {
    let controller = Controller::start();
    let agent = Agent::start(&controller);
    let mut executor = ready(&controller, &agent);
    controller.message("exec", b"before".to_vec());
    hears(&mut executor, b"before");
    let mut framework = Framework::come(&controller, 5, SECRET);
    let large = vec![3; 4 << 20];
    for (number, data) in [(1, &large[..]), (2, b"second")] {
        framework.say(Kind::Message, number, data);
        hears(&mut executor, data);
        assert_eq!(framework.hear().unwrap().0, Header::bare(Kind::Taken, number));
    }
    say(&mut executor, &large);
    say(&mut executor, b"fourth");
    assert!(framework.hear().unwrap().1 == large);
    assert_eq!(framework.hear().unwrap().1, b"fourth");
    assert_eq!(relayed(&controller), Vec::<Vec<u8>>::new());

    // Half of a message, and the connection is gone.
    framework.begin(Kind::Message, 3, 1 << 20, &large[..1 << 19]);
    drop(framework);
    controller.message("exec", b"after".to_vec());
    hears(&mut executor, b"after");
    until("the way back", || {
        say(&mut executor, b"back");
        (!relayed(&controller).is_empty()).then_some(())
    });

    // It comes again; a relayed message shows that it has left.
    let mut framework = Framework::come(&controller, 6, SECRET);
    framework.say(Kind::Message, 1, b"again");
    hears(&mut executor, b"again");
    assert_eq!(framework.hear().unwrap().0.kind, Kind::Taken);
    controller.message("exec", b"it has left".to_vec());
    hears(&mut executor, b"it has left");
    assert_eq!(framework.hear(), None);
}

#[test]
fn only_who_shows_the_ticket_is_let_in_and_only_while_it_holds() {
    let controller = Controller::start();
    let agent = Agent::start(&controller);
    let mut executor = ready(&controller, &agent);
    assert_eq!(Framework::dial(&controller, true, 1, [8; 32]).hear(), None, "a wrong ticket");
    assert_eq!(Framework::dial(&controller, false, 1, SECRET).hear(), None, "no certificate");
    let mut framework = Framework::come(&controller, 2, SECRET);
    // A message before its mark, on a connection that takes the first one's place.
    let mut hasty = Framework::dial(&controller, true, 3, SECRET);
    assert_eq!(hasty.hear().unwrap().0.kind, Kind::Welcome);
    assert_eq!(framework.hear(), None, "the newest counts");
    hasty.say(Kind::Message, 1, b"too early");
    assert_eq!(hasty.hear(), None);

    let mut framework = Framework::come(&controller, 4, SECRET);
    controller.ticket("exec", Some([9; 32]));
    assert_eq!(framework.hear(), None, "another session has the ticket");
    assert_eq!(Framework::dial(&controller, true, 5, SECRET).hear(), None);
    let mut framework = Framework::come(&controller, 6, [9; 32]);
    controller.ticket("exec", None);
    assert_eq!(framework.hear(), None, "it is revoked");
    controller.ticket("exec", Some(SECRET));
    let mut framework = Framework::come(&controller, 7, SECRET);
    framework.say(Kind::Message, 1, b"heard");
    hears(&mut executor, b"heard");
    assert_eq!(framework.hear().unwrap().0.kind, Kind::Taken);
    controller.stop("exec", 0);
    assert_eq!(framework.hear(), None, "the executor has ended");
    assert_eq!(Framework::dial(&controller, true, 8, SECRET).hear(), None);
}

#[test]
fn a_line_outlives_the_controller() {
    let controller = Controller::start();
    let agent = Agent::start(&controller);
    let mut executor = ready(&controller, &agent);
    let mut framework = Framework::come(&controller, 1, SECRET);
    controller.set_away(true);
    framework.say(Kind::Message, 1, b"alone");
    hears(&mut executor, b"alone");
    assert_eq!(framework.hear().unwrap().0.kind, Kind::Taken);
    let before = controller.executors().len();
    controller.set_away(false);
    until("the next session", || (controller.executors().len() > before).then_some(()));
    // It has said nothing of tickets yet.
    say(&mut executor, b"still here");
    assert_eq!(framework.hear().unwrap().1, b"still here");
}

#[test]
fn with_an_older_certificate_nobody_listens() {
    let controller = Controller::start();
    controller.sign_as_before();
    let agent = Agent::start(&controller);
    let mut executor = ready(&controller, &agent);
    assert_eq!(controller.door(), None);
    controller.message("exec", b"relayed".to_vec());
    hears(&mut executor, b"relayed");
    say(&mut executor, b"as well");
    until("the answer", || (relayed(&controller) == [b"as well"]).then_some(()));
}
