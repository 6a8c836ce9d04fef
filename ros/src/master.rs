//! The master's API, as one of its nodes calls it (wiki.ros.org/ROS/Master_API, /Parameter_Server_API).

use crate::xmlrpc::Value;
use crate::xmlrpc::http::{CallError, Uri, invoke};

/// A master, and on whose behalf it is asked.
#[derive(Debug, Clone)]
pub struct Master {
    uri: Uri,
    caller: String,
}

/// Why the master gives no value.
#[derive(Debug, thiserror::Error)]
pub enum MasterError {
    /// The call came to nothing.
    #[error("{method} failed")]
    Call {
        /// The method.
        method: &'static str,
        /// Why.
        #[source]
        source: CallError,
    },
    /// It says no: status −1 (the caller erred) or 0 (it failed).
    #[error("the master refuses {method}: {message}")]
    Refused {
        /// The method.
        method: &'static str,
        /// Its word.
        message: String,
    },
    /// It answers with something else than the API says.
    #[error("the master's answer to {method} is not what its API says")]
    Shape {
        /// The method.
        method: &'static str,
    },
}

impl MasterError {
    /// The master is there, and says no: what was asked for is not there.
    #[must_use]
    pub fn is_refusal(&self) -> bool {
        matches!(self, MasterError::Refused { .. })
    }
}

/// A topic or service, and the nodes that have to do with it.
pub type Users = Vec<(String, Vec<String>)>;

/// Who publishes, subscribes and serves what, as the master knows it: what died without a word is still in it.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct SystemState {
    /// Topics with their publishers.
    pub publishers: Users,
    /// Topics with their subscribers.
    pub subscribers: Users,
    /// Services with their providers.
    pub services: Users,
}

impl Master {
    /// The master at `uri`, asked by the node `caller`.
    #[must_use]
    pub fn new(uri: Uri, caller: &str) -> Self {
        Master { uri, caller: caller.to_owned() }
    }

    /// Where it is.
    #[must_use]
    pub fn uri(&self) -> &Uri {
        &self.uri
    }

    async fn call<T>(
        &self,
        method: &'static str,
        params: impl IntoIterator<Item = Value>,
        read: impl FnOnce(&Value) -> Option<T>,
    ) -> Result<T, MasterError> {
        let mut all = vec![Value::from(&*self.caller)];
        all.extend(params);
        let answer = invoke(&self.uri, method, &all).await;
        let answer = answer.map_err(|source| MasterError::Call { method, source })?;
        unpack(method, &answer, read)
    }

    /// Registers a publisher; the subscribers' addresses.
    ///
    /// # Errors
    ///
    /// The master does not take it.
    pub async fn register_publisher(
        &self,
        topic: &str,
        kind: &str,
        api: &Uri,
    ) -> Result<Vec<String>, MasterError> {
        self.register("registerPublisher", [topic, kind], api).await
    }

    /// Takes a publisher back; whether it was registered.
    ///
    /// # Errors
    ///
    /// The master does not answer.
    pub async fn unregister_publisher(&self, topic: &str, api: &Uri) -> Result<bool, MasterError> {
        self.unregister("unregisterPublisher", topic, api).await
    }

    /// Registers a subscriber; the publishers' addresses. `*` is a type that takes any.
    ///
    /// # Errors
    ///
    /// The master does not take it.
    pub async fn register_subscriber(
        &self,
        topic: &str,
        kind: &str,
        api: &Uri,
    ) -> Result<Vec<String>, MasterError> {
        self.register("registerSubscriber", [topic, kind], api).await
    }

    /// Takes a subscriber back; whether it was registered.
    ///
    /// # Errors
    ///
    /// The master does not answer.
    pub async fn unregister_subscriber(&self, topic: &str, api: &Uri) -> Result<bool, MasterError> {
        self.unregister("unregisterSubscriber", topic, api).await
    }

    async fn register(
        &self,
        method: &'static str,
        [topic, kind]: [&str; 2],
        api: &Uri,
    ) -> Result<Vec<String>, MasterError> {
        let params = [topic.into(), kind.into(), api.to_string().into()];
        self.call(method, params, list).await
    }

    async fn unregister(
        &self,
        method: &'static str,
        topic: &str,
        api: &Uri,
    ) -> Result<bool, MasterError> {
        let taken = self.call(method, [topic.into(), api.to_string().into()], number).await?;
        Ok(taken > 0)
    }

    /// The address of a node.
    ///
    /// # Errors
    ///
    /// A refusal: the master does not know it.
    pub async fn lookup_node(&self, node: &str) -> Result<String, MasterError> {
        self.call("lookupNode", [node.into()], text).await
    }

    /// The address of a service, `rosrpc://HOST:PORT`.
    ///
    /// # Errors
    ///
    /// A refusal: nobody serves it.
    pub async fn lookup_service(&self, service: &str) -> Result<String, MasterError> {
        self.call("lookupService", [service.into()], text).await
    }

    /// Topics that are published, with their types; below `under` only, unless it is empty.
    ///
    /// # Errors
    ///
    /// The master does not answer.
    pub async fn published_topics(
        &self,
        under: &str,
    ) -> Result<Vec<(String, String)>, MasterError> {
        self.call("getPublishedTopics", [under.into()], pairs).await
    }

    /// The types of all topics that the master has heard of.
    ///
    /// # Errors
    ///
    /// The master does not answer.
    pub async fn topic_types(&self) -> Result<Vec<(String, String)>, MasterError> {
        self.call("getTopicTypes", [], pairs).await
    }

    /// Who has to do with what.
    ///
    /// # Errors
    ///
    /// The master does not answer.
    pub async fn system_state(&self) -> Result<SystemState, MasterError> {
        self.call("getSystemState", [], |value| match value.as_array()? {
            [publishers, subscribers, services] => Some(SystemState {
                publishers: users(publishers)?,
                subscribers: users(subscribers)?,
                services: users(services)?,
            }),
            _ => None,
        })
        .await
    }

    /// The master's own address.
    ///
    /// # Errors
    ///
    /// The master does not answer.
    pub async fn uri_of_master(&self) -> Result<String, MasterError> {
        self.call("getUri", [], text).await
    }

    /// The process of the master. In a container it is the same after every restart.
    ///
    /// # Errors
    ///
    /// The master does not answer.
    pub async fn pid(&self) -> Result<i32, MasterError> {
        self.call("getPid", [], number).await
    }

    /// A parameter.
    ///
    /// # Errors
    ///
    /// A refusal: it is not set.
    pub async fn param(&self, key: &str) -> Result<Value, MasterError> {
        self.call("getParam", [key.into()], |value| Some(value.clone())).await
    }

    /// Sets a parameter.
    ///
    /// # Errors
    ///
    /// The master does not take it.
    pub async fn set_param(&self, key: &str, value: Value) -> Result<(), MasterError> {
        self.call("setParam", [key.into(), value], |_| Some(())).await
    }

    /// Takes a parameter away.
    ///
    /// # Errors
    ///
    /// A refusal: it is not set.
    pub async fn delete_param(&self, key: &str) -> Result<(), MasterError> {
        self.call("deleteParam", [key.into()], |_| Some(())).await
    }

    /// Whether a parameter is set.
    ///
    /// # Errors
    ///
    /// The master does not answer.
    pub async fn has_param(&self, key: &str) -> Result<bool, MasterError> {
        self.call("hasParam", [key.into()], number).await.map(|n| n != 0)
    }

    /// The nearest parameter of that name, from the caller's namespace upwards.
    ///
    /// # Errors
    ///
    /// A refusal: there is none.
    pub async fn search_param(&self, key: &str) -> Result<String, MasterError> {
        self.call("searchParam", [key.into()], text).await
    }

    /// The names of all parameters.
    ///
    /// # Errors
    ///
    /// The master does not answer.
    pub async fn param_names(&self) -> Result<Vec<String>, MasterError> {
        self.call("getParamNames", [], list).await
    }

    /// Asks to be told of a parameter's changes; its value now, an empty struct while it is not set.
    ///
    /// # Errors
    ///
    /// The master does not take it.
    pub async fn subscribe_param(&self, key: &str, api: &Uri) -> Result<Value, MasterError> {
        self.call("subscribeParam", [api.to_string().into(), key.into()], |value| {
            Some(value.clone())
        })
        .await
    }

    /// Does not ask any more.
    ///
    /// # Errors
    ///
    /// The master does not answer.
    pub async fn unsubscribe_param(&self, key: &str, api: &Uri) -> Result<bool, MasterError> {
        self.call("unsubscribeParam", [api.to_string().into(), key.into()], number)
            .await
            .map(|n| n > 0)
    }
}

/// `[status, message, value]`, the shape of all answers, of masters and nodes.
pub(crate) fn unpack<T>(
    method: &'static str,
    answer: &Value,
    read: impl FnOnce(&Value) -> Option<T>,
) -> Result<T, MasterError> {
    let Some([status, message, value]) = answer.as_array() else {
        return Err(MasterError::Shape { method });
    };
    if status.as_int() != Some(1) {
        let message = message.as_str().unwrap_or_default().to_owned();
        return Err(MasterError::Refused { method, message });
    }
    read(value).ok_or(MasterError::Shape { method })
}

fn text(value: &Value) -> Option<String> {
    value.as_str().map(str::to_owned)
}

fn number(value: &Value) -> Option<i32> {
    value.as_int()
}

fn list(value: &Value) -> Option<Vec<String>> {
    value.as_array().map(|_| value.strings())
}

fn pairs(value: &Value) -> Option<Vec<(String, String)>> {
    let pair = |pair: &Value| match pair.as_array()? {
        [name, kind] => Some((text(name)?, text(kind)?)),
        _ => None,
    };
    value.as_array()?.iter().map(pair).collect()
}

fn users(value: &Value) -> Option<Users> {
    let one = |one: &Value| match one.as_array()? {
        [name, nodes] => Some((text(name)?, list(nodes)?)),
        _ => None,
    };
    value.as_array()?.iter().map(one).collect()
}
