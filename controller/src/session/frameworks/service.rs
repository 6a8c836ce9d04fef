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
use crate::auth::Identity;

/// Events on their way to the transport; more would only hide that the framework does not read.
const OUT: usize = 16;

/// The service.
#[derive(Debug, Clone)]
pub struct Service(pub Arc<Frameworks>);

#[tonic::async_trait]
impl FrameworkService for Service {
    type SessionStream = Pin<Box<dyn Stream<Item = Result<wire::Event, Status>> + Send>>;

    async fn session(
        &self,
        request: Request<Streaming<wire::Call>>,
    ) -> Result<Response<Self::SessionStream>, Status> {
        // Who may run frameworks: administrators, until there are roles.
        match request.extensions().get::<Identity>() {
            Some(Identity::Admin { .. }) => {}
            Some(Identity::Anonymous) | None => {
                return Err(Status::unauthenticated("a client certificate is needed"));
            }
            Some(other) => {
                let text = format!("{} may not run a framework", other.name());
                return Err(Status::permission_denied(text));
            }
        }
        let (to_session, calls) = Wire::calls();
        let (out, events) = mpsc::channel(OUT);
        let mut inbound = request.into_inner();
        let ended = out.clone();
        self.0.tasks.spawn(async move {
            // Ends when the framework closes its side, when the stream breaks, or when the session is over.
            loop {
                let next = tokio::select! {
                    next = inbound.message() => next,
                    () = ended.closed() => break,
                };
                let Ok(Some(call)) = next else { break };
                if to_session.send(call).await.is_err() {
                    break;
                }
            }
        });
        self.0
            .tasks
            .spawn(session::run(Arc::clone(&self.0), Wire { calls, keep_calls: None, out }));
        Ok(Response::new(Box::pin(ReceiverStream::new(events).map(Ok))))
    }
}
