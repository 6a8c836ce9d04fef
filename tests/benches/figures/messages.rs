//! Framework → executor → framework, against a raw echo over TCP on loopback.
//!
//! ```text
//!   floor:    client ⇄ TCP ⇄ echo                                                    2 sockets
//!   directly: framework ⇄ TLS ⇄ agent ⇄ executor                                     4 sockets
//!   relayed:  framework ⇄ TLS, HTTP/2 ⇄ controller ⇄ TLS, HTTP/2 ⇄ agent ⇄ executor  6 sockets
//! ```
//!
//! Both sides of the floor read a message whole before they go on, as a message is. The echo of the floor is a thread of
//! this process; every other box is a process of its own.

use std::io::{Read as _, Write as _};
use std::net::{TcpListener, TcpStream};
use std::time::{Duration, Instant};

use bytes::Bytes;
use muster_tests::{AgentOptions, Cluster, Echo};

use crate::stats::{Samples, figure};

/// Bytes, and how many pairs.
const SIZES: [(usize, usize); 4] = [(10, 500), (1 << 10, 500), (64 << 10, 300), (1 << 20, 200)];
/// Pairs before those that count: buffers and windows grow to their size.
const WARM_UP: usize = 20;

/// An echo whose two sides know how long a message is.
struct Raw(TcpStream);

impl Raw {
    fn new(size: usize) -> Raw {
        let listener = TcpListener::bind("127.0.0.1:0").expect("loopback");
        let address = listener.local_addr().expect("bound");
        // It ends with the connection.
        std::thread::spawn(move || {
            let (mut stream, _) = listener.accept().expect("a client");
            stream.set_nodelay(true).expect("TCP");
            let mut message = vec![0; size];
            while stream.read_exact(&mut message).is_ok() && stream.write_all(&message).is_ok() {}
        });
        let stream = TcpStream::connect(address).expect("it listens");
        stream.set_nodelay(true).expect("TCP");
        Raw(stream)
    }

    fn round(&mut self, message: &[u8], answer: &mut [u8]) -> Duration {
        let begin = Instant::now();
        self.0.write_all(message).expect("it reads");
        self.0.read_exact(answer).expect("it answers");
        begin.elapsed()
    }
}

pub(crate) async fn round_trip() {
    let mut cluster = Cluster::start().await;
    cluster.join(AgentOptions::cloud("direct")).await;
    cluster.join(AgentOptions::cloud("relayed").flag("--messages", "none")).await;
    let mut direct = Echo::start(&cluster, "direct").await;
    direct.go_directly(&cluster).await;
    let mut relayed = Echo::start(&cluster, "relayed").await;
    for (size, pairs) in SIZES {
        let message = Bytes::from(vec![7; size]);
        let (mut raw, mut answer) = (Raw::new(size), vec![0; size]);
        let [mut floor, mut directly, mut through] = [(); 3].map(|()| Samples::default());
        for pair in 0..WARM_UP + pairs {
            let one = raw.round(&message, &mut answer);
            let other = direct.round(&message).await;
            let last = relayed.round(&message).await;
            if pair >= WARM_UP {
                floor.push(one);
                directly.push(other);
                through.push(last);
            }
        }
        floor.line(&format!("floor: TCP echo, {size} B"));
        directly.line(&format!("framework - agent - executor, {size} B"));
        through.line(&format!("the same through the controller, {size} B"));
        let ratio =
            |samples: &Samples| samples.median().as_secs_f64() / floor.median().as_secs_f64();
        let aim = if size == 1 << 20 { "<= 5x" } else { "none: hops, not bytes" };
        figure(&format!("p50 ratio at {size} B"), ratio(&directly), "x", aim);
        figure(&format!("through the controller at {size} B"), ratio(&through), "x", "report");
    }
    for echo in [direct, relayed] {
        echo.handle.stop(false).await.expect("it is torn down");
    }
}
