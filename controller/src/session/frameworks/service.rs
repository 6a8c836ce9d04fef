//! The session over gRPC: one bidirectional stream.

use std::pin::Pin;
use std::sync::Arc;

use futures::{Stream, StreamExt as _};
use muster_api::wire::framework::v1 as wire;
use tokio::sync::mpsc;
use tokio_stream::wrappers::ReceiverStream;
use tonic::{Request, Response, Status, Streaming};

use super::Frameworks;
use super::proto::framework_service_server::FrameworkService;
use super::session::{self, Wire};
use crate::auth::Asker;
use crate::session::status_of;

/// Events on their way to the transport; more would only hide that the framework does not read.
const OUT: usize = 16;

/// The service.
#[derive(Debug, Clone)]
pub struct Service(pub Arc<Frameworks>);

/// What a framework says, in order.
pub type Inbound = Pin<Box<dyn Stream<Item = Result<wire::Call, Status>> + Send>>;

impl Frameworks {
    /// A session with `asker`, who says this; gives what it is told. Whatever carries the messages keeps their order.
    pub fn begin(
        self: &Arc<Self>,
        asker: Asker,
        mut inbound: Inbound,
    ) -> ReceiverStream<wire::Event> {
        let (to_session, calls) = Wire::calls();
        let (out, events) = mpsc::channel(OUT);
        self.tasks.spawn(async move {
            // Ends when the framework closes its side, when the stream breaks, or when the session is over: nothing here keeps
            // the events open, so that a framework that was refused reads their end.
            loop {
                let next = tokio::select! {
                    next = inbound.next() => next,
                    () = to_session.closed() => break,
                };
                let Some(Ok(call)) = next else { break };
                if to_session.send(call).await.is_err() {
                    break;
                }
            }
        });
        self.tasks
            .spawn(session::run(Arc::clone(self), Wire { asker, calls, keep_calls: None, out }));
        ReceiverStream::new(events)
    }
}

#[tonic::async_trait]
impl FrameworkService for Service {
    type SessionStream = Pin<Box<dyn Stream<Item = Result<wire::Event, Status>> + Send>>;

    async fn session(
        &self,
        request: Request<Streaming<wire::Call>>,
    ) -> Result<Response<Self::SessionStream>, Status> {
        let asker = Asker::of(&self.0.context, request.extensions());
        self.0.admit(&asker).map_err(|failure| status_of(&failure))?;
        let events = self.0.begin(asker, Box::pin(request.into_inner()));
        Ok(Response::new(Box::pin(events.map(Ok))))
    }
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use futures::stream;
    use muster_api::wire::framework::v1::{call, event};
    use tokio_util::task::TaskTracker;

    use super::*;
    use crate::reconcile::schedule::Scheduler;

    async fn frameworks(dir: &tempfile::TempDir) -> Arc<Frameworks> {
        let context = crate::context::for_tests(dir.path(), crate::store::memory::start().await);
        let (_, desk) = Scheduler::new(Arc::clone(&context), Default::default(), Arc::default());
        Arc::new(Frameworks::new(context, desk, Arc::default(), TaskTracker::new()))
    }

    #[tokio::test]
    async fn a_framework_that_is_refused_reads_the_end_though_it_keeps_its_side_open() {
        let dir = tempfile::tempdir().unwrap();
        let frameworks = frameworks(&dir).await;
        let revive =
            wire::Call { call: Some(call::Call::Revive(wire::Revive {})), ..Default::default() };
        let said = stream::iter([Ok(revive)]).chain(stream::pending());
        let told = frameworks.begin(Asker::admin("a"), Box::pin(said)).collect::<Vec<_>>();
        let told = tokio::time::timeout(Duration::from_secs(60), told).await.expect("it ends");
        let [wire::Event { event: Some(event::Event::Error(error)) }] = &told[..] else {
            panic!("{told:?}")
        };
        assert_eq!(error.reason, "Invalid");
    }
}
