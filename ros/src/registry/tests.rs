use proptest::prelude::*;

use super::*;
use crate::xmlrpc::{self, write_call};

const URI: &str = "http://127.0.0.1:11311/";

fn call(
    registry: &mut Registry,
    method: &str,
    params: &[Value],
) -> (Result<Value, String>, Vec<Notice>) {
    let Response { answer, notices } =
        registry.handle(&Call { method: method.to_owned(), params: params.to_vec() });
    let answer = answer.expect("it is a method");
    let [status, message, value] = answer.as_array().unwrap() else { panic!("{answer:?}") };
    let said = match status.as_int() {
        Some(1) => Ok(value.clone()),
        _ => Err(message.as_str().unwrap().to_owned()),
    };
    (said, notices)
}

fn ask(
    registry: &mut Registry,
    method: &str,
    params: &[&str],
) -> (Result<Value, String>, Vec<Notice>) {
    let params: Vec<Value> = params.iter().map(|text| (*text).into()).collect();
    call(registry, method, &params)
}

fn publishers(to: &str, topic: &str, publishers: &[&str]) -> Notice {
    let publishers = publishers.iter().map(|api| (*api).to_owned()).collect();
    Notice::Publishers { to: to.to_owned(), topic: topic.to_owned(), publishers }
}

fn list(texts: &[&str]) -> Value {
    Value::Array(texts.iter().map(|text| (*text).into()).collect())
}

#[test]
fn subscribers_hear_of_publishers() {
    let mut master = Registry::new(URI, 1);
    let (said, notices) =
        ask(&mut master, "registerSubscriber", &["/r/s", "scan", "*", "http://s:1/"]);
    assert_eq!((said, notices), (Ok(list(&[])), vec![]));
    let registered = ["/r/p", "scan", "sensor_msgs/LaserScan", "http://p:1/"];
    let (said, notices) = ask(&mut master, "registerPublisher", &registered);
    assert_eq!(said, Ok(list(&["http://s:1/"])));
    assert_eq!(notices, [publishers("http://s:1/", "/r/scan", &["http://p:1/"])]);
    let topics = Ok(Value::Array(vec![list(&["/r/scan", "sensor_msgs/LaserScan"])]));
    assert_eq!(ask(&mut master, "getPublishedTopics", &["/x", "/r"]).0, topics);
    assert_eq!(ask(&mut master, "getPublishedTopics", &["/x", "/other"]).0, Ok(list(&[])));
    assert_eq!(ask(&mut master, "getTopicTypes", &["/x"]).0, topics);
    assert_eq!(ask(&mut master, "lookupNode", &["/x", "/r/p"]).0, Ok("http://p:1/".into()));
    let wrong = ask(&mut master, "unregisterPublisher", &["/r/p", "scan", "http://other:1/"]);
    assert_eq!(wrong, (Ok(0.into()), vec![]));
    let (said, notices) = ask(&mut master, "unregisterPublisher", &["/r/p", "scan", "http://p:1/"]);
    assert_eq!(said, Ok(1.into()));
    assert_eq!(notices, [publishers("http://s:1/", "/r/scan", &[])]);
    assert!(ask(&mut master, "lookupNode", &["/x", "/r/p"]).0.is_err(), "it has nothing left");
}

#[test]
fn a_name_is_the_newest_nodes() {
    let mut master = Registry::new(URI, 1);
    let register = |master: &mut Registry, api| {
        ask(master, "registerPublisher", &["/p", "/a", "std_msgs/String", api]).1
    };
    register(&mut master, "http://p:1/");
    ask(&mut master, "registerService", &["/p", "/p/do", "rosrpc://p:5", "http://p:1/"]).0.unwrap();
    ask(&mut master, "registerSubscriber", &["/s", "/a", "*", "http://s:1/"]).0.unwrap();
    let why = "[/p] Reason: new node registered with same name".to_owned();
    let notices = register(&mut master, "http://p:2/");
    let ended = Notice::Shutdown { to: "http://p:1/".to_owned(), why };
    let told = |api: &[&str]| publishers("http://s:1/", "/a", api);
    assert_eq!(notices, [ended, told(&[]), told(&["http://p:2/"])]);
    assert_eq!(
        ask(&mut master, "lookupService", &["/s", "/p/do"]).0,
        Err("no provider".to_owned())
    );
}

#[test]
fn what_is_kept_is_nobody_elses() {
    let mut master = Registry::new(URI, 1);
    master.keep("/muster", "http://m:1/");
    let registered = ["/muster", "/cmd_vel", "*", "http://m:1/"];
    ask(&mut master, "registerSubscriber", &registered).0.unwrap();
    ask(&mut master, "registerService", &["/muster", "/go", "rosrpc://m:2", "http://m:1/"])
        .0
        .unwrap();
    let taken = ["/muster", "/cmd_vel", "*", "http://evil:1/"];
    for method in ["registerSubscriber", "registerPublisher"] {
        let (said, notices) = ask(&mut master, method, &taken);
        assert_eq!(
            (said.unwrap_err().as_str(), notices),
            ("/muster is not another's name", vec![])
        );
    }
    let service = ["/evil", "/go", "rosrpc://evil:2", "http://evil:1/"];
    assert!(ask(&mut master, "registerService", &service).0.is_err());
    assert_eq!(ask(&mut master, "lookupNode", &["/x", "/muster"]).0, Ok("http://m:1/".into()));
    assert!(ask(&mut master, "shutdown", &["/x", "bye"]).0.is_err());
}

/// One that goes on where `master` ended.
fn next(master: &Registry) -> Registry {
    let Call { method, params } = master.recital();
    let recital = xmlrpc::call(&write_call(&method, &params)).unwrap();
    let mut next = Registry::new(URI, 2);
    next.handle(&recital).answer.unwrap();
    next
}

#[test]
fn the_next_master_knows_what_the_one_before_knew() {
    let mut master = Registry::new(URI, 1);
    master.keep("/muster", "http://m:1/");
    ask(&mut master, "registerPublisher", &["/muster", "/scan", "a/B", "http://m:1/"]).0.unwrap();
    ask(&mut master, "registerService", &["/n", "/n/do", "rosrpc://n:2", "http://n:1/"]).0.unwrap();
    ask(&mut master, "subscribeParam", &["/f", "http://f:1/", "/gains"]).0.unwrap();
    call(&mut master, "setParam", &["/n".into(), "/gains/p".into(), 2.into()]).0.unwrap();
    let mut next = next(&master);
    assert_eq!(next.services, master.services);
    assert_eq!(ask(&mut next, "getParam", &["/x", "/gains/p"]).0, Ok(2.into()));
    assert_eq!(call(&mut next, "setParam", &["/n".into(), "/gains/p".into(), 3.into()]).1.len(), 1);
    assert!(
        !next.nodes.contains_key("/muster") && next.publishers.is_empty(),
        "it comes by itself"
    );
}

#[test]
fn parameters_are_in_the_callers_namespace_and_followed() {
    let mut master = Registry::new(URI, 1);
    ask(&mut master, "subscribeParam", &["/r/n", "http://n:1/", "gains"]).0.unwrap();
    let (_, notices) = call(&mut master, "setParam", &["/r/m".into(), "gains/p".into(), 2.into()]);
    let key = "/r/gains/p/".to_owned();
    assert_eq!(notices, [Notice::Param { to: "http://n:1/".to_owned(), key, value: 2.into() }]);
    assert_eq!(ask(&mut master, "getParam", &["/x", "/r/gains/p"]).0, Ok(2.into()));
    call(&mut master, "setParam", &["/r/n".into(), "~own".into(), 3.into()]).0.unwrap();
    assert_eq!(ask(&mut master, "getParam", &["/x", "/r/n/own"]).0, Ok(3.into()));
    assert_eq!(ask(&mut master, "searchParam", &["/r/n", "gains"]).0, Ok("/r/gains".into()));
    assert_eq!(ask(&mut master, "hasParam", &["/r/n", "none"]).0, Ok(false.into()));
    assert!(ask(&mut master, "getParam", &["/r/n", "none"]).0.is_err());
}

#[test]
fn several_calls_come_as_one() {
    let mut master = Registry::new(URI, 1);
    let one = |method: &str, params: Vec<Value>| {
        let name = ("methodName".to_owned(), method.into());
        Value::Struct(vec![name, ("params".to_owned(), params.into())])
    };
    let calls = Value::Array(vec![
        one("setParam", vec!["/x".into(), "/a".into(), 1.into()]),
        one("nothing", vec![]),
        one("getParam", vec!["/x".into(), "/a".into()]),
    ]);
    let response =
        master.handle(&Call { method: "system.multicall".to_owned(), params: vec![calls] });
    let answers = response.answer.unwrap();
    let answers = answers.as_array().unwrap();
    assert!(matches!(&answers[1], Value::Struct(fault) if fault[0].0 == "faultCode"));
    let last = answers[2].as_array().unwrap()[0].as_array().unwrap();
    assert_eq!((last[0].as_int(), last[2].as_int()), (Some(1), Some(1)));
}

#[test]
fn registrations_are_bounded() {
    let mut master = Registry::new(URI, 1);
    let register = |master: &mut Registry, n: usize| {
        let topic = format!("/t{n}");
        ask(master, "registerSubscriber", &["/s", &topic, "*", "http://s:1/"]).0
    };
    let refused = (0..MOST + 10).filter(|n| register(&mut master, *n).is_err()).count();
    assert!((10..20).contains(&refused), "{refused}");
}

/// What a few nodes do with a few topics.
fn calls() -> impl Strategy<Value = Vec<(usize, usize, usize, usize)>> {
    prop::collection::vec((0..6usize, 0..4usize, 0..3usize, 0..2usize), 0..60)
}

proptest! {
    /// Whoever believes what he was told last, by an answer or a notice, knows who publishes.
    #[test]
    fn subscribers_know_who_publishes(calls in calls()) {
        let mut master = Registry::new(URI, 1);
        let mut believed: BTreeMap<(String, String), Vec<String>> = BTreeMap::new();
        for (what, node, topic, place) in calls {
            let (name, topic) = (format!("/n{node}"), format!("/t{topic}"));
            let api = format!("http://n{node}:{}/", place + 1);
            let (said, notices) = match what {
                0 | 1 => ask(&mut master, "registerPublisher", &[&name, &topic, "a/B", &api]),
                2 | 3 => ask(&mut master, "registerSubscriber", &[&name, &topic, "a/B", &api]),
                4 => ask(&mut master, "unregisterPublisher", &[&name, &topic, &api]),
                _ => ask(&mut master, "unregisterSubscriber", &[&name, &topic, &api]),
            };
            let said = said.unwrap();
            for notice in notices {
                if let Notice::Publishers { to, topic, publishers } = notice {
                    believed.insert((to, topic), publishers);
                }
            }
            if matches!(what, 2 | 3) {
                believed.insert((api, topic), said.strings());
            }
            for (topic, subscribers) in &master.subscribers {
                for (name, api) in subscribers {
                    prop_assert_eq!(&master.nodes[name], api, "a node is in one place");
                    let knows = &believed[&(api.clone(), topic.clone())];
                    prop_assert_eq!(knows, &addresses(&master.publishers, topic));
                }
            }
            let has = |nodes: &Nodes, name: &String| nodes.values().flatten().any(|(n, _)| n == name);
            for name in master.nodes.keys() {
                prop_assert!(has(&master.publishers, name) || has(&master.subscribers, name));
            }
        }
        let next = next(&master);
        prop_assert_eq!(&next.publishers, &master.publishers);
        prop_assert_eq!(&next.subscribers, &master.subscribers);
        prop_assert_eq!(&next.nodes, &master.nodes);
    }

    /// Whatever is said, it is answered.
    #[test]
    fn anything_is_answered(
        method in 0..METHODS.len(),
        params in prop::collection::vec(prop_oneof![
            "[/~a-c]{0,6}".prop_map(Value::from),
            any::<i32>().prop_map(Value::from),
            Just(Value::from("http://a:1/")),
            Just(Value::Struct(vec![("a".to_owned(), Value::Struct(vec![]))])),
        ], 0..5),
    ) {
        let mut master = Registry::new(URI, 1);
        let call = Call { method: METHODS[method].0.to_owned(), params };
        let answer = master.handle(&call).answer;
        prop_assert_eq!(answer.unwrap().as_array().map(<[Value]>::len), Some(3));
    }
}
