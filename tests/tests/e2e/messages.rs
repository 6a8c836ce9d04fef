//! Messages between a framework and its executor: directly where that is possible, through the controller otherwise, and in
//! order whatever happens to either way.

use std::sync::Arc;
use std::time::Duration;

use bytes::Bytes;
use muster_api::direct::frame::{Header, Hello};
use muster_api::direct::{ALPN, Line, Secret, server_name};
use muster_sdk::{Event, Framework, Reason};
use muster_tests::{AgentOptions, Cluster, Echo, wait};
use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};
use tokio::sync::Semaphore;

const LARGE: usize = 256 << 10;

async fn cloud() -> (Cluster, Echo) {
    let mut cluster = Cluster::start().await;
    cluster.join(AgentOptions::cloud("cloud").flag("--docker-socket", "none")).await;
    let echo = Echo::start(&cluster, "cloud").await;
    (cluster, echo)
}

/// So long that a connection that breaks most likely breaks within one.
fn numbered(number: u64) -> Bytes {
    let mut message = vec![7; LARGE];
    message[..8].copy_from_slice(&number.to_be_bytes());
    message.into()
}

fn number(message: &Bytes) -> u64 {
    assert_eq!(message.len(), LARGE, "whole");
    assert!(message[8..].iter().all(|byte| *byte == 7), "as it was sent");
    u64::from_be_bytes(message[..8].try_into().expect("eight"))
}

/// Where the agent listens, as its log says it.
fn door(cluster: &Cluster, node: &str) -> String {
    let log = cluster.log_of(node);
    let (_, after) = log.rsplit_once("takes messages of frameworks").expect("it listens");
    let from = after.find("127.0.0.1:").expect("on loopback");
    let address = &after[from..];
    let end = address.find(|c: char| !(c.is_ascii_digit() || c == '.' || c == ':'));
    address[..end.unwrap_or(address.len())].to_owned()
}

#[tokio::test(flavor = "multi_thread")]
async fn messages_go_directly_once_they_can_and_end_with_the_framework() {
    let (cluster, mut echo) = cloud().await;
    echo.go_directly(&cluster).await;
    let before = cluster.messages().await;
    for message in [Bytes::new(), vec![1; 10].into(), vec![2; 4 << 20].into()] {
        echo.round(&message).await;
    }
    let (handle, executor) = (echo.handle.clone(), echo.executor.clone());
    // Half of what may wait for an executor is under way: of more, some could be dropped.
    let window = Arc::new(Semaphore::new(32));
    let may_send = Arc::clone(&window);
    let sent = tokio::spawn(async move {
        for n in 0..100 {
            may_send.acquire().await.expect("it is open").forget();
            handle.send_framework_message(&executor, numbered(n)).await.expect("taken");
        }
    });
    for n in 0..100 {
        assert_eq!(number(&echo.answer().await), n);
        window.add_permits(1);
    }
    sent.await.expect("all are sent");
    assert_eq!(cluster.messages().await, before, "none passed the controller");
    let too_long = vec![0; (4 << 20) + 1];
    let refused = echo.handle.send_framework_message(&echo.executor, too_long).await;
    assert_eq!(refused.expect_err("too long").reason, Reason::Invalid);

    // Who comes without the ticket is not let in, and does not disturb who has it.
    for secret in [[0; 32], [7; 32]] {
        assert_eq!(stranger(&cluster, &echo.executor, secret).await, None);
    }
    echo.round(&numbered(100)).await;
    assert_eq!(cluster.messages().await, before);

    echo.handle.stop(false).await.expect("torn down");
    wait::until("the connection has ended", || {
        let ended = cluster.log_of("cloud").contains("a framework's connection ended");
        async move { ended.then_some(()).ok_or_else(|| "the agent has not said so".to_owned()) }
    })
    .await;
}

/// Shows a made-up ticket with an admin's certificate; what the agent answers.
async fn stranger(cluster: &Cluster, executor: &str, secret: [u8; 32]) -> Option<Header> {
    let mut stream = dial(cluster, "cloud").await;
    let line = Line::new(1).expect("not 0");
    let secret = Secret::new(secret);
    let hello = Hello { line, executor: executor.to_owned(), secret };
    stream.write_all(&hello.encode()).await.expect("it reads");
    let mut header = [0; 16];
    stream.read_exact(&mut header).await.ok()?;
    Some(Header::decode(header).expect("a frame"))
}

/// TLS to the agent of a node, as an administrator.
async fn dial(
    cluster: &Cluster,
    node: &str,
) -> tokio_rustls::client::TlsStream<tokio::net::TcpStream> {
    let config = Arc::new(cluster.admin_tls(ALPN));
    let tcp = tokio::net::TcpStream::connect(door(cluster, node)).await.expect("it listens");
    let name = rustls::pki_types::ServerName::try_from(server_name(node)).expect("a name");
    tokio_rustls::TlsConnector::from(config).connect(name, tcp).await.expect("its certificate")
}

#[tokio::test(flavor = "multi_thread")]
async fn an_agent_that_does_not_listen_is_reached_through_the_controller() {
    let mut cluster = Cluster::start().await;
    cluster
        .join(
            AgentOptions::cloud("cloud").flag("--docker-socket", "none").flag("--messages", "none"),
        )
        .await;
    let mut echo = Echo::start(&cluster, "cloud").await;
    for n in 1..=20 {
        echo.round(&numbered(n)).await;
        // One "ready", and from then on one each way.
        assert_eq!(cluster.messages().await, 1 + 2 * n);
    }
    assert!(!cluster.log_of("cloud").contains("takes messages of frameworks"));
}

#[tokio::test(flavor = "multi_thread")]
async fn messages_go_on_while_the_controller_is_away_and_after_it_is_back() {
    let (mut cluster, mut echo) = cloud().await;
    echo.go_directly(&cluster).await;
    let before = lines(&cluster);
    cluster.kill_controller();
    for n in 0..20 {
        echo.round(&numbered(n)).await;
    }
    cluster.start_controller().await;
    loop {
        match echo.events.next().await.expect("it runs") {
            Event::Reregistered => break,
            Event::Message(_) => panic!("a message twice"),
            _ => {}
        }
    }
    cluster.node_ready("cloud").await;
    // The connection is made again, with a ticket of the new session; what is under way then may be lost.
    comes_back_anew(&cluster, &mut echo, before, (19, 1_000)).await;
    echo.go_directly(&cluster).await;
}

/// How many connections to the agent the framework has made so far.
fn lines(cluster: &Cluster) -> usize {
    cluster.log_of("cloud").matches("a framework came directly").count()
}

/// Sends numbers from `next` on until the framework has connected once more than `before` and one comes back that was sent
/// after that: from then on nothing is lost. The first number that was not sent.
async fn comes_back_anew(
    cluster: &Cluster,
    echo: &mut Echo,
    before: usize,
    (mut last, mut next): (u64, u64),
) -> u64 {
    let back = tokio::time::timeout(wait::DEADLINE, async {
        let mut ticks = tokio::time::interval(Duration::from_millis(20));
        loop {
            ticks.tick().await;
            // Before it is sent: what comes back of one sent earlier may have gone over the connection that is cut next.
            let anew = lines(cluster) > before;
            let came_back = comes_back(echo, &mut last, next).await;
            next += 1;
            if anew && came_back {
                return next;
            }
        }
    });
    back.await.expect("messages go there and back again in time")
}

/// Sends a number; whether just that comes back soon. What comes before it is later than `last`, which goes on.
async fn comes_back(echo: &mut Echo, last: &mut u64, sent: u64) -> bool {
    let taken = echo.handle.send_framework_message(&echo.executor, numbered(sent)).await;
    if taken.is_err() {
        return false;
    }
    let heard = async {
        while *last != sent {
            let number = number(&echo.answer().await);
            assert!(*last < number && number <= sent, "{number} after {last}, of {sent}");
            *last = number;
        }
    };
    tokio::time::timeout(Duration::from_secs(5), heard).await.is_ok()
}

/// Numbered messages go there and back while agents and connections are killed. Some are lost; none comes twice or late.
#[tokio::test(flavor = "multi_thread")]
async fn what_breaks_loses_messages_and_changes_no_order() {
    let (mut cluster, mut echo) = cloud().await;
    echo.go_directly(&cluster).await;
    let (handle, executor) = (echo.handle.clone(), echo.executor.clone());
    let (stop, mut stopped) = tokio::sync::watch::channel(false);
    let sender = tokio::spawn(async move {
        let (mut next, mut taken) = (1, 0);
        while !*stopped.borrow_and_update() {
            let sent = handle.send_framework_message(&executor, numbered(next)).await;
            if sent.is_ok() {
                taken += 1;
            } else {
                // Nobody is there: not in a tight loop.
                tokio::time::sleep(Duration::from_millis(20)).await;
            }
            next += 1;
        }
        (next, taken)
    });
    let (mut seen, mut before) = (vec![0], 0);
    for _ in 0..2 {
        hear(&mut echo, &mut seen, 50).await;
        cluster.kill_agent("cloud");
        before = lines(&cluster);
        cluster.restart_agent("cloud").await;
        hear(&mut echo, &mut seen, 50).await;
    }
    stop.send(true).expect("it sends");
    let (next, taken) = sender.await.expect("it ends");
    assert!(taken > 0, "none of {next} was taken");
    assert!(seen.len() as u64 <= next, "{} of {next}", seen.len());
    // What was taken while somebody went may be lost, and more than the framework has room for. Nobody disturbs any more: the
    // agent's listener is found again, and what is sent then comes back, after all before it.
    let last = *seen.last().expect("some");
    let next = comes_back_anew(&cluster, &mut echo, before, (last, next)).await;
    for more in next..next + 10 {
        echo.round(&numbered(more)).await;
    }
    echo.go_directly(&cluster).await;
}

/// Hears `count` numbered messages, each later than all before.
async fn hear(echo: &mut Echo, seen: &mut Vec<u64>, count: usize) {
    for _ in 0..count {
        let answer = tokio::time::timeout(wait::DEADLINE, echo.answer());
        let answer = answer.await.expect("an answer in time");
        if answer == "ready" || answer == "on the way" {
            continue;
        }
        let number = number(&answer);
        let last = *seen.last().expect("some");
        assert!(number > last, "{number} after {last}");
        seen.push(number);
    }
}

/// A framework that fails over: the ticket of the session before ends with it.
#[tokio::test(flavor = "multi_thread")]
async fn a_later_session_takes_the_place_of_the_one_before() {
    let mut cluster = Cluster::start().await;
    cluster.join(AgentOptions::cloud("cloud").flag("--docker-socket", "none")).await;
    let state = cluster.dir().join("framework-id");
    let framework = || Framework::builder("crew").state_file(&state);
    let mut first = Echo::launch(framework(), &cluster, "cloud").await;
    first.go_directly(&cluster).await;
    let connected = framework().connect(Some(&cluster.kubeconfig())).await;
    let (handle, events) = connected.expect("the same framework");
    let mut second = Echo { handle, events, executor: first.executor.clone() };
    second.go_directly(&cluster).await;
    loop {
        match first.events.next().await {
            Some(Event::Error(error)) => break assert_eq!(error.reason, "Cut"),
            Some(_) => {}
            None => panic!("it was not told"),
        }
    }
    let ended = first.handle.send_framework_message(&first.executor, "late").await;
    assert_eq!(ended.expect_err("it has ended").reason, Reason::Ended);
    second.round(&numbered(1)).await;
}
