//! The session of a framework as JSON lines over plain HTTP, as curl would have it.

use std::collections::BTreeSet;
use std::pin::Pin;

use futures::io::{AsyncBufRead, Lines};
use futures::{AsyncBufReadExt as _, StreamExt as _};
use http::Request;
use kube::Api;
use muster_api::kind::framework::Framework;
use muster_api::kind::task::Task;
use muster_api::phase::TaskPhase;
use muster_tests::{AgentOptions, Cluster, wait};
use serde_json::{Value, json};

/// An open session.
pub(super) struct Session<'a> {
    cluster: &'a Cluster,
    id: String,
    framework: String,
    events: Lines<Pin<Box<dyn AsyncBufRead + Send>>>,
}

/// POSTs a Subscribe; its first event, and the rest of them.
async fn subscribe(
    cluster: &Cluster,
    subscribe: Value,
) -> (Value, Lines<Pin<Box<dyn AsyncBufRead + Send>>>) {
    let body = format!("{}\n", json!({"subscribe": subscribe})).into_bytes();
    let request = Request::post("/framework/v1/session").body(body).expect("a request");
    let stream = cluster.client().await.request_stream(request).await.expect("it is taken");
    let stream: Pin<Box<dyn AsyncBufRead + Send>> = Box::pin(stream);
    let mut events = stream.lines();
    (next(&mut events).await, events)
}

async fn next(events: &mut Lines<Pin<Box<dyn AsyncBufRead + Send>>>) -> Value {
    let line = tokio::time::timeout(wait::DEADLINE, events.next()).await.expect("an event in time");
    let line = line.expect("the session goes on").expect("a line");
    serde_json::from_str(&line).expect("JSON")
}

impl<'a> Session<'a> {
    pub(super) async fn open(cluster: &'a Cluster, wish: Value) -> Self {
        let (first, events) = subscribe(cluster, wish).await;
        let text = |field: &str| first["subscribed"][field].as_str().unwrap_or_default().to_owned();
        let (id, framework) = (text("sessionId"), text("frameworkId"));
        assert!(!id.is_empty() && !framework.is_empty(), "{first}");
        Session { cluster, id, framework, events }
    }

    /// POSTs one call.
    pub(super) async fn say(&self, call: Value) {
        let path = format!("/framework/v1/session/{}/calls", self.id);
        let request = Request::post(path).body(format!("{call}\n").into_bytes());
        let client = self.cluster.client().await;
        client.request_text(request.expect("a request")).await.expect("202");
    }

    /// The next event with this in it.
    async fn hear(&mut self, kind: &str) -> Value {
        loop {
            let mut event = next(&mut self.events).await;
            if event.get(kind).is_some() {
                return event[kind].take();
            }
        }
    }

    /// The next offer of a node.
    pub(super) async fn offer_of(&mut self, node: &str) -> String {
        loop {
            let heard = self.hear("offers").await;
            let mut offers = heard["offers"].as_array().into_iter().flatten();
            let id = offers.find(|o| o["node"] == node).and_then(|offer| offer["id"].as_str());
            if let Some(id) = id {
                return id.to_owned();
            }
        }
    }

    /// The reason of the refusal that comes next.
    async fn refusal(&mut self) -> String {
        let answer = self.hear("answer").await;
        answer["refusal"]["reason"].as_str().unwrap_or_else(|| panic!("{answer}")).to_owned()
    }

    /// The one offer that is out.
    async fn offer(&mut self) -> String {
        let offers = self.hear("offers").await;
        let offer = &offers["offers"][0];
        assert_eq!(offer["node"], "turtle", "{offers}");
        offer["id"].as_str().expect("an id").to_owned()
    }
}

fn accept(offer: &str, name: &str, spec: &Value) -> Value {
    json!({"accept": {"offers": [offer], "launches": [{"name": name, "spec": spec}]}})
}

fn spec(cpu: &str) -> Value {
    json!({"resources": {"cpu": cpu}, "run": {"process": {"command": ["true"]}}})
}

/// Without Docker, which a node may find after it is ready: then what it offers is offered anew.
fn small(name: &str, x: f64) -> AgentOptions {
    AgentOptions::robot(name, x, 0.0).flag("--cpu", "1").flag("--docker-socket", "none")
}

async fn one_robot() -> Cluster {
    let mut cluster = Cluster::start().await;
    cluster.join(small("turtle", 0.0)).await;
    cluster
}

#[tokio::test(flavor = "multi_thread")]
async fn subscribe_offers_accept_update_acknowledge_in_lines() {
    let cluster = one_robot().await;
    let mut session = Session::open(&cluster, json!({"name": "watcher"})).await;
    let offer = session.offer().await;

    // Without an id, a refusal is answered all the same, with its own reason.
    session.say(accept("3", "stray", &spec("100m"))).await;
    assert_eq!(session.refusal().await, "REFUSAL_REASON_OFFER_GONE");
    session.say(accept(&offer, "large", &spec("5"))).await;
    assert_eq!(session.refusal().await, "REFUSAL_REASON_EXCEEDS_OFFER");
    let mut lonely = spec("100m");
    lonely["dependsOn"] = json!([{"task": "nobody"}]);
    session.say(accept(&offer, "lonely", &lonely)).await;
    assert_eq!(session.refusal().await, "REFUSAL_REASON_UNAVAILABLE");
    session.say(accept(&offer, "Bad Name", &spec("100m"))).await;
    assert_eq!(session.refusal().await, "REFUSAL_REASON_INVALID");

    let mut call = accept(&offer, "hello", &spec("100m"));
    call["id"] = "a-1".into();
    session.say(call).await;
    let answer = session.hear("answer").await;
    assert_eq!(answer["id"], "a-1");
    let launched = &answer["launched"][0];
    assert_eq!((&launched["name"], &launched["node"]), (&json!("hello"), &json!("turtle")));
    let update = loop {
        let update = session.hear("update").await;
        assert_eq!(update["task"], launched["task"]);
        if update["state"] == "TASK_STATE_SUCCEEDED" {
            break update;
        }
    };
    let task = cluster.phase("hello", TaskPhase::Succeeded).await;
    assert!(task.metadata.finalizers.is_some_and(|f| !f.is_empty()), "it waits to be acknowledged");
    session
        .say(json!({"acknowledge": {"task": update["task"], "version": update["version"]}}))
        .await;
    let is_free = |task: Option<&Task>| {
        task.is_some_and(|task| task.metadata.finalizers.as_ref().is_none_or(Vec::is_empty))
    };
    wait::object(cluster.tasks().await, "hello", "acknowledged", is_free).await;

    // What the namespace's quota does not leave.
    let quota = json!({
        "apiVersion": "muster.dev/v1alpha1", "kind": "Quota", "metadata": {"name": "default"},
        "spec": {"hard": {"cpu": "50m"}},
    });
    cluster.post("/apis/muster.dev/v1alpha1/namespaces/default/quotas", &quota).await;
    session.say(accept(&offer, "over", &spec("100m"))).await;
    assert_eq!(session.refusal().await, "REFUSAL_REASON_QUOTA");

    session.say(json!({"id": "end", "teardown": {}})).await;
    assert_eq!(session.hear("answer").await["id"], "end");
}

/// What people ask of a live controller: who is offered what, and why the rest is not.
#[tokio::test(flavor = "multi_thread")]
async fn a_live_controller_says_what_is_offered_and_why_the_rest_is_not() {
    const OFFERS: &str = "/apis/muster.dev/v1alpha1/offers";
    let why =
        |name: &str| format!("/apis/muster.dev/v1alpha1/namespaces/default/frameworks/{name}/why");
    let mut cluster = one_robot().await;
    cluster.join(small("tortoise", 9.0)).await;
    let near = json!({"name": "near", "position": {"x": 3.0, "y": 0.0, "radius": 5.0}});
    let mut near = Session::open(&cluster, near).await;
    let offer = near.offer().await;
    let mut big = Session::open(
        &cluster,
        json!({"name": "big", "filter": {"minimum": {"cpuMillis": "5000"}}}),
    )
    .await;
    big.say(json!({"id": "heard", "revive": {}})).await;
    assert_eq!(big.hear("answer").await["id"], "heard");

    let looked = cluster.get(OFFERS).await;
    let of = |name: &str| {
        let all = looked["frameworks"].as_array().into_iter().flatten();
        all.clone().find(|f| f["name"] == name).unwrap_or_else(|| panic!("{looked}")).clone()
    };
    let shown = of("near");
    assert_eq!((&shown["connected"], &shown["suppressed"]), (&json!(true), &json!(false)));
    assert_eq!(shown["uid"], near.framework);
    let offers = shown["offers"].as_array().expect("offers");
    assert_eq!(offers.len(), 1, "{shown}");
    assert_eq!((&offers[0]["id"], &offers[0]["node"]), (&json!(offer), &json!("turtle")));
    assert_eq!((&offers[0]["score"], &offers[0]["actuators"]), (&json!(3.0), &json!(true)));
    assert_eq!(of("big")["offers"], json!([]));

    let said = cluster.get(&why("near")).await;
    assert_eq!(said["why"].as_array().map(Vec::len), Some(1), "{said}");
    assert_eq!(said["why"][0]["node"], "tortoise");
    assert_eq!(said["why"][0]["reason"], "OutOfRange");
    assert_eq!(said["framework"]["offers"][0]["node"], "turtle");
    let said = cluster.get(&why("big")).await;
    let reasons: Vec<&Value> =
        said["why"].as_array().into_iter().flatten().map(|why| &why["reason"]).collect();
    assert_eq!(reasons, ["Exhausted", "Exhausted"], "{said}");

    near.say(json!({"id": "quiet", "suppress": {}})).await;
    assert_eq!(near.hear("answer").await["id"], "quiet");
    let said = cluster.get(&why("near")).await;
    let all_suppressed = |why: &Value| why["reason"] == "Suppressed";
    let reasons = said["why"].as_array().expect("reasons");
    assert!(reasons.len() == 2 && reasons.iter().all(all_suppressed), "{said}");
}

/// A framework that is not sure asks, and hears what is so: of what it names, of everything, and of what is not there.
#[tokio::test(flavor = "multi_thread")]
async fn reconcile_says_the_present_state_of_tasks() {
    let cluster = one_robot().await;
    let mut session = Session::open(&cluster, json!({"name": "unsure"})).await;
    let mut uids = Vec::new();
    for name in ["one", "two"] {
        let offer = session.offer().await;
        let mut lasting = spec("100m");
        lasting["run"]["process"]["command"] = json!(["sleep", "1000"]);
        let mut call = accept(&offer, name, &lasting);
        call["id"] = name.into();
        session.say(call).await;
        let answer = session.hear("answer").await;
        uids.push(answer["launched"][0]["task"].as_str().expect("a uid").to_owned());
        cluster.phase(name, TaskPhase::Running).await;
    }
    // Everything up to here is acknowledged: nothing is said again by itself.
    let mut running = BTreeSet::new();
    while running.len() < uids.len() {
        let update = session.hear("update").await;
        let version = update["version"].clone();
        session.say(json!({"acknowledge": {"task": update["task"], "version": version}})).await;
        if update["state"] == "TASK_STATE_RUNNING" {
            running.insert(update["task"].to_string());
        }
    }

    session.say(json!({"id": "r-1", "reconcile": {"tasks": [uids[1], "nobody"]}})).await;
    let (known, unknown) = (session.hear("update").await, session.hear("update").await);
    assert_eq!((&known["task"], &known["state"]), (&json!(uids[1]), &json!("TASK_STATE_RUNNING")));
    assert_eq!(known["node"], "turtle");
    let gone = (&json!("nobody"), &json!("TASK_STATE_GONE"));
    assert_eq!((&unknown["task"], &unknown["state"]), gone);
    assert_eq!(session.hear("answer").await["id"], "r-1");

    session.say(json!({"reconcile": {}})).await;
    let mut all = Vec::new();
    for _ in 0..2 {
        let update = session.hear("update").await;
        assert_eq!(update["state"], "TASK_STATE_RUNNING");
        all.push(update["task"].as_str().expect("a uid").to_owned());
    }
    all.sort();
    uids.sort();
    assert_eq!(all, uids);
}

/// The controller had registered it, and the word of it was lost.
#[tokio::test(flavor = "multi_thread")]
async fn a_lost_subscribed_locks_nobody_out() {
    let cluster = one_robot().await;
    let wish = |nonce: &str| json!({"name": "unheard", "nonce": nonce});
    let lost = Session::open(&cluster, wish("run-1")).await;
    let (stranger, _) = subscribe(&cluster, wish("run-2")).await;
    assert_eq!(stranger["error"]["reason"], "AlreadyExists", "{stranger}");
    let mut again = Session::open(&cluster, wish("run-1")).await;
    assert_eq!(again.framework, lost.framework);
    again.offer().await;
    drop(lost);

    // The end of the first session is not the framework's.
    let frameworks: Api<Framework> = Api::namespaced(cluster.client().await, "default");
    let is_here = |framework: Option<&Framework>| {
        let status = framework.and_then(|framework| framework.status.as_ref());
        status.is_some_and(|status| status.connected && status.disconnected_at.is_none())
    };
    wait::object(frameworks, "unheard", "connected", is_here).await;

    let (greedy, _) =
        subscribe(&cluster, json!({"name": "greedy", "filter": {"most": 10_000}})).await;
    assert_eq!(greedy["error"]["reason"], "Invalid", "{greedy}");
    let message = greedy["error"]["message"].as_str().unwrap_or_default();
    assert!(message.contains("spec.filter.most") && message.contains("1000"), "{message}");
}
