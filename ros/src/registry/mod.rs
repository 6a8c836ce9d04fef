//! A master's state: who publishes, subscribes and serves what, and the parameters. Pure: a call comes in, an answer and notices
//! go out. What is answered is what rosmaster answers (`rosmaster/master_api.py`), within bounds: whoever reaches a master may
//! say anything.
//!
//! A node is its name: one that registers from another address takes the name over, all that the former had is gone, and the
//! former is told to end. Nodes that a [`Registry`] is told to keep are its owner's: nobody takes their names or unregisters
//! what is theirs.

mod params;
mod recital;
mod said;

use std::collections::{BTreeMap, BTreeSet};

use self::params::{Change, ParamError, Params};
use self::said::{Said, one_of_many, parts, path};
use crate::xmlrpc::{Answer, Call, Fault, Value};

/// Registrations together: a large robot has some hundreds.
const MOST: usize = 4096;

/// Types of topics that nobody has any more are forgotten when there are so many.
const TYPES: usize = 4096;

/// What somebody is to be told. Those to one address keep their order.
#[derive(Debug, Clone, PartialEq)]
pub enum Notice {
    /// `publisherUpdate`: all who publish a topic. A newer one to the same address takes the place of an older one.
    Publishers {
        /// The subscriber's address.
        to: String,
        /// The topic.
        topic: String,
        /// The publishers' addresses.
        publishers: Vec<String>,
    },
    /// `paramUpdate`.
    Param {
        /// The follower's address.
        to: String,
        /// With a slash at its end, as rosmaster writes it.
        key: String,
        /// An empty struct when it is not set any more.
        value: Value,
    },
    /// `shutdown`: another node has its name.
    Shutdown {
        /// The former one's address.
        to: String,
        /// Why.
        why: String,
    },
}

/// An answer, and what follows from the call.
#[derive(Debug, Clone, PartialEq)]
#[must_use]
pub struct Response {
    /// What the caller is told.
    pub answer: Answer,
    /// What others are.
    pub notices: Vec<Notice>,
}

/// Nodes by topic: name and address, in the order in which they came.
type Nodes = BTreeMap<String, Vec<(String, String)>>;

/// See the module.
#[derive(Debug, Clone)]
pub struct Registry {
    /// The master's own address.
    uri: String,
    /// Of the process that it is in.
    pid: i32,
    /// By name: the address.
    nodes: BTreeMap<String, String>,
    publishers: Nodes,
    subscribers: Nodes,
    /// By name: the node, and where it serves.
    services: BTreeMap<String, (String, String)>,
    types: BTreeMap<String, String>,
    params: Params,
    /// The owner's nodes.
    kept: BTreeSet<String>,
}

/// A value with what is said to it, or why the caller erred.
type Outcome = Result<(String, Value), String>;

impl Registry {
    /// Of a master at `uri` in the process `pid`; nobody has registered yet.
    #[must_use]
    pub fn new(uri: &str, pid: i32) -> Registry {
        Registry {
            uri: uri.to_owned(),
            pid,
            nodes: BTreeMap::new(),
            publishers: Nodes::new(),
            subscribers: Nodes::new(),
            services: BTreeMap::new(),
            types: BTreeMap::new(),
            params: Params::default(),
            kept: BTreeSet::new(),
        }
    }

    /// The node `name` at `api` is the owner's: from now on others can neither have its name nor take back what it has.
    pub fn keep(&mut self, name: &str, api: &str) {
        self.kept.insert(name.to_owned());
        self.nodes.insert(name.to_owned(), api.to_owned());
    }

    /// Whom this knows, and where.
    #[must_use]
    pub fn nodes(&self) -> &BTreeMap<String, String> {
        &self.nodes
    }

    /// Answers a call; several at once too, as roslaunch makes them.
    pub fn handle(&mut self, call: &Call) -> Response {
        let mut notices = Vec::new();
        let answer = match &*call.method {
            "system.multicall" => self.answer_all(&call.params, &mut notices),
            _ => self.answer(call, &mut notices),
        };
        Response { answer, notices }
    }

    /// An array of answers, each an array of one value or a fault.
    fn answer_all(&mut self, params: &[Value], notices: &mut Vec<Notice>) -> Answer {
        let calls = match params {
            [calls] => calls.as_array(),
            _ => None,
        };
        let malformed = || Fault { code: 1, text: "these are no calls".to_owned() };
        let mut answers = Vec::new();
        for call in calls.ok_or_else(malformed)? {
            let call = one_of_many(call).ok_or_else(malformed)?;
            answers.push(match self.answer(&call, notices) {
                Ok(value) => Value::Array(vec![value]),
                Err(fault) => Value::Struct(vec![
                    ("faultCode".to_owned(), fault.code.into()),
                    ("faultString".to_owned(), fault.text.into()),
                ]),
            });
        }
        Ok(Value::Array(answers))
    }

    fn answer(&mut self, call: &Call, notices: &mut Vec<Notice>) -> Answer {
        let Some(known) = METHODS.iter().find(|(name, _)| *name == call.method) else {
            let text = format!("method {:?} is not supported", call.method);
            return Err(Fault { code: 1, text });
        };
        let outcome = Said::new(&call.params, known.1);
        let outcome = outcome.and_then(|said| self.call(&call.method, &said, notices));
        let (status, message, value) = match outcome {
            Ok((message, value)) => (1, message, value),
            Err(why) => (-1, why, Value::Int(0)),
        };
        Ok(Value::Array(vec![Value::Int(status), message.into(), value]))
    }

    fn call(&mut self, method: &str, said: &Said<'_>, notices: &mut Vec<Notice>) -> Outcome {
        match method {
            "registerPublisher" => self.register_publisher(said, notices),
            "unregisterPublisher" => self.unregister_publisher(said, notices),
            "registerSubscriber" => self.register_subscriber(said, notices),
            "unregisterSubscriber" => self.unregister_subscriber(said),
            "registerService" => self.register_service(said, notices),
            "unregisterService" => self.unregister_service(said),
            "lookupNode" => self.lookup_node(said),
            "lookupService" => self.lookup_service(said),
            "getPublishedTopics" => self.published_topics(said),
            "getTopicTypes" => {
                let types = self.types.iter().map(|(topic, kind)| pair(topic, kind));
                Ok(("current system state".to_owned(), types.collect::<Vec<_>>().into()))
            }
            "getSystemState" => Ok(("current system state".to_owned(), self.system_state())),
            "getUri" => Ok((String::new(), (&*self.uri).into())),
            "getPid" => Ok((String::new(), self.pid.into())),
            "shutdown" => Err("this master does not end for its nodes".to_owned()),
            "setParam" => self.set_param(said, notices),
            "deleteParam" => self.delete_param(said, notices),
            "getParam" => {
                let key = said.key(1)?;
                let value = self.params.get(&key);
                let value =
                    value.ok_or_else(|| format!("Parameter [{}] is not set", path(&key)))?;
                Ok((format!("Parameter [{}]", path(&key)), value))
            }
            "hasParam" => {
                let key = said.key(1)?;
                Ok((path(&key), self.params.has(&key).into()))
            }
            "searchParam" => self.search_param(said),
            "subscribeParam" => self.subscribe_param(said, notices),
            "unsubscribeParam" => {
                let (api, key) = (said.address(1)?, said.key(2)?);
                let followed = self.params.unfollow(&key, said.caller, api);
                self.forget_idle(said.caller);
                Ok((
                    format!("Unsubscribe to parameter [{}]", path(&key)),
                    i32::from(followed).into(),
                ))
            }
            "getParamNames" => {
                let names = self.params.names().into_iter().map(Value::from);
                Ok(("Parameter names".to_owned(), names.collect::<Vec<_>>().into()))
            }
            _ => unreachable!("METHODS names what is here"),
        }
    }

    /// The caller is at this address. Another node of the name was, perhaps: all of it is gone.
    fn admit(
        &mut self,
        said: &Said<'_>,
        api: &str,
        notices: &mut Vec<Notice>,
    ) -> Result<(), String> {
        let caller = said.caller;
        let all: usize = [&self.publishers, &self.subscribers]
            .into_iter()
            .flat_map(BTreeMap::values)
            .map(Vec::len)
            .sum();
        if all + self.services.len() + self.nodes.len() >= MOST {
            return Err("too many nodes have registered".to_owned());
        }
        let former = self.nodes.get(caller);
        if former.is_some_and(|former| former == api) {
            return Ok(());
        }
        if self.kept.contains(caller) {
            return Err(format!("{caller} is not another's name"));
        }
        if let Some(former) = former.cloned() {
            let why = format!("[{caller}] Reason: new node registered with same name");
            notices.push(Notice::Shutdown { to: former, why });
            self.remove(caller, notices);
        }
        self.nodes.insert(caller.to_owned(), api.to_owned());
        Ok(())
    }

    fn remove(&mut self, node: &str, notices: &mut Vec<Notice>) {
        let of = |nodes: &Nodes| -> Vec<String> {
            let has = |(_, nodes): &(&String, &Vec<(String, String)>)| {
                nodes.iter().any(|(name, _)| name == node)
            };
            nodes.iter().filter(has).map(|(topic, _)| topic.clone()).collect()
        };
        for topic in of(&self.subscribers) {
            take(&mut self.subscribers, &topic, |(name, _)| name == node);
        }
        for topic in of(&self.publishers) {
            take(&mut self.publishers, &topic, |(name, _)| name == node);
            self.tell_subscribers(&topic, notices);
        }
        self.services.retain(|_, (name, _)| name != node);
        self.params.forget(node);
        self.nodes.remove(node);
    }

    /// A node that has nothing any more is none.
    fn forget_idle(&mut self, node: &str) {
        let has = |nodes: &Nodes| nodes.values().flatten().any(|(name, _)| name == node);
        let busy = has(&self.publishers)
            || has(&self.subscribers)
            || self.services.values().any(|(name, _)| name == node)
            || self.params.follows(node) > 0
            || self.kept.contains(node);
        if !busy {
            self.nodes.remove(node);
        }
    }

    fn tell_subscribers(&self, topic: &str, notices: &mut Vec<Notice>) {
        let publishers = addresses(&self.publishers, topic);
        let tell = |to: String| Notice::Publishers {
            to,
            topic: topic.to_owned(),
            publishers: publishers.clone(),
        };
        notices.extend(addresses(&self.subscribers, topic).into_iter().map(tell));
    }

    /// A publisher's type goes before a subscriber's; `*` is any.
    fn set_type(&mut self, topic: &str, kind: &str, publishes: bool) {
        let (known, any) = (self.types.contains_key(topic), kind == "*");
        let sets = if publishes { !known || !any } else { !known && !any };
        if !sets {
            return;
        }
        if !known && self.types.len() >= TYPES {
            let (publishers, subscribers) = (&self.publishers, &self.subscribers);
            self.types.retain(|t, _| publishers.contains_key(t) || subscribers.contains_key(t));
        }
        self.types.insert(topic.to_owned(), kind.to_owned());
    }

    fn register_publisher(&mut self, said: &Said<'_>, notices: &mut Vec<Notice>) -> Outcome {
        let (topic, kind, api) = (said.name(1)?, said.text(2)?, said.address(3)?);
        self.admit(said, api, notices)?;
        add(&mut self.publishers, &topic, said.caller, api);
        self.set_type(&topic, kind, true);
        self.tell_subscribers(&topic, notices);
        let message = format!("Registered [{}] as publisher of [{topic}]", said.caller);
        Ok((message, texts(addresses(&self.subscribers, &topic))))
    }

    fn unregister_publisher(&mut self, said: &Said<'_>, notices: &mut Vec<Notice>) -> Outcome {
        let (topic, api) = (said.name(1)?, said.address(2)?);
        let mine = |one: &(String, String)| one.0 == said.caller && one.1 == api;
        let taken = take(&mut self.publishers, &topic, mine);
        if taken {
            self.tell_subscribers(&topic, notices);
            self.forget_idle(said.caller);
        }
        Ok(unregistered(said.caller, &topic, taken))
    }

    fn register_subscriber(&mut self, said: &Said<'_>, notices: &mut Vec<Notice>) -> Outcome {
        let (topic, kind, api) = (said.name(1)?, said.text(2)?, said.address(3)?);
        self.admit(said, api, notices)?;
        add(&mut self.subscribers, &topic, said.caller, api);
        self.set_type(&topic, kind, false);
        Ok((format!("Subscribed to [{topic}]"), texts(addresses(&self.publishers, &topic))))
    }

    fn unregister_subscriber(&mut self, said: &Said<'_>) -> Outcome {
        let (topic, api) = (said.name(1)?, said.address(2)?);
        let mine = |one: &(String, String)| one.0 == said.caller && one.1 == api;
        let taken = take(&mut self.subscribers, &topic, mine);
        if taken {
            self.forget_idle(said.caller);
        }
        Ok(unregistered(said.caller, &topic, taken))
    }

    fn register_service(&mut self, said: &Said<'_>, notices: &mut Vec<Notice>) -> Outcome {
        let (service, at, api) = (said.name(1)?, said.address(2)?, said.address(3)?);
        let kept = |(node, _): &(String, String)| node != said.caller && self.kept.contains(node);
        if self.services.get(&service).is_some_and(kept) {
            return Err(format!("{service} is not another's to serve"));
        }
        self.admit(said, api, notices)?;
        let former = self.services.insert(service.clone(), (said.caller.to_owned(), at.to_owned()));
        if let Some((former, _)) = former.filter(|(former, _)| former != said.caller) {
            self.forget_idle(&former);
        }
        Ok((format!("Registered [{}] as provider of [{service}]", said.caller), 1.into()))
    }

    fn unregister_service(&mut self, said: &Said<'_>) -> Outcome {
        let (service, at) = (said.name(1)?, said.address(2)?);
        let mine = |(node, there): &(String, String)| node == said.caller && there == at;
        let taken = self.services.get(&service).is_some_and(mine);
        if taken {
            self.services.remove(&service);
            self.forget_idle(said.caller);
        }
        Ok(unregistered(said.caller, &service, taken))
    }

    fn lookup_node(&self, said: &Said<'_>) -> Outcome {
        let node = said.name(1)?;
        let api = self.nodes.get(&node).ok_or_else(|| format!("unknown node [{node}]"))?;
        Ok(("node api".to_owned(), (&**api).into()))
    }

    fn lookup_service(&self, said: &Said<'_>) -> Outcome {
        let service = self.services.get(&said.name(1)?);
        let (_, at) = service.ok_or_else(|| "no provider".to_owned())?;
        Ok((format!("rosrpc URI: [{at}]"), (&**at).into()))
    }

    fn published_topics(&self, said: &Said<'_>) -> Outcome {
        let under = match said.text(1)? {
            "" => String::new(),
            _ => format!("{}/", said.name(1)?.trim_end_matches('/')),
        };
        let of = |topic: &&String| topic.starts_with(&under);
        let kind = |topic: &String| self.types.get(topic).map_or("*", String::as_str);
        let topics = self.publishers.keys().filter(of).map(|topic| pair(topic, kind(topic)));
        Ok(("current topics".to_owned(), topics.collect::<Vec<_>>().into()))
    }

    fn system_state(&self) -> Value {
        let row = |name: &str, nodes: Vec<String>| Value::Array(vec![name.into(), texts(nodes)]);
        let of = |nodes: &Nodes| -> Value {
            let names =
                |nodes: &Vec<(String, String)>| nodes.iter().map(|(n, _)| n.clone()).collect();
            nodes.iter().map(|(topic, nodes)| row(topic, names(nodes))).collect::<Vec<_>>().into()
        };
        let services = self.services.iter().map(|(name, (node, _))| row(name, vec![node.clone()]));
        let services = services.collect::<Vec<_>>().into();
        Value::Array(vec![of(&self.publishers), of(&self.subscribers), services])
    }

    fn set_param(&mut self, said: &Said<'_>, notices: &mut Vec<Notice>) -> Outcome {
        let (key, value) = (said.key(1)?, said.value(2)?);
        self.params.set(&key, value).map_err(|error: ParamError| error.to_string())?;
        notices.extend(self.params.changes(&key, said.caller).into_iter().map(notice));
        Ok((format!("parameter {} set", path(&key)), 0.into()))
    }

    fn delete_param(&mut self, said: &Said<'_>, notices: &mut Vec<Notice>) -> Outcome {
        let key = said.key(1)?;
        if !self.params.delete(&key) {
            return Err(format!("parameter [{}] is not set", path(&key)));
        }
        notices.extend(self.params.changes(&key, "").into_iter().map(notice));
        Ok((format!("parameter {} deleted", path(&key)), 0.into()))
    }

    fn search_param(&self, said: &Said<'_>) -> Outcome {
        let name = said.text(1)?;
        let key = parts(name);
        let found = match name.starts_with('/') {
            true => Some(key).filter(|key| self.params.has(key)),
            false => self.params.search(&parts(said.caller), &key),
        };
        let found =
            found.ok_or_else(|| format!("Cannot find parameter [{name}] in an upwards search"))?;
        Ok((format!("Found [{}]", path(&found)), path(&found).into()))
    }

    fn subscribe_param(&mut self, said: &Said<'_>, notices: &mut Vec<Notice>) -> Outcome {
        let (api, key) = (said.address(1)?, said.key(2)?);
        self.admit(said, api, notices)?;
        if self.params.follows(said.caller) >= MOST {
            return Err("too many parameters are followed".to_owned());
        }
        self.params.follow(&key, said.caller, api);
        let value = self.params.get(&key).unwrap_or(Value::Struct(Vec::new()));
        Ok((format!("Subscribed to parameter [{}]", path(&key)), value))
    }
}

/// Every method, and how many parameters it has with the caller's name.
const METHODS: [(&str, usize); 22] = [
    ("registerPublisher", 4),
    ("unregisterPublisher", 3),
    ("registerSubscriber", 4),
    ("unregisterSubscriber", 3),
    ("registerService", 4),
    ("unregisterService", 3),
    ("lookupNode", 2),
    ("lookupService", 2),
    ("getPublishedTopics", 2),
    ("getTopicTypes", 1),
    ("getSystemState", 1),
    ("getUri", 1),
    ("getPid", 1),
    ("shutdown", 2),
    ("setParam", 3),
    ("deleteParam", 2),
    ("getParam", 2),
    ("hasParam", 2),
    ("searchParam", 2),
    ("subscribeParam", 3),
    ("unsubscribeParam", 3),
    ("getParamNames", 1),
];

fn pair(a: &str, b: &str) -> Value {
    Value::Array(vec![a.into(), b.into()])
}

fn texts(all: Vec<String>) -> Value {
    all.into_iter().map(Value::from).collect::<Vec<_>>().into()
}

fn addresses(nodes: &Nodes, topic: &str) -> Vec<String> {
    nodes.get(topic).into_iter().flatten().map(|(_, api)| api.clone()).collect()
}

fn add(nodes: &mut Nodes, topic: &str, node: &str, api: &str) {
    let one = (node.to_owned(), api.to_owned());
    let all = nodes.entry(topic.to_owned()).or_default();
    if !all.contains(&one) {
        all.push(one);
    }
}

fn take(nodes: &mut Nodes, topic: &str, which: impl Fn(&(String, String)) -> bool) -> bool {
    let Some(all) = nodes.get_mut(topic) else { return false };
    let before = all.len();
    all.retain(|one| !which(one));
    let taken = all.len() < before;
    if all.is_empty() {
        nodes.remove(topic);
    }
    taken
}

fn unregistered(caller: &str, what: &str, taken: bool) -> (String, Value) {
    let message = match taken {
        true => format!("Unregistered [{caller}] as provider of [{what}]"),
        false => format!("[{caller}] is not a known provider of [{what}]"),
    };
    (message, i32::from(taken).into())
}

fn notice(change: Change) -> Notice {
    let Change { to, key, value } = change;
    let path = path(&key);
    Notice::Param { to, key: format!("{}/", path.trim_end_matches('/')), value }
}

#[cfg(test)]
mod tests;
