//! A framework that comes to the agent directly, in the test's hands.

use std::io::{self, Read, Write};
use std::net::TcpStream;
use std::sync::Arc;

use muster_api::direct::frame::{HEADER, Header, Hello, Kind};
use muster_api::direct::{Line, Secret, server_name};
use rustls::pki_types::ServerName;
use rustls::{ClientConnection, StreamOwned};

use super::controller::Controller;
use super::until;

/// A connection. Dropped: it is closed.
pub struct Framework {
    stream: StreamOwned<ClientConnection, TcpStream>,
}

impl Framework {
    /// Connects, and shows a ticket. `known`: with a certificate of the cluster's CA.
    #[track_caller]
    pub fn dial(controller: &Controller, known: bool, line: u64, secret: [u8; 32]) -> Framework {
        let door = until("the agent's door", || controller.door());
        let tcp = TcpStream::connect(door).unwrap();
        tcp.set_read_timeout(Some(super::PATIENCE)).unwrap();
        let name = ServerName::try_from(server_name("robot-1")).unwrap();
        let config = Arc::new(controller.framework_tls(known));
        let session = ClientConnection::new(config, name).unwrap();
        let mut framework = Framework { stream: StreamOwned::new(session, tcp) };
        let hello = Hello {
            line: Line::new(line).unwrap(),
            executor: "exec".to_owned(),
            secret: Secret::new(secret),
        };
        // One that is not let in may be told so before it has said all.
        let _ = framework.stream.write_all(&hello.encode());
        framework
    }

    /// Connects to the executor `exec` once its ticket is known there, and goes on until messages go directly both ways.
    #[track_caller]
    pub fn come(controller: &Controller, line: u64, secret: [u8; 32]) -> Framework {
        let mut framework = until("to be let in", || {
            let mut framework = Framework::dial(controller, true, line, secret);
            let first = framework.hear()?;
            assert_eq!(first, (Header::bare(Kind::Welcome, line), Vec::new()));
            Some(framework)
        });
        until("the agent's mark", || {
            controller.messages().iter().any(|message| message.mark == line).then_some(())
        });
        framework.say(Kind::Passed, line, &[]);
        controller.mark("exec", line);
        assert_eq!(framework.hear(), Some((Header::bare(Kind::Passed, line), Vec::new())));
        framework
    }

    pub fn say(&mut self, kind: Kind, number: u64, payload: &[u8]) {
        self.begin(kind, number, payload.len(), payload);
    }

    /// Says that `length` bytes follow, and some of them.
    pub fn begin(&mut self, kind: Kind, number: u64, length: usize, some: &[u8]) {
        self.stream.write_all(&Header { kind, length, number }.encode()).unwrap();
        self.stream.write_all(some).unwrap();
        self.stream.flush().unwrap();
    }

    /// The next frame; none: the agent has closed the connection.
    #[track_caller]
    pub fn hear(&mut self) -> Option<(Header, Vec<u8>)> {
        let mut bytes = [0; HEADER];
        match self.stream.read_exact(&mut bytes) {
            Err(error) if error.kind() == io::ErrorKind::WouldBlock => panic!("nothing comes"),
            Err(_) => return None,
            Ok(()) => {}
        }
        let header = Header::decode(bytes).unwrap();
        let mut payload = vec![0; header.length];
        self.stream.read_exact(&mut payload).unwrap();
        Some((header, payload))
    }
}
