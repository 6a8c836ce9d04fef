//! Event objects: what happened to an object, for `describe`. Best effort: an event that cannot be
//! written at once is dropped, because nothing may wait for one.

use std::sync::Arc;

use k8s_openapi::api::core::v1::{Event, EventSource, ObjectReference};
use k8s_openapi::apimachinery::pkg::apis::meta::v1::{ObjectMeta, Time};
use muster_api::kind::application::Application;
use muster_api::kind::namespace::DEFAULT;
use muster_api::kind::task::Task;
use muster_api::kind::taskset::TaskSet;
use tokio::sync::mpsc;

use crate::context::Context;
use crate::objects::{self, EVENTS};
use crate::store::{Key, StoreError};

/// Events that wait to be written. A burst (a thousand tasks bound at once) overruns this, and the
/// rest of the burst is dropped: the tasks' own status tells the same.
const QUEUE: usize = 256;

/// What happened, before it is an object.
#[derive(Debug)]
pub struct Happening {
    about: ObjectReference,
    kind: &'static str,
    reason: &'static str,
    message: String,
}

/// Takes what happened.
#[derive(Debug, Clone)]
pub struct Recorder {
    queue: mpsc::Sender<Happening>,
}

impl Recorder {
    /// A recorder and what [`run`] needs to write.
    #[must_use]
    pub fn new() -> (Self, mpsc::Receiver<Happening>) {
        let (queue, receiver) = mpsc::channel(QUEUE);
        (Recorder { queue }, receiver)
    }

    fn put(&self, happening: Happening) {
        if self.queue.try_send(happening).is_err() {
            metrics::counter!("muster_events_dropped_total").increment(1);
        }
    }

    /// Something usual about a task.
    pub fn task(&self, task: &Task, reason: &'static str, message: String) {
        self.put(Happening { about: task_reference(task), kind: "Normal", reason, message });
    }

    /// Something about a task that its owner should look at.
    pub fn warn_task(&self, task: &Task, reason: &'static str, message: String) {
        self.put(Happening { about: task_reference(task), kind: "Warning", reason, message });
    }

    /// The controller has ordered the end of a task, and says there why.
    pub fn ordered_to_end(&self, task: &Task, reason: &'static str) {
        let stop = task.status.as_ref().and_then(|status| status.stop.as_ref());
        self.warn_task(task, reason, stop.map(|stop| stop.message.clone()).unwrap_or_default());
    }

    /// Something usual about a set of tasks.
    pub fn set(&self, set: &TaskSet, reason: &'static str, message: String) {
        self.put(Happening { about: set_reference(set), kind: "Normal", reason, message });
    }

    /// Something about a set of tasks that its owner should look at.
    pub fn warn_set(&self, set: &TaskSet, reason: &'static str, message: String) {
        self.put(Happening { about: set_reference(set), kind: "Warning", reason, message });
    }

    /// Something usual about an application.
    pub fn application(&self, app: &Application, reason: &'static str, message: String) {
        let about = application_reference(app);
        self.put(Happening { about, kind: "Normal", reason, message });
    }

    /// Something about an application that its owner should look at.
    pub fn warn_application(&self, app: &Application, reason: &'static str, message: String) {
        let about = application_reference(app);
        self.put(Happening { about, kind: "Warning", reason, message });
    }

    /// Something usual about a node.
    pub fn node(&self, node: &str, reason: &'static str, message: String) {
        self.put(Happening { about: node_reference(node), kind: "Normal", reason, message });
    }

    /// Something about a node that its operator should look at.
    pub fn warn_node(&self, node: &str, reason: &'static str, message: String) {
        self.put(Happening { about: node_reference(node), kind: "Warning", reason, message });
    }
}

fn task_reference(task: &Task) -> ObjectReference {
    reference("Task", &task.metadata)
}

fn set_reference(set: &TaskSet) -> ObjectReference {
    reference("TaskSet", &set.metadata)
}

fn application_reference(application: &Application) -> ObjectReference {
    reference("Application", &application.metadata)
}

fn reference(kind: &str, metadata: &ObjectMeta) -> ObjectReference {
    ObjectReference {
        api_version: Some(muster_api::API_VERSION.to_owned()),
        kind: Some(kind.to_owned()),
        name: metadata.name.clone(),
        namespace: metadata.namespace.clone(),
        uid: metadata.uid.clone(),
        ..ObjectReference::default()
    }
}

fn node_reference(node: &str) -> ObjectReference {
    ObjectReference {
        api_version: Some(muster_api::API_VERSION.to_owned()),
        kind: Some("Node".to_owned()),
        name: Some(node.to_owned()),
        ..ObjectReference::default()
    }
}

/// Writes events as they come, until dropped.
pub async fn run(context: Arc<Context>, mut happenings: mpsc::Receiver<Happening>) {
    while let Some(happening) = happenings.recv().await {
        if let Err(error) = write(&context, happening).await {
            tracing::debug!(%error, "an event is not written");
        }
    }
}

async fn write(context: &Context, mut happening: Happening) -> Result<(), StoreError> {
    if let Some(name) = happening.about.name.as_deref().filter(|_| happening.about.uid.is_none()) {
        // A node, which is told of by its name; those who describe it look for its uid.
        let node = context.store.get(&objects::node_key(name));
        happening.about.uid = node.map(|node| node.uid.to_string());
    }
    let now = context.clock.now();
    let namespace = happening.about.namespace.clone().unwrap_or_else(|| DEFAULT.to_owned());
    let suffix = uuid::Uuid::new_v4().simple().to_string();
    let name = format!("{}.{}", happening.about.name.as_deref().unwrap_or("object"), &suffix[..12]);
    let mut event = Event {
        metadata: ObjectMeta {
            name: Some(name.clone()),
            namespace: Some(namespace.clone()),
            ..ObjectMeta::default()
        },
        involved_object: happening.about,
        type_: Some(happening.kind.to_owned()),
        reason: Some(happening.reason.to_owned()),
        message: Some(happening.message),
        first_timestamp: Some(Time(now)),
        last_timestamp: Some(Time(now)),
        count: Some(1),
        source: Some(EventSource { component: Some("muster-controller".to_owned()), host: None }),
        ..Event::default()
    };
    objects::stamp_new(&mut event.metadata, now);
    let mut value = objects::to_value(&event);
    value["apiVersion"] = "v1".into();
    value["kind"] = "Event".into();
    context.store.create(Key::namespaced(EVENTS, namespace, name), value).await.map(drop)
}
