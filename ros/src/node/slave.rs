//! The API that the master and other nodes call (wiki.ros.org/ROS/Slave_API).
//!
//! Nobody proves who he is here. So an update is a hint only: who publishes a topic, and what a parameter is, are then
//! asked of the master.

use std::sync::Arc;

use super::{Shared, lock};
use crate::xmlrpc::http::Handler;
use crate::xmlrpc::{Answer, Call, Fault, Value};

#[derive(Debug)]
pub(super) struct Slave(pub(super) Arc<Shared>);

/// What a method gives: a value, or why the caller erred.
type Outcome = Result<Value, String>;

impl Handler for Slave {
    fn handle(&self, call: Call) -> Answer {
        let outcome = match &*call.method {
            "getBusStats" => Ok(self.0.bus.stats()),
            "getBusInfo" => Ok(self.0.bus.info()),
            "getMasterUri" => Ok(self.0.master.uri().to_string().into()),
            "getPid" => Ok(Value::Int(i32::try_from(std::process::id()).unwrap_or(-1))),
            "getSubscriptions" => Ok(self.subscriptions()),
            "getPublications" => Ok(self.publications()),
            "shutdown" => self.shutdown(&call.params),
            "paramUpdate" => self.param_update(&call.params),
            "publisherUpdate" => self.publisher_update(&call.params),
            "requestTopic" => self.request_topic(&call.params),
            other => {
                return Err(Fault { code: 1, text: format!("method {other:?} is not supported") });
            }
        };
        let (status, message, value) = match outcome {
            Ok(value) => (1, String::new(), value),
            Err(message) => (-1, message, Value::Int(0)),
        };
        Ok(Value::Array(vec![Value::Int(status), message.into(), value]))
    }
}

fn text<'a>(params: &'a [Value], index: usize, name: &str) -> Result<&'a str, String> {
    params
        .get(index)
        .and_then(Value::as_str)
        .ok_or_else(|| format!("parameter [{name}] must be a string"))
}

impl Slave {
    fn subscriptions(&self) -> Value {
        let topics = self.0.topics();
        let pair = |(topic, s): (&String, &Arc<super::Subscription>)| {
            vec![topic.clone().into(), s.kind().into()].into()
        };
        Value::Array(topics.subscriptions.iter().map(pair).collect())
    }

    fn publications(&self) -> Value {
        let topics = self.0.topics();
        let pair = |(topic, p): (&String, &Arc<super::Publication>)| {
            vec![topic.clone().into(), p.kind().into()].into()
        };
        Value::Array(topics.publications.iter().map(pair).collect())
    }

    fn shutdown(&self, params: &[Value]) -> Outcome {
        let who = text(params, 0, "caller_id")?;
        let why = params.get(1).and_then(Value::as_str).unwrap_or_default();
        if self.0.stays {
            tracing::warn!(
                node = self.0.name,
                who,
                why,
                "somebody wants this ROS node to end; it stays"
            );
            return Err(format!("{} does not end for others", self.0.name));
        }
        tracing::warn!(node = self.0.name, who, why, "somebody wants this ROS node to end");
        self.0.ended.send_replace(Some(format!("{who} ended it: {why}")));
        Ok(Value::Int(0))
    }

    fn param_update(&self, params: &[Value]) -> Outcome {
        // With or without a slash at its end, as the master writes keys of dictionaries.
        let key = text(params, 1, "parameter_key")?.trim_end_matches('/');
        if let Some(param) = self.0.topics().params.get(key) {
            *lock(&param.registered) = false;
            self.0.work.notify_one();
        }
        Ok(Value::Int(0))
    }

    fn publisher_update(&self, params: &[Value]) -> Outcome {
        let topic = text(params, 1, "topic")?;
        if let Some(subscription) = self.0.topics().subscriptions.get(topic) {
            subscription.doubt();
            self.0.work.notify_one();
        }
        Ok(Value::Int(0))
    }

    fn request_topic(&self, params: &[Value]) -> Outcome {
        let topic = text(params, 1, "topic")?;
        if !self.0.topics().publications.contains_key(topic) {
            return Err(format!("{} does not publish {topic}", self.0.name));
        }
        let protocols = params.get(2).and_then(Value::as_array).unwrap_or_default();
        let tcpros = |p: &Value| {
            p.as_array().and_then(|p| p.first()).and_then(Value::as_str) == Some("TCPROS")
        };
        if !protocols.iter().any(tcpros) {
            return Err("only TCPROS is spoken here".to_owned());
        }
        let port = Value::Int(self.0.data.port.into());
        Ok(Value::Array(vec!["TCPROS".into(), (&*self.0.data.host).into(), port]))
    }
}
