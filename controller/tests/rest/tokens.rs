//! Tokens of users, and what of them is written where.

use serde_json::{Value, json};

use super::support::*;

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_token_lets_its_user_in_until_it_is_taken_back() {
    let cluster = Cluster::start().await;
    let admin = cluster.admin().await;
    let made = cluster.token("ada", 60).await;
    let token = made["status"]["token"].as_str().unwrap();
    let ada = cluster.bearer(token).await;
    let review = "/apis/authentication.k8s.io/v1/selfsubjectreviews";
    let (_, me) = send(&ada, "POST", review, Value::Null).await;
    assert_eq!(
        me["status"]["userInfo"],
        json!({"username": "ada", "groups": ["lab", "system:authenticated"]})
    );
    // No Access object names ada yet.
    assert_eq!(refusal(&get(&ada, TASKS).await), (403, "Forbidden"));
    let secret = token.split('.').nth(2).unwrap();
    let tokens = format!("{G}/usertokens");
    let (_, list) = get(&admin, &tokens).await;
    assert_eq!(list["items"][0]["spec"]["user"], "ada");
    assert!(!list.to_string().contains(secret), "a secret is shown once");
    let id = made["metadata"]["name"].as_str().unwrap();
    assert_eq!(send(&admin, "DELETE", &format!("{tokens}/{id}"), Value::Null).await.0, 200);
    let refused = get(&ada, TASKS).await;
    assert_eq!(refusal(&refused), (401, "Unauthorized"));
    assert!(refused.1["message"].as_str().unwrap().contains("taken back"), "{refused:?}");
    cluster.running.shut_down().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_user_who_asks_too_often_waits_and_nobody_else() {
    let cluster = Cluster::start_with(|config| config.requests_per_second = 1).await;
    let (ada, bob) = (cluster.user("ada").await, cluster.user("bob").await);
    let deadline = std::time::Instant::now() + DEADLINE;
    let refused = loop {
        let answer = get(&ada, "/apis").await;
        if answer.0 != 200 {
            break answer;
        }
        assert!(std::time::Instant::now() < deadline, "nobody asks so seldom");
    };
    assert_eq!(refusal(&refused), (429, "TooManyRequests"));
    let (message, details) = (refused.1["message"].as_str().unwrap(), &refused.1["details"]);
    assert!(message.contains("User \"ada\" asks too often"), "{message}");
    assert_eq!(details["retryAfterSeconds"], 1);
    assert_eq!(get(&bob, "/apis").await.0, 200);
    // An emergency stop is not asked how often: it is for the table of roles to say who may.
    let stop = json!({"spec": {"emergencyStop": {}}});
    for _ in 0..20 {
        let answer = send(&ada, "PATCH", &format!("{G}/nodes/r1"), stop.clone()).await;
        assert_eq!(refusal(&answer), (403, "Forbidden"));
    }
    let admin = cluster.admin().await;
    for _ in 0..20 {
        assert_eq!(get(&admin, "/apis").await.0, 200);
    }
    cluster.running.shut_down().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_token_that_does_not_hold_counts_before_a_certificate_that_does() {
    let cluster = Cluster::start().await;
    let admin = cluster.admin().await;
    for shown in ["Bearer musteru1.a.b", "Bearer nonsense", "Basic YTpi", "Bearer"] {
        let request = http::Request::get(TASKS)
            .header("authorization", shown)
            .body(kube::client::Body::empty())
            .unwrap();
        let response = admin.send(request).await.unwrap();
        assert_eq!(response.status(), 401, "{shown}");
    }
    // Health is told to anybody.
    let request = http::Request::get("/healthz").header("authorization", "Bearer x");
    let request = request.body(kube::client::Body::empty()).unwrap();
    assert_eq!(admin.send(request).await.unwrap().status(), 200);
    assert_eq!(get(&admin, TASKS).await.0, 200);
    cluster.running.shut_down().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn users_keep_no_place_among_strangers() {
    let cluster = Cluster::start().await;
    let made = cluster.token("ada", 60).await;
    let token = made["status"]["token"].as_str().unwrap();
    // More connections than strangers may have, each of them in use.
    let mut users = Vec::new();
    for _ in 0..300 {
        let user = cluster.bearer(token).await;
        assert_eq!(get(&user, "/version").await.0, 200);
        users.push(user);
    }
    assert_eq!(get(&cluster.anonymous().await, "/version").await.0, 200);
    cluster.running.shut_down().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn no_secret_of_a_token_is_in_any_file() {
    let cluster = Cluster::start().await;
    let made = cluster.token("ada", 60).await;
    let token = made["status"]["token"].as_str().unwrap().to_owned();
    let ada = cluster.bearer(&token).await;
    assert_eq!(send(&ada, "POST", TASKS, task("t")).await.0, 403);
    let secret = token.split('.').nth(2).unwrap().to_owned();
    let Cluster { running, dir } = cluster;
    running.shut_down().await.unwrap();
    let mut looked_at = 0;
    let mut places = vec![dir.path().to_owned()];
    while let Some(place) = places.pop() {
        for entry in std::fs::read_dir(place).unwrap() {
            let path = entry.unwrap().path();
            if path.is_dir() {
                places.push(path);
                continue;
            }
            // Temporary files come and go.
            let Ok(bytes) = std::fs::read(&path) else { continue };
            let found = bytes.windows(secret.len()).any(|window| window == secret.as_bytes());
            assert!(!found, "{}", path.display());
            looked_at += 1;
        }
    }
    assert!(looked_at > 5, "the store, keys, certificates, the audit log");
}
