//! Following a collection: list, then watch from the list's revision; again when the watch ends.
//!
//! What the caller sees is level-triggered: [`Change::Synced`] says that everything before it is a
//! whole picture. A lost connection or a compacted revision (410) costs a new list, from which the
//! deletions that were missed are made up.

use std::collections::{BTreeMap, VecDeque};
use std::time::Duration;

use futures::StreamExt as _;
use futures::stream::{LocalBoxStream, SelectAll};
use kube::core::Status;
use muster_api::kind::KindInfo;
use serde::Deserialize;
use serde_json::Value;

use crate::client::{Client, Selection, Stream, path, with_kind, with_query};
use crate::error::{Class, CliError};

/// The controller ends a watch after this many seconds; the client then asks for the next one.
const WATCH_SECONDS: &str = "300";
/// Pauses between attempts to reach a controller that was there before. A restart takes at most
/// three seconds; after all of these (about half a minute) it is down, and the command says so.
const PAUSES: [Duration; 8] = [
    Duration::from_millis(100),
    Duration::from_millis(300),
    Duration::from_secs(1),
    Duration::from_secs(2),
    Duration::from_secs(4),
    Duration::from_secs(8),
    Duration::from_secs(8),
    Duration::from_secs(8),
];

/// What has happened to a collection.
#[derive(Debug)]
pub(crate) enum Change {
    /// The object is there and looks like this now.
    Applied(Value),
    /// The object is gone; as it was last seen.
    Deleted(Value),
    /// A list is complete.
    Synced,
}

/// A collection that is followed.
pub(crate) struct Follow {
    client: Client,
    info: &'static KindInfo,
    namespace: Option<String>,
    selection: Selection,
    /// Where the next watch begins; none: a list is needed.
    revision: Option<String>,
    stream: Option<Stream>,
    ready: VecDeque<Change>,
    known: BTreeMap<String, Value>,
    failures: usize,
    listed: bool,
}

#[derive(Deserialize)]
struct WatchEvent {
    r#type: String,
    object: Value,
}

impl Follow {
    /// Follows the objects of `info` that are selected.
    pub(crate) fn new(
        client: &Client,
        info: &'static KindInfo,
        namespace: Option<&str>,
        selection: Selection,
    ) -> Self {
        Follow {
            client: client.clone(),
            info,
            namespace: namespace.map(str::to_owned),
            selection,
            revision: None,
            stream: None,
            ready: VecDeque::new(),
            known: BTreeMap::new(),
            failures: 0,
            listed: false,
        }
    }

    /// The next change. Cancel-safe: a request that is given up is made again.
    pub(crate) async fn next(&mut self) -> Result<Change, CliError> {
        loop {
            if let Some(change) = self.ready.pop_front() {
                return Ok(change);
            }
            match self.step().await {
                Ok(()) => self.failures = 0,
                Err(error) => self.recover(error).await?,
            }
        }
    }

    async fn step(&mut self) -> Result<(), CliError> {
        let Some(revision) = self.revision.clone() else {
            return self.list().await;
        };
        let Some(stream) = &mut self.stream else {
            self.stream = Some(self.open(&revision).await?);
            return Ok(());
        };
        match stream.next_line().await? {
            Some(line) => self.read(&line),
            None => {
                self.stream = None;
                Ok(())
            }
        }
    }

    async fn list(&mut self) -> Result<(), CliError> {
        let namespace = self.namespace.as_deref();
        let list = self.client.list(self.info, namespace, &self.selection).await?;
        let mut before = std::mem::take(&mut self.known);
        for object in list.items {
            let old = before.remove(&key(&object));
            self.known.insert(key(&object), object.clone());
            if old.as_ref() != Some(&object) {
                self.ready.push_back(Change::Applied(object));
            }
        }
        self.ready.extend(before.into_values().map(Change::Deleted));
        self.ready.push_back(Change::Synced);
        self.revision = Some(list.revision);
        self.listed = true;
        Ok(())
    }

    async fn open(&self, revision: &str) -> Result<Stream, CliError> {
        let mut pairs = self.selection.pairs();
        pairs.extend([
            ("watch", "true"),
            ("resourceVersion", revision),
            ("allowWatchBookmarks", "true"),
            ("timeoutSeconds", WATCH_SECONDS),
        ]);
        let path = path(self.info, self.namespace.as_deref(), None);
        self.client.stream(&with_query(&path, &pairs)).await
    }

    fn read(&mut self, line: &[u8]) -> Result<(), CliError> {
        if line.iter().all(u8::is_ascii_whitespace) {
            return Ok(());
        }
        let event: WatchEvent =
            serde_json::from_slice(line).map_err(|source| CliError::Answer {
                server: self.client.server.clone(),
                request: format!("watch of {}", self.info.plural),
                source,
            })?;
        if event.r#type == "ERROR" {
            let status: Status = serde_json::from_value(event.object).unwrap_or_default();
            return Err(self.client.refused(status));
        }
        let object = with_kind(event.object, self.info);
        if let Some(revision) = object.pointer("/metadata/resourceVersion").and_then(Value::as_str)
        {
            self.revision = Some(revision.to_owned());
        }
        match event.r#type.as_str() {
            "ADDED" | "MODIFIED" => {
                self.known.insert(key(&object), object.clone());
                self.ready.push_back(Change::Applied(object));
            }
            "DELETED" => {
                self.known.remove(&key(&object));
                self.ready.push_back(Change::Deleted(object));
            }
            // A bookmark, or something newer than this program: only the revision matters.
            _ => {}
        }
        Ok(())
    }

    /// Decides what an error means: a new list, another attempt after a pause, or the end.
    async fn recover(&mut self, error: CliError) -> Result<(), CliError> {
        self.stream = None;
        let gone =
            matches!(&error, CliError::Refused(r) if r.reason == "Expired" || r.reason == "Gone");
        if gone {
            self.revision = None;
        } else if !self.listed || error.class() != Class::Unreachable {
            return Err(error);
        }
        let Some(pause) = PAUSES.get(self.failures) else {
            return Err(error);
        };
        self.failures += 1;
        tokio::time::sleep(*pause).await;
        Ok(())
    }
}

/// What tells objects of one kind apart, over their lives.
pub(crate) fn key(object: &Value) -> String {
    let text =
        |field: &str| object.pointer(field).and_then(Value::as_str).unwrap_or_default().to_owned();
    format!("{}/{}/{}", text("/metadata/namespace"), text("/metadata/name"), text("/metadata/uid"))
}

/// Several collections followed as one.
pub(crate) struct Merged {
    streams: SelectAll<LocalBoxStream<'static, Result<Change, CliError>>>,
}

/// Follows several collections at once. An error of one ends all.
pub(crate) fn merged(follows: impl IntoIterator<Item = Follow>) -> Merged {
    let stream = |follow: Follow| {
        futures::stream::unfold(
            follow,
            |mut follow| async move { Some((follow.next().await, follow)) },
        )
        .boxed_local()
    };
    Merged { streams: futures::stream::select_all(follows.into_iter().map(stream)) }
}

impl Merged {
    /// The next change of any. Of no collections there never is one.
    pub(crate) async fn recv(&mut self) -> Result<Change, CliError> {
        match self.streams.next().await {
            Some(change) => change,
            None => std::future::pending().await,
        }
    }
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;
    use crate::fake::{Fake, task};
    use crate::target;

    async fn next(follow: &mut Follow) -> String {
        let name = |o: &Value| o["metadata"]["name"].as_str().unwrap_or_default().to_owned();
        match follow.next().await.expect("a change") {
            Change::Applied(object) => format!("+{}", name(&object)),
            Change::Deleted(object) => format!("-{}", name(&object)),
            Change::Synced => "synced".to_owned(),
        }
    }

    #[tokio::test]
    async fn a_list_then_its_changes_and_after_a_410_what_was_missed() {
        let fake = Fake::new();
        fake.put("tasks/default/a", task("a", json!({})));
        fake.put("tasks/default/b", task("b", json!({})));
        let info = target::kind("task").expect("served");
        let mut follow = Follow::new(&fake.client(), info, Some("default"), Selection::default());
        for expected in ["+a", "+b", "synced"] {
            assert_eq!(next(&mut follow).await, expected);
        }
        fake.edit("tasks/default/a", |o| o["status"] = json!({"phase": "Running"}));
        assert_eq!(next(&mut follow).await, "+a");
        // The watch misses this one, and its revision is compacted.
        fake.remove("tasks/default/b");
        fake.compact();
        fake.put("tasks/default/c", task("c", json!({})));
        for expected in ["+c", "-b", "synced"] {
            assert_eq!(next(&mut follow).await, expected);
        }
    }
}
