//! Messages that go directly, against a controller and an agent that do what the test tells them.

mod common;

use std::sync::Arc;

use bytes::Bytes;
use common::{Controller, SELDOM_MS, Session, soon};
use muster_api::direct::frame::{HEADER, Header, Hello, Kind};
use muster_api::direct::server_name;
use muster_api::wire::framework::v1 as proto;
use muster_sdk::{CallRefused, Event, EventStream, Framework, FrameworkHandle, Reason};
use proto::call::Call as Say;
use proto::event::Event as Tell;
use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};
use tokio::net::{TcpListener, TcpStream};
use tokio::task::JoinHandle;
use tokio_rustls::TlsAcceptor;
use tokio_rustls::server::TlsStream;

/// A framework that knows of the executor `e`, and whatever it talks to.
struct World {
    controller: Controller,
    session: Session,
    handle: FrameworkHandle,
    events: EventStream,
    agent: TcpListener,
    tls: TlsAcceptor,
}

impl World {
    /// The agent's certificate is for `node`.
    async fn new(node: &str) -> World {
        let mut controller = Controller::start().await;
        let framework = Framework::builder("crew");
        let connected = framework.connect(Some(&controller.kubeconfig())).await;
        let (handle, mut events) = connected.expect("configured");
        let mut session = controller.session().await;
        assert!(session.subscribe("f1", SELDOM_MS).await.direct);
        assert!(matches!(soon(events.next()).await, Some(Event::Registered { .. })));
        let agent = TcpListener::bind("127.0.0.1:0").await.expect("a port");
        let tls = TlsAcceptor::from(Arc::new(controller.agent_tls(&server_name(node))));
        World { controller, session, handle, events, agent, tls }
    }

    /// The framework knows it when this returns.
    async fn tell(&mut self, secret: u8) {
        let direct = proto::Direct {
            executor: "e".to_owned(),
            node: "tb1".to_owned(),
            address: self.agent.local_addr().expect("bound").to_string(),
            server_name: server_name("tb1"),
            ticket: vec![secret; 32].into(),
        };
        self.session.say(Tell::Direct(direct)).await;
        self.session.say(Tell::NodeLost(proto::NodeLost::default())).await;
        assert!(matches!(soon(self.events.next()).await, Some(Event::NodeLost(_))));
    }

    /// A message of the executor, through the controller; the framework has taken it when this returns.
    async fn relay(&mut self, data: &'static str) {
        let (executor, node) = ("e".to_owned(), "tb1".to_owned());
        let message = proto::Message { executor, node, data: data.into(), mark: 0 };
        self.session.say(Tell::Message(message)).await;
        assert_eq!(self.heard().await, data);
    }

    async fn heard(&mut self) -> Bytes {
        let Some(Event::Message(message)) = soon(self.events.next()).await else {
            panic!("no message")
        };
        assert_eq!((message.executor.as_str(), message.node.as_str()), ("e", "tb1"));
        message.data
    }

    fn send(&self, data: impl Into<Bytes>) -> JoinHandle<Result<(), CallRefused>> {
        let (handle, data) = (self.handle.clone(), data.into());
        tokio::spawn(async move { handle.send_framework_message("e", data).await })
    }

    /// What comes to the controller, and is answered.
    async fn relayed(&mut self) -> proto::Message {
        let (id, Say::Message(message)) = self.session.call().await else { panic!("no message") };
        if message.mark == 0 {
            self.session.answer(id, Vec::new()).await;
        }
        message
    }

    /// Lets the framework in that dials, as it shows itself.
    async fn accept(&self) -> (Agent, Hello) {
        let (tcp, _) = soon(self.agent.accept()).await.expect("it dials");
        let mut agent = Agent(soon(self.tls.accept(tcp)).await.expect("it believes the agent"));
        let (header, payload) = agent.hear().await.expect("a Hello");
        (agent, Hello::decode(header, &payload).expect("a Hello"))
    }

    /// Until messages go directly both ways.
    async fn connected(&mut self, secret: u8) -> Agent {
        let (mut agent, hello) = self.accept().await;
        assert_eq!((hello.executor.as_str(), hello.secret.bytes()), ("e", &[secret; 32]));
        let line = hello.line.number();
        // Faster through the controller than its Welcome over the connection.
        let (executor, node) = ("e".to_owned(), "tb1".to_owned());
        let mark = proto::Message { executor, node, data: Bytes::new(), mark: line };
        self.session.say(Tell::Message(mark)).await;
        agent.say(Kind::Welcome, line, b"").await;
        assert_eq!(self.relayed().await.mark, line);
        assert_eq!(agent.hear().await.expect("a frame").0, Header::bare(Kind::Passed, line));
        agent.say(Kind::Passed, line, b"").await;
        agent
    }
}

struct Agent(TlsStream<TcpStream>);

impl Agent {
    async fn say(&mut self, kind: Kind, number: u64, payload: &[u8]) {
        let header = Header { kind, length: payload.len(), number };
        self.0.write_all(&header.encode()).await.expect("connected");
        self.0.write_all(payload).await.expect("connected");
        self.0.flush().await.expect("connected");
    }

    /// None: the framework has closed the connection.
    async fn hear(&mut self) -> Option<(Header, Vec<u8>)> {
        let mut bytes = [0; HEADER];
        soon(self.0.read_exact(&mut bytes)).await.ok()?;
        let header = Header::decode(bytes).expect("a frame");
        let mut payload = vec![0; header.length];
        soon(self.0.read_exact(&mut payload)).await.expect("whole");
        Some((header, payload))
    }
}

#[tokio::test]
async fn a_framework_dials_once_it_is_wanted_and_what_breaks_goes_through_the_controller() {
    let mut world = World::new("tb1").await;
    world.tell(7).await;
    let first = world.send("first");
    assert_eq!(world.relayed().await.data, "first");
    assert_eq!(soon(first).await.expect("no panic"), Ok(()));
    let mut agent = world.connected(7).await;
    let large = Bytes::from(vec![5; 4 << 20]);
    for (number, data) in [(1, large.clone()), (2, "second".into())] {
        let sent = world.send(data.clone());
        let (header, payload) = agent.hear().await.expect("a message");
        assert_eq!((header.kind, header.number), (Kind::Message, number));
        assert!(payload == data);
        agent.say(Kind::Taken, number, b"").await;
        assert_eq!(soon(sent).await.expect("no panic"), Ok(()));
        agent.say(Kind::Message, 0, &data).await;
        assert!(world.heard().await == data);
    }
    let refused = world.send("third");
    agent.hear().await.expect("a message");
    agent.say(Kind::Refused, 3, b"").await;
    let refused = soon(refused).await.expect("no panic").expect_err("not taken");
    assert_eq!(refused.reason, Reason::Unavailable);

    // Cut off within a message, in both directions.
    agent
        .0
        .write_all(&Header { kind: Kind::Message, length: 100, number: 0 }.encode())
        .await
        .expect("connected");
    agent.0.write_all(b"half").await.expect("connected");
    agent.0.flush().await.expect("connected");
    let lost = world.send(large);
    agent.0.read_exact(&mut [0; 1000]).await.expect("a part");
    drop(agent);
    let lost = soon(lost).await.expect("no panic").expect_err("nobody knows");
    assert_eq!(lost.reason, Reason::Disconnected);
    let next = world.send("after");
    assert_eq!(world.relayed().await.data, "after");
    assert_eq!(soon(next).await.expect("no panic"), Ok(()));
    world.relay("back").await;

    // That it was wanted brings the next connection; a relayed message ends it, because the agent has left it.
    let mut agent = world.connected(7).await;
    agent.say(Kind::Message, 0, b"over the line").await;
    assert_eq!(world.heard().await, "over the line");
    world.relay("the agent has left").await;
    assert!(agent.hear().await.is_none());
}

#[tokio::test]
async fn a_ticket_that_holds_no_more_ends_what_came_by_it() {
    let mut world = World::new("tb1").await;
    world.tell(7).await;
    world.relay("wanted").await;
    let mut agent = world.connected(7).await;
    world.tell(8).await;
    assert!(agent.hear().await.is_none());
    let mut agent = world.connected(8).await;
    // The executor has ended.
    let lost = proto::ExecutorLost { executor: "e".to_owned(), ..proto::ExecutorLost::default() };
    world.session.say(Tell::ExecutorLost(lost)).await;
    assert!(matches!(soon(world.events.next()).await, Some(Event::ExecutorLost(_))));
    assert!(agent.hear().await.is_none());
    let late = world.send("late");
    assert_eq!(world.relayed().await.data, "late");
    assert_eq!(soon(late).await.expect("no panic"), Ok(()));
}

#[tokio::test]
async fn messages_go_on_while_the_controller_is_away() {
    let mut world = World::new("tb1").await;
    world.tell(7).await;
    world.relay("wanted").await;
    let mut agent = world.connected(7).await;
    let World { mut controller, session, handle, mut events, .. } = world;
    drop(session);
    assert_eq!(soon(events.next()).await, Some(Event::Disconnected));
    let sent = tokio::spawn({
        let handle = handle.clone();
        async move { handle.send_framework_message("e", "alone").await }
    });
    assert_eq!(agent.hear().await.expect("a message").1, b"alone");
    agent.say(Kind::Taken, 1, b"").await;
    assert_eq!(soon(sent).await.expect("no panic"), Ok(()));
    let mut session = controller.session().await;
    session.subscribe("f1", SELDOM_MS).await;
    assert_eq!(soon(events.next()).await, Some(Event::Reregistered));
    handle.stop(true).await.expect("stopped");
    assert!(agent.hear().await.is_none(), "it ends with the framework");
}

#[tokio::test]
async fn another_nodes_agent_is_shown_no_ticket() {
    let mut world = World::new("tb2").await;
    world.tell(7).await;
    world.relay("wanted").await;
    let (tcp, _) = soon(world.agent.accept()).await.expect("it dials");
    assert!(soon(world.tls.accept(tcp)).await.is_err(), "the framework does not believe it");
    let sent = world.send("anyway");
    assert_eq!(world.relayed().await.data, "anyway");
    assert_eq!(soon(sent).await.expect("no panic"), Ok(()));
}
