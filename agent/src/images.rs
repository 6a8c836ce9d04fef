//! Pulls images before a task needs them, as the core decides: see [`muster_agent_core::image`].
//!
//! ```text
//! session ── Images ──▶ want ──▶ core: what next ──▶ runtime fetches ──▶ done ──▶ states ──▶ node's face ──▶ session
//! ```

use std::sync::{Mutex, MutexGuard, PoisonError};

use futures::future::{BoxFuture, FutureExt};
use muster_agent_core::event::Failure;
use muster_agent_core::image::Pulls;
use muster_api::kind::node::image::{ImageStatus, ImageWish};
use muster_api::wire::agent::v1 as proto;
use tokio::sync::Notify;

use crate::clock;
use crate::driver::{chain, sleep_until};
use crate::runtime::Runtime;

/// The wishes for this node, and how it stands with them.
#[derive(Debug, Default)]
pub(crate) struct Images {
    pulls: Mutex<Pulls>,
    changed: Notify,
}

/// A pull under way; dropped, it is given up, and the layers that came stay.
type UnderWay<'a> = (ImageWish, BoxFuture<'a, Result<(), Failure>>);

impl Images {
    fn pulls(&self) -> MutexGuard<'_, Pulls> {
        self.pulls.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// What the controller wants now, whole.
    pub(crate) fn want(&self, images: &proto::Images) {
        let read = |wish: &proto::ImageWish| match ImageWish::try_from(wish) {
            Ok(wish) => Some(wish),
            Err(error) => {
                tracing::warn!(error = chain(&error), "a wish for an image cannot be read");
                None
            }
        };
        self.pulls().want(images.wanted.iter().filter_map(read));
        self.changed.notify_one();
    }

    /// What is told of them.
    pub(crate) fn states(&self) -> Vec<ImageStatus> {
        self.pulls().statuses()
    }

    /// Pulls until it is dropped.
    pub(crate) async fn run(&self, runtime: &dyn Runtime) {
        let mut under_way: Option<UnderWay<'_>> = None;
        loop {
            under_way.take_if(|(wish, _)| !self.pulls().is_wanted(wish));
            if let Some(wish) = self.pulls().next(clock::boot()) {
                tracing::info!(image = wish.image, "pull, before a task needs it");
                under_way = Some((wish.clone(), self.fetch(runtime, wish)));
            }
            let wake = self.pulls().wake();
            // Cancel-safe: a permit that was stored stays, the pull is polled in place, a sleep's deadline is kept.
            tokio::select! {
                () = self.changed.notified() => {}
                result = pulled(&mut under_way) => {
                    if let Some((wish, _)) = under_way.take() {
                        tracing::info!(image = wish.image, ?result, "pulled");
                        self.pulls().done(&wish, result, clock::boot());
                    }
                }
                () = sleep_until(wake) => {}
            }
        }
    }

    fn fetch<'a>(
        &self,
        runtime: &'a dyn Runtime,
        wish: ImageWish,
    ) -> BoxFuture<'a, Result<(), Failure>> {
        async move { runtime.fetch(&wish.image, wish.pull_policy.into()).await }.boxed()
    }
}

async fn pulled(under_way: &mut Option<UnderWay<'_>>) -> Result<(), Failure> {
    match under_way {
        Some((_, pull)) => pull.await,
        None => std::future::pending().await,
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;
    use std::time::Duration;

    use muster_api::kind::node::image::ImagePhase;
    use serde_json::json;

    use super::*;
    use crate::runtime::fake::Fake;

    fn wanted(images: &[&str]) -> proto::Images {
        let wish = |image: &&str| -> ImageWish {
            let wish = json!({"image": image, "since": "2026-01-02T03:04:05.000000Z"});
            serde_json::from_value(wish).unwrap()
        };
        proto::Images { wanted: images.iter().map(|image| (&wish(image)).into()).collect() }
    }

    async fn until(images: &Images, phases: &[ImagePhase]) {
        let seen = || images.states().iter().map(|s| s.phase).collect::<Vec<_>>();
        let reached = async {
            while seen() != phases {
                tokio::task::yield_now().await;
            }
        };
        let in_time = tokio::time::timeout(Duration::from_secs(30), reached).await;
        assert!(in_time.is_ok(), "{:?}, not {phases:?}", seen());
    }

    #[tokio::test]
    async fn a_pull_that_nobody_wants_any_more_makes_room_for_the_next() {
        let (images, fake) = (Arc::new(Images::default()), Arc::new(Fake::default()));
        let run = {
            let (images, fake) = (Arc::clone(&images), Arc::clone(&fake));
            tokio::spawn(async move { images.run(&*fake).await })
        };
        images.want(&wanted(&["slow", "other"]));
        until(&images, &[ImagePhase::Pulling, ImagePhase::Waiting]).await;
        let mut rest = wanted(&["slow", "other"]);
        rest.wanted.remove(0);
        images.want(&rest);
        until(&images, &[ImagePhase::Pulling]).await;
        fake.fetched(Ok(()));
        until(&images, &[ImagePhase::Pulled]).await;
        assert_eq!(fake.asked(), ["fetch slow", "fetch other"]);
        run.abort();
    }
}
