//! What the demo asks of its controller.

use std::path::Path;

use muster_api::kind::KindInfo;
use muster_api::kind::lease::Lease;
use muster_api::kind::node::Node;
use muster_api::kind::task::Task;
use serde::Deserialize;
use serde::de::DeserializeOwned;
use serde_json::{Value, json};

use crate::client::{Client, Deletion, Mode, Selection, group_path, path, with_query};
use crate::config;
use crate::error::CliError;
use crate::target;

const NAMESPACE: Option<&str> = Some("default");

/// A connection to the demo's controller.
#[derive(Clone)]
pub(super) struct Api {
    client: Client,
}

impl std::fmt::Debug for Api {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Api").field("server", &self.client.server).finish()
    }
}

/// What a task uses, as `GET …/usage` says.
#[derive(Debug, Clone, Deserialize)]
#[serde(rename_all = "camelCase")]
pub(super) struct TaskUse {
    pub(super) uid: String,
    pub(super) memory_bytes: u64,
    /// Since the attempt started.
    pub(super) cpu_total_usec: u64,
}

/// What a node's whole machine uses.
#[derive(Debug, Clone, Deserialize)]
#[serde(rename_all = "camelCase")]
pub(super) struct NodeUse {
    pub(super) cpu_millis: u64,
}

/// The last heartbeats of all nodes.
#[derive(Debug, Deserialize)]
pub(super) struct Usage {
    pub(super) nodes: Vec<NodeUse>,
    pub(super) tasks: Vec<TaskUse>,
}

impl Api {
    /// Connects to the controller of a kubeconfig.
    pub(super) async fn connect(kubeconfig: &Path) -> Result<Self, CliError> {
        let source = config::source(Some(kubeconfig), |_| None, None);
        let client = Client::new(config::load(source, None).await?)?;
        Ok(Api { client })
    }

    /// The controller's URL.
    pub(super) fn server(&self) -> &str {
        &self.client.server
    }

    /// The controller answers.
    pub(super) async fn is_ready(&self) -> bool {
        self.client.stream("/readyz").await.is_ok()
    }

    /// A join token.
    pub(super) async fn token(&self) -> Result<String, CliError> {
        let body = json!({"spec": {"ttlSeconds": 600}});
        let answer: Value = self.client.post_json(&group_path("jointokens"), &body).await?;
        let token = answer.pointer("/status/token").and_then(Value::as_str);
        token.map(str::to_owned).ok_or_else(|| CliError::Answer {
            server: self.client.server.clone(),
            request: "POST jointokens".to_owned(),
            source: serde::de::Error::missing_field("status.token"),
        })
    }

    /// Creates a task.
    pub(super) async fn create(&self, task: &Value) -> Result<Task, CliError> {
        let info = target::kind("task")?;
        let created = self.client.create(info, NAMESPACE, task, Mode::Store).await?;
        self.read(created, "task")
    }

    /// A task, when it exists.
    pub(super) async fn task(&self, name: &str) -> Result<Option<Task>, CliError> {
        self.find(target::kind("task")?, NAMESPACE, name).await
    }

    /// A node, when it has joined.
    pub(super) async fn node(&self, name: &str) -> Result<Option<Node>, CliError> {
        self.find(target::kind("node")?, None, name).await
    }

    /// A lease, when it was ever granted.
    pub(super) async fn lease(&self, name: &str) -> Result<Option<Lease>, CliError> {
        self.find(target::kind("lease")?, None, name).await
    }

    async fn find<T: DeserializeOwned>(
        &self,
        info: &KindInfo,
        namespace: Option<&str>,
        name: &str,
    ) -> Result<Option<T>, CliError> {
        let found = self.client.find(info, namespace, name).await?;
        found.map(|object| self.read(object, info.singular)).transpose()
    }

    fn read<T: DeserializeOwned>(&self, object: Value, what: &str) -> Result<T, CliError> {
        serde_json::from_value(object).map_err(|source| CliError::Answer {
            server: self.client.server.clone(),
            request: what.to_owned(),
            source,
        })
    }

    /// Names of all tasks.
    pub(super) async fn task_names(&self) -> Result<Vec<String>, CliError> {
        let list =
            self.client.list(target::kind("task")?, NAMESPACE, &Selection::default()).await?;
        let name = |o: &Value| o.pointer("/metadata/name")?.as_str().map(str::to_owned);
        Ok(list.items.iter().filter_map(name).collect())
    }

    /// Asks for the end of a task; it is gone when none of its processes is left.
    pub(super) async fn delete(&self, name: &str) -> Result<(), CliError> {
        match self.client.delete(target::kind("task")?, NAMESPACE, name, Deletion::default()).await
        {
            Err(error) if !error.is_not_found() => Err(error),
            _ => Ok(()),
        }
    }

    /// What nodes and running tasks use.
    pub(super) async fn usage(&self) -> Result<Usage, CliError> {
        self.client.get_json(&group_path("usage")).await
    }

    /// The last lines of what a task wrote; nothing when its node does not have it yet.
    pub(super) async fn log(&self, name: &str, lines: u64) -> Result<String, CliError> {
        let path = format!("{}/log", path(target::kind("task")?, NAMESPACE, Some(name)));
        let uri = with_query(&path, &[("tailLines", &lines.to_string())]);
        let mut stream = match self.client.stream(&uri).await {
            Ok(stream) => stream,
            Err(CliError::Refused(_)) => return Ok(String::new()),
            Err(error) => return Err(error),
        };
        let mut text = Vec::new();
        while let Some(bytes) = stream.next_bytes().await? {
            text.extend_from_slice(&bytes);
        }
        Ok(String::from_utf8_lossy(&text).into_owned())
    }
}
