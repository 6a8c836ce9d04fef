//! Certificates, join tokens, and who may do what.

use muster_api::wire::agent::v1::TaskPhase::{Failed, Running};
use muster_controller::app;
use muster_controller::config::Config;
use rcgen::{CertificateParams, KeyPair};
use serde_json::{Value, json};

use super::agent;
use super::support::*;

fn request() -> (String, KeyPair) {
    let key = KeyPair::generate().unwrap();
    let csr = CertificateParams::default().serialize_request(&key).unwrap().pem().unwrap();
    (csr, key)
}

fn join(token: &str, node: &str, csr: &str) -> Value {
    json!({"token": token, "nodeName": node, "kind": "Robot", "csr": csr})
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn anonymous_sees_health_and_nothing_else() {
    let cluster = Cluster::start().await;
    let anonymous = cluster.anonymous().await;
    for open in ["/healthz", "/livez", "/readyz", "/version"] {
        assert_eq!(get(&anonymous, open).await.0, 200, "{open}");
    }
    for closed in ["/metrics", "/api", TASKS, "/apis/muster.dev/v1alpha1/jointokens"] {
        assert_eq!(refusal(&get(&anonymous, closed).await), (401, "Unauthorized"), "{closed}");
    }
    let (code, metrics) = get(&cluster.admin().await, "/metrics").await;
    assert_eq!(code, 200);
    assert!(metrics.as_str().unwrap().contains("muster_http_requests_total"), "{metrics}");
    cluster.running.shut_down().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn an_agent_joins_with_a_token_and_speaks_for_its_node_only() {
    let cluster = Cluster::start().await;
    let (admin, anonymous) = (cluster.admin().await, cluster.anonymous().await);
    let tokens = format!("{G}/jointokens");
    let spec = json!({"spec": {"ttlSeconds": 60, "nodeName": "turtlebot-1", "uses": 1}});
    let (code, made) = send(&admin, "POST", &tokens, spec).await;
    assert_eq!(code, 201, "{made}");
    let token = made["status"]["token"].as_str().unwrap();
    assert!(token.starts_with("muster1."));
    let (_, list) = get(&admin, &tokens).await;
    assert_eq!(list["items"].as_array().unwrap().len(), 1);
    let secret = token.split('.').nth(2).unwrap();
    assert!(!list.to_string().contains(secret), "a secret is shown once");

    let path = format!("{G}/join");
    let (csr, key) = request();
    let other = send(&anonymous, "POST", &path, join(token, "turtlebot-2", &csr)).await;
    assert_eq!(refusal(&other), (401, "Unauthorized"));
    let bad = send(&anonymous, "POST", &path, join(token, "turtlebot-1", "nonsense")).await;
    assert_eq!(refusal(&bad), (400, "BadRequest"));
    let (code, joined) = send(&anonymous, "POST", &path, join(token, "turtlebot-1", &csr)).await;
    assert_eq!(code, 200, "{joined}");
    let another = send(&anonymous, "POST", &path, join(token, "turtlebot-1", &request().0)).await;
    assert!(another.1["message"].as_str().unwrap().contains("used up"), "{another:?}");
    // An agent that did not hear that it has joined asks again with its key: that is no second use.
    let again = send(&anonymous, "POST", &path, join(token, "turtlebot-1", &csr)).await;
    assert_eq!(again.0, 200, "{again:?}");

    let certificate = joined["certificate"].as_str().unwrap();
    let agent = cluster.holder(certificate, &key.serialize_pem()).await;
    let (code, node) = get(&agent, &format!("{G}/nodes/turtlebot-1")).await;
    assert_eq!((code, &node["spec"]["kind"]), (200, &"Robot".into()));
    for closed in [format!("{G}/nodes/other"), format!("{G}/nodes"), TASKS.to_owned()] {
        assert_eq!(refusal(&get(&agent, &closed).await), (403, "Forbidden"), "{closed}");
    }
    // A certificate is renewed by the one before it.
    let renew = json!({"nodeName": "turtlebot-1", "kind": "Robot", "csr": csr});
    assert_eq!(send(&agent, "POST", &path, renew).await.0, 200);
    let steal = json!({"nodeName": "other", "kind": "Robot", "csr": csr});
    assert_eq!(refusal(&send(&agent, "POST", &path, steal).await), (401, "Unauthorized"));
    let cloud = json!({"nodeName": "turtlebot-1", "kind": "Cloud", "csr": csr});
    assert_eq!(refusal(&send(&agent, "POST", &path, cloud).await), (409, "Conflict"));
    cluster.running.shut_down().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_certificate_is_renewed_until_another_agent_is_in_its_place() {
    let cluster = Cluster::start().await;
    let (admin, anonymous) = (cluster.admin().await, cluster.anonymous().await);
    let path = format!("{G}/join");
    let token = async || {
        let spec = json!({"spec": {"nodeName": "r1", "uses": 1}});
        let (code, made) = send(&admin, "POST", &format!("{G}/jointokens"), spec).await;
        assert_eq!(code, 201, "{made}");
        made["status"]["token"].as_str().unwrap().to_owned()
    };
    let (csr, key) = request();
    let (_, joined) = send(&anonymous, "POST", &path, join(&token().await, "r1", &csr)).await;
    let certificate = joined["certificate"].as_str().unwrap();
    let agent = cluster.holder(certificate, &key.serialize_pem()).await;

    // Of a renewal whose answer was lost, as often as it may be, the agent knows nothing.
    for _ in 0..3 {
        let renew = json!({"nodeName": "r1", "kind": "Robot", "csr": request().0});
        let (code, renewed) = send(&agent, "POST", &path, renew).await;
        assert_eq!(code, 200, "{renewed}");
        let (_, node) = get(&admin, &format!("{G}/nodes/r1")).await;
        let keys = node["status"]["agentKeys"].as_array().unwrap();
        assert_eq!(keys.len(), 2, "the new one, and the one that was shown: {keys:?}");
    }
    let (other, _) = request();
    let (code, _) = send(&anonymous, "POST", &path, join(&token().await, "r1", &other)).await;
    assert_eq!(code, 200, "a replacement");
    let renew = json!({"nodeName": "r1", "kind": "Robot", "csr": request().0});
    let refused = send(&agent, "POST", &path, renew).await;
    assert_eq!(refusal(&refused), (401, "Unauthorized"));
    assert!(refused.1["message"].as_str().unwrap().contains("any more"), "{}", refused.1);
    cluster.running.shut_down().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_token_that_does_not_hold_says_why() {
    let cluster = Cluster::start().await;
    let (admin, anonymous) = (cluster.admin().await, cluster.anonymous().await);
    let (_, made) = send(&admin, "POST", &format!("{G}/jointokens"), Value::Null).await;
    let good = made["status"]["token"].as_str().unwrap();
    let parts: Vec<&str> = good.split('.').collect();
    let id = made["metadata"]["name"].as_str().unwrap();
    let cases = [
        ("nonsense".to_owned(), "not a join token"),
        (format!("muster1.{}.{}.{}", parts[1], "0".repeat(64), parts[3]), "not known"),
        (format!("muster1.ffffffffff.{}.{}", parts[2], parts[3]), "not known"),
        (format!("muster1.{}.{}.{}", parts[1], parts[2], "0".repeat(64)), "another controller"),
    ];
    let (csr, _) = request();
    let path = format!("{G}/join");
    for (token, why) in cases {
        let answer = send(&anonymous, "POST", &path, join(&token, "n", &csr)).await;
        assert_eq!(refusal(&answer), (401, "Unauthorized"));
        assert!(answer.1["message"].as_str().unwrap().contains(why), "{answer:?}");
    }
    assert_eq!(send(&admin, "DELETE", &format!("{G}/jointokens/{id}"), Value::Null).await.0, 200);
    let answer = send(&anonymous, "POST", &path, join(good, "n", &csr)).await;
    assert!(answer.1["message"].as_str().unwrap().contains("not known"), "{answer:?}");
    cluster.running.shut_down().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_second_controller_on_the_same_directory_is_refused() {
    let cluster = Cluster::start().await;
    let config = Config {
        data_dir: cluster.dir.path().join("data"),
        listen: "127.0.0.1:0".parse().unwrap(),
        kubeconfig: cluster.dir.path().join("other"),
        kubeconfig_asked: true,
        advertise: Vec::new(),
        encryption_key: None,
        certificate_ttl: muster_controller::pki::TTL,
        requests_per_second: muster_controller::config::REQUESTS_PER_SECOND,
    };
    let refused = app::start(config).await.unwrap_err();
    assert!(matches!(refused, app::AppError::Locked { .. }), "{refused}");
    cluster.running.shut_down().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn an_agent_tells_of_its_own_tasks_and_of_no_other_node() {
    let cluster = Cluster::start().await;
    let admin = cluster.admin().await;
    let mut drives = task("patrol");
    drives["spec"]["placement"] = json!({"node": "r1"});
    let own = agent::join(&cluster, "r1").await;
    let mut first = agent::Session::open(&cluster, &own, Vec::new()).await.unwrap();
    let (_, made) = send(&admin, "POST", TASKS, drives).await;
    let uid = made["metadata"]["uid"].as_str().unwrap();
    first.assigned(uid).await;
    first.say(agent::report(uid, 2, Running)).await;
    let path = format!("{TASKS}/patrol");
    cluster.until(&path, |task| task["status"]["phase"] == "Running").await;

    // Another node's agent says that it has ended, in its Hello and after it.
    let other = agent::join(&cluster, "r2").await;
    let lie = agent::report(uid, 9, Failed);
    let mut second = agent::Session::open(&cluster, &other, vec![lie.clone()]).await.unwrap();
    second.assignments().await.unwrap();
    second.say(lie).await;
    // What it says next is taken in, and so the lie was.
    let (_, made) = send(&admin, "POST", TASKS, {
        let mut task = task("own");
        task["spec"]["placement"] = json!({"node": "r2"});
        task
    })
    .await;
    let its = made["metadata"]["uid"].as_str().unwrap();
    second.assigned(its).await;
    second.say(agent::report(its, 2, Running)).await;
    cluster.until(&format!("{TASKS}/own"), |task| task["status"]["phase"] == "Running").await;
    assert_eq!(get(&admin, &path).await.1["status"]["phase"], "Running");

    // Nor does it speak for the other node.
    let mut thief = agent::join(&cluster, "r3").await;
    thief.node = "r1".to_owned();
    let refused = match agent::Session::open(&cluster, &thief, Vec::new()).await {
        Err(refused) => refused,
        Ok(mut session) => session.assignments().await.unwrap_err(),
    };
    let codes = [tonic::Code::PermissionDenied, tonic::Code::InvalidArgument];
    assert!(codes.contains(&refused.code()), "{refused}");
    cluster.running.shut_down().await.unwrap();
}
