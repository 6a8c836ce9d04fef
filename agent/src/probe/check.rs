//! A probe of a spec as the check that it is, and what comes of making it once.

use std::future::Future;
use std::net::SocketAddr;
use std::pin::pin;
use std::sync::Arc;

use futures::FutureExt;
use muster_agent_core::probe::{Answer, Role, shorten};
use muster_api::duration::Span;
use muster_api::kind::task::probe::{HttpCheck, Probe, Scheme, address};

use tokio::sync::Mutex;

use super::topic::Topics;
use super::{connect, http, tls, topic};
use crate::driver::chain;
use crate::runtime::{Executed, Launch, Runtime, RuntimeError};

/// What is done.
#[derive(Debug)]
enum What {
    /// A program is run inside the task.
    Exec(Vec<String>),
    /// A page is asked for.
    Http(SocketAddr, HttpCheck),
    /// A connection is made.
    Tcp(SocketAddr),
    /// A topic's messages are counted.
    Topic(Topic),
    /// Admission lets no such probe through; a newer controller may.
    Unknown,
}

/// A topic, and what is kept between checks of it.
#[derive(Debug)]
struct Topic {
    topics: Arc<Topics>,
    /// Or why there is none.
    target: Result<topic::Target, String>,
    counting: Mutex<Option<topic::Counting>>,
}

/// A check.
#[derive(Debug)]
pub(super) struct Check {
    what: What,
    timeout: Span,
}

impl Check {
    pub(super) fn of(probe: &Probe, launch: &Launch, topics: &Arc<Topics>) -> Check {
        let at = |host: &Option<String>, port: u16| {
            address(host.as_deref()).map(|ip| SocketAddr::new(ip, port))
        };
        let what = match probe {
            Probe { exec: Some(exec), .. } => Some(What::Exec(exec.command.clone())),
            Probe { http: Some(http), .. } => {
                at(&http.host, http.port).map(|at| What::Http(at, http.clone()))
            }
            Probe { tcp: Some(tcp), .. } => at(&tcp.host, tcp.port).map(What::Tcp),
            Probe { topic: Some(topic), .. } => Some(What::Topic(Topic {
                topics: Arc::clone(topics),
                target: topic::Target::of(topic, launch, topics.ros()),
                counting: Mutex::default(),
            })),
            Probe { exec: None, http: None, tcp: None, topic: None, .. } => None,
        };
        Check { what: what.unwrap_or(What::Unknown), timeout: probe.timeout }
    }

    /// Makes the check. When `over` resolves first, it ends what it began, and its answer means nothing.
    pub(super) async fn answer(
        &self,
        role: Role,
        runtime: &dyn Runtime,
        launch: &Launch,
        over: impl Future<Output = ()> + Send,
    ) -> Answer {
        if let What::Topic(Topic { topics, target, counting }) = &self.what {
            // Nobody is asked who could be late: what came is counted.
            let mut over = pin!(over);
            return tokio::select! {
                biased;
                answer = topic::answer(topics, target, counting, role) => answer,
                () = &mut over => Answer::Unknown(String::new()),
            };
        }
        let late = tokio::time::sleep(self.timeout.as_duration());
        let until = async {
            tokio::select! {
                () = late => {}
                () = over => {}
            }
        };
        let too_late = || Answer::Failure(format!("no answer within {}", self.timeout));
        match &self.what {
            What::Exec(argv) => match runtime.exec(launch, argv, until.boxed()).await {
                Ok(executed) => executed_answer(executed, self.timeout),
                Err(error) => unknown(&error),
            },
            // An answer that is there counts, however late anybody looks.
            What::Http(at, check) => tokio::select! {
                biased;
                answer = over_http(runtime, launch, *at, check) => answer,
                () = until => too_late(),
            },
            What::Tcp(at) => tokio::select! {
                biased;
                answer = over_tcp(runtime, launch, *at) => answer,
                () = until => too_late(),
            },
            What::Topic(_) | What::Unknown => {
                Answer::Unknown("this agent knows no such check".to_owned())
            }
        }
    }
}

fn unknown(error: &RuntimeError) -> Answer {
    Answer::Unknown(shorten(&chain(error)))
}

fn executed_answer(executed: Executed, timeout: Span) -> Answer {
    let with = |what: String, said: &str| match shorten(said) {
        said if said.is_empty() => what,
        said => format!("{what}: {said}"),
    };
    match executed {
        Executed::Ended { code: 0, .. } => Answer::Success,
        Executed::Ended { code, said } => {
            Answer::Failure(with(format!("exited with code {code}"), &said))
        }
        Executed::NotStarted(why) => Answer::Failure(shorten(&why)),
        Executed::Cut { said } => {
            Answer::Failure(with(format!("no answer within {timeout}"), &said))
        }
    }
}

async fn over_tcp(runtime: &dyn Runtime, launch: &Launch, at: SocketAddr) -> Answer {
    match connect::connect(runtime, launch, at).await {
        Ok(_) => Answer::Success,
        Err(error) => refused(error, at),
    }
}

async fn over_http(
    runtime: &dyn Runtime,
    launch: &Launch,
    at: SocketAddr,
    check: &HttpCheck,
) -> Answer {
    let stream = match connect::connect(runtime, launch, at).await {
        Ok(stream) => stream,
        Err(error) => return refused(error, at),
    };
    let got = match check.scheme {
        Scheme::Http => http::get(stream, at, check).await,
        Scheme::Https => match tls::wrap(stream, at).await {
            Ok(stream) => http::get(stream, at, check).await,
            Err(error) => {
                let why = format!("{at} does not speak TLS: {}", chain(&error));
                return Answer::Failure(shorten(&why));
            }
        },
    };
    match got {
        Ok((status, _)) if (200..400).contains(&status) => Answer::Success,
        Ok((status, body)) => match shorten(&body) {
            body if body.is_empty() => Answer::Failure(format!("HTTP status {status}")),
            body => Answer::Failure(format!("HTTP status {status}: {body}")),
        },
        Err(error) => {
            Answer::Failure(shorten(&format!("{at} does not speak HTTP: {}", chain(&error))))
        }
    }
}

fn refused(error: connect::ConnectError, at: SocketAddr) -> Answer {
    match error {
        connect::ConnectError::Network(error) => unknown(&error),
        connect::ConnectError::Connect(error) => {
            Answer::Failure(shorten(&format!("no connection to {at}: {error}")))
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn answers_say_what_the_check_said() {
        let timeout = Span::from_secs(1);
        let answer = |executed| executed_answer(executed, timeout);
        let ended = |code, said: &str| Executed::Ended { code, said: said.to_owned() };
        let failure = |text: &str| Answer::Failure(text.to_owned());
        assert_eq!(answer(ended(0, "all is well")), Answer::Success);
        assert_eq!(answer(ended(1, "no\nmap ")), failure("exited with code 1: no map"));
        assert_eq!(answer(ended(2, "")), failure("exited with code 2"));
        let cut = Executed::Cut { said: "loading".to_owned() };
        assert_eq!(answer(cut), failure("no answer within 1s: loading"));
    }
}
