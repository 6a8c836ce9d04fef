//! The right to an answer that lasts: the answer ends when its user has it no more.

use std::io;
use std::sync::Arc;

use axum::body::Body;
use axum::response::Response;
use bytes::Bytes;
use futures::{Stream, StreamExt as _, stream};
use muster_controller_core::access::Verb;

use super::path::Target;
use crate::auth::{self, Identity};
use crate::context::Context;

/// Who was let in, and to what.
pub(super) struct Right {
    context: Arc<Context>,
    identity: Identity,
    verb: Verb,
    target: Target,
}

impl Right {
    pub(super) fn new(
        context: &Arc<Context>,
        identity: &Identity,
        (verb, target): (Verb, &Target),
    ) -> Self {
        let (context, identity) = (Arc::clone(context), identity.clone());
        Self { context, identity, verb, target: target.clone() }
    }

    /// The answer, as long as there is the right to it. A watch ends then as one whose time is over; a log is broken off, for it
    /// is not whole.
    pub(super) fn over(self, response: Response) -> Response {
        let is_watch = self.verb == Verb::Watch;
        let revoked = async move {
            let Self { context, identity, verb, target } = self;
            auth::until_revoked(&context, &identity, &auth::asked(verb, &target)).await;
        };
        response.map(|body| {
            let revoked = Box::pin(revoked);
            Body::from_stream(until(Box::pin(body.into_data_stream()), revoked, is_watch))
        })
    }
}

/// What `source` says until `over`; `quietly`: that is no error.
fn until<S: Stream<Item = Result<Bytes, axum::Error>> + Unpin, F: Future<Output = ()> + Unpin>(
    source: S,
    over: F,
    quietly: bool,
) -> impl Stream<Item = Result<Bytes, axum::Error>> {
    let pieces = stream::unfold(Some((source, over)), move |state| async move {
        let (mut source, mut over) = state?;
        tokio::select! {
            biased;
            () = &mut over => {
                let why = io::Error::other("the right to it was taken back");
                (!quietly).then(|| (Err(axum::Error::new(why)), None))
            }
            piece = source.next() => Some((piece?, Some((source, over)))),
        }
    });
    pieces.fuse()
}

#[cfg(test)]
mod tests {
    use tokio::sync::oneshot;

    use super::*;

    #[tokio::test]
    async fn what_lasts_ends_with_the_right_to_it() {
        for quietly in [true, false] {
            let (taken, over) = oneshot::channel::<()>();
            let over = Box::pin(async { drop(over.await) });
            let source = stream::iter([Ok(Bytes::from("a"))]).chain(stream::pending());
            let mut lasts = Box::pin(until(source, over, quietly));
            assert_eq!(lasts.next().await.unwrap().unwrap(), "a");
            drop(taken);
            match quietly {
                true => assert!(lasts.next().await.is_none()),
                false => assert!(lasts.next().await.unwrap().is_err()),
            }
            assert!(lasts.next().await.is_none());
        }
        let whole = stream::iter([Ok(Bytes::from("a"))]);
        let all: Vec<_> = until(whole, std::future::pending(), false).collect().await;
        assert_eq!(all.len(), 1);
    }
}
