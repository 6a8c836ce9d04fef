//! Waiting with a deadline, and with a message that says what was seen last.

use std::fmt::Debug;
use std::time::Duration;

use futures::StreamExt as _;
use kube::runtime::{WatchStreamExt as _, watcher};
use kube::{Api, Resource};

/// No wait in a test should take this long; a machine under load may need a good part of it.
pub const DEADLINE: Duration = Duration::from_secs(60);

/// Waits until the named object satisfies `condition`, fed by a watch. `None` is an object that is
/// not there.
///
/// # Panics
///
/// When the deadline passes, with the state seen last.
#[track_caller]
pub fn object<K, F>(
    api: Api<K>,
    name: &str,
    what: &str,
    condition: F,
) -> impl Future<Output = Option<K>>
where
    K: Resource + Clone + Debug + Send + serde::de::DeserializeOwned + 'static,
    F: Fn(Option<&K>) -> bool,
{
    let (name, what) = (name.to_owned(), what.to_owned());
    async move {
        let mut last: Option<K> = None;
        let waited = tokio::time::timeout(DEADLINE, async {
            let mut states = watcher::watch_object(api, &name).default_backoff().boxed();
            while let Some(state) = states.next().await {
                // A watch that breaks (the controller is being killed) is begun again by the backoff.
                let Ok(state) = state else { continue };
                last.clone_from(&state);
                if condition(state.as_ref()) {
                    return;
                }
            }
            panic!("the watch of {name} ended");
        })
        .await;
        assert!(waited.is_ok(), "{name}: not {what} within {DEADLINE:?}; it is {last:#?}");
        last
    }
}

/// Asks again and again until `probe` gives a value; for what no watch shows.
///
/// # Panics
///
/// When the deadline passes, with what the probe said last.
pub async fn until<T, F: Future<Output = Result<T, String>>>(
    what: &str,
    mut probe: impl FnMut() -> F,
) -> T {
    let mut last = String::new();
    let mut ticks = tokio::time::interval(Duration::from_millis(20));
    let waited = tokio::time::timeout(DEADLINE, async {
        loop {
            ticks.tick().await;
            match probe().await {
                Ok(value) => return value,
                Err(said) => last = said,
            }
        }
    })
    .await;
    match waited {
        Ok(value) => value,
        Err(_) => panic!("not {what} within {DEADLINE:?}; last: {last}"),
    }
}

/// Lets a span of time pass, for measurements over a span; never to wait for something.
pub async fn idle(span: Duration) {
    tokio::time::sleep(span).await;
}
