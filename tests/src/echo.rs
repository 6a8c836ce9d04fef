//! A framework whose executor sends every message back.

use std::time::{Duration, Instant};

use bytes::Bytes;
use muster_sdk::framework::Builder;
use muster_sdk::{Event, EventStream, Framework, FrameworkHandle, Launch};

use crate::Cluster;
use crate::cluster::binary;

/// A framework and its executor.
#[derive(Debug)]
pub struct Echo {
    /// The framework's actions.
    pub handle: FrameworkHandle,
    /// What happens to it.
    pub events: EventStream,
    /// The uid of its executor's task.
    pub executor: String,
}

impl Echo {
    /// On `node`, in whose name the framework is called as well.
    pub async fn start(cluster: &Cluster, node: &str) -> Self {
        Echo::launch(Framework::builder(node), cluster, node).await
    }

    /// The same of a framework that is described already.
    pub async fn launch(framework: Builder, cluster: &Cluster, node: &str) -> Self {
        let connected = framework.connect(Some(&cluster.kubeconfig())).await;
        let (handle, mut events) = connected.expect("the kubeconfig is good");
        let offer = loop {
            if let Event::Offers(offers) = events.next().await.expect("it runs")
                && let Some(offer) = offers.into_iter().find(|offer| offer.node == node)
            {
                break offer;
            }
        };
        // Without a limit of cpu: where this is measured, the kernel's throttling is not what is.
        let echo = Launch::process([binary("echo-executor").display().to_string()]);
        let echo = echo.memory("256Mi").on(&offer);
        let launched = handle.launch_tasks([echo]).await.expect("launched");
        handle.suppress_offers().await.expect("taken");
        let mut echo = Echo { handle, events, executor: launched[0].task.clone() };
        assert_eq!(echo.answer().await, "ready");
        echo
    }

    /// The next message of the executor.
    pub async fn answer(&mut self) -> Bytes {
        loop {
            match self.events.next().await.expect("it runs") {
                Event::Message(message) => return message.data,
                Event::Update(update) => self.handle.acknowledge_status_update(&update).await,
                _ => {}
            }
        }
    }

    /// There and back.
    pub async fn round(&mut self, message: &Bytes) -> Duration {
        let begin = Instant::now();
        let sent = self.handle.send_framework_message(&self.executor, message.clone()).await;
        sent.expect("its node is there");
        let answer = self.answer().await;
        let elapsed = begin.elapsed();
        assert!(answer == *message, "{} bytes came back", answer.len());
        elapsed
    }

    /// Goes on until messages do not pass the controller any more.
    pub async fn go_directly(&mut self, cluster: &Cluster) {
        let mut before = 0;
        for _ in 0..200 {
            self.round(&Bytes::from_static(b"on the way")).await;
            let now = cluster.messages().await;
            if now == std::mem::replace(&mut before, now) {
                return;
            }
        }
        panic!("messages still pass the controller");
    }
}
