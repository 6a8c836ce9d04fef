//! What a registry knows, as the calls that tell it to another one: for a master that goes on where the one before it ended.

use super::{Nodes, Registry};
use crate::xmlrpc::{Call, Value};

impl Registry {
    /// One call that tells another registry everything but what is the owner's (see [`Registry::keep`]), who registers anew.
    #[must_use]
    pub fn recital(&self) -> Call {
        let mut calls = Vec::new();
        let kind = |topic: &String| self.types.get(topic).map_or("*", String::as_str);
        let topics = |method: &str, nodes: &Nodes, calls: &mut Vec<Value>| {
            for (topic, nodes) in nodes {
                let others = nodes.iter().filter(|(node, _)| !self.kept.contains(node));
                calls.extend(
                    others.map(|(node, api)| call(method, &[node, topic, kind(topic), api])),
                );
            }
        };
        topics("registerPublisher", &self.publishers, &mut calls);
        topics("registerSubscriber", &self.subscribers, &mut calls);
        for (service, (node, at)) in &self.services {
            if let Some(api) = self.nodes.get(node).filter(|_| !self.kept.contains(node)) {
                calls.push(call("registerService", &[node, service, at, api]));
            }
        }
        for (node, api, key) in self.params.followers() {
            calls.push(call("subscribeParam", &[node, api, &key]));
        }
        let mut params = call("setParam", &["/recital", "/"]);
        if let Value::Struct(members) = &mut params
            && let Some((_, Value::Array(said))) = members.last_mut()
        {
            said.push(self.params.all());
        }
        calls.push(params);
        Call { method: "system.multicall".to_owned(), params: vec![calls.into()] }
    }
}

fn call(method: &str, params: &[&str]) -> Value {
    let params: Vec<Value> = params.iter().map(|text| (*text).into()).collect();
    Value::Struct(vec![
        ("methodName".to_owned(), method.into()),
        ("params".to_owned(), params.into()),
    ])
}
