//! The audit log: a line for each write, none for reads, nothing of what was written.

use std::path::{Path, PathBuf};

use serde_json::{Value, json};

use super::support::*;

fn file(cluster: &Cluster) -> PathBuf {
    cluster.dir.path().join("data/audit/audit.jsonl")
}

fn lines(cluster: &Cluster) -> Vec<Value> {
    lines_of(&file(cluster))
}

fn refused(cluster: &Cluster) -> Vec<Value> {
    lines_of(&file(cluster).with_file_name("refused.jsonl"))
}

fn lines_of(file: &Path) -> Vec<Value> {
    let text = std::fs::read_to_string(file).unwrap_or_default();
    text.lines().map(|line| serde_json::from_str(line).unwrap()).collect()
}

/// What of a line tells one from another.
fn brief(line: &Value) -> String {
    let text = |field: &str| line[field].as_str().unwrap_or("-").to_owned();
    let code = line["code"].as_u64().unwrap_or_default();
    format!(
        "{} {} {}/{} {}/{} {code} {}",
        text("user"),
        text("verb"),
        text("resource"),
        text("subresource"),
        text("namespace"),
        text("name"),
        text("reason")
    )
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn each_write_has_a_line_and_no_read_has_one() {
    let cluster = Cluster::start().await;
    let admin = cluster.admin().await;
    assert_eq!(lines(&cluster), [Value::Null; 0]);
    for read in [TASKS, "/version", &format!("{G}/nodes"), &format!("{G}/usage")] {
        get(&admin, read).await;
    }
    let plan = json!({"objects": [task("t")]});
    assert_eq!(send(&admin, "POST", &format!("{G}/plan"), plan).await.0, 200);
    assert_eq!(send(&admin, "POST", &format!("{TASKS}?dryRun=All"), task("t")).await.0, 201);
    assert_eq!(lines(&cluster), [Value::Null; 0], "nothing was changed");

    let mut secret = json!({"apiVersion": "v1", "kind": "Secret", "metadata": {"name": "s"}});
    secret["stringData"] = json!({"password": "never-to-be-read"});
    let secrets = "/api/v1/namespaces/default/secrets";
    let (_, made) = send(&admin, "POST", secrets, secret).await;
    assert_eq!(send(&admin, "POST", TASKS, task("t")).await.0, 201);
    assert_eq!(send(&admin, "POST", TASKS, task("t")).await.0, 409);
    let patch = json!({"metadata": {"labels": {"a": "b"}}});
    assert_eq!(send(&admin, "PATCH", &format!("{TASKS}/t"), patch).await.0, 200);
    assert_eq!(send(&admin, "DELETE", &format!("{TASKS}/t"), Value::Null).await.0, 200);
    assert_eq!(send(&admin, "DELETE", TASKS, Value::Null).await.0, 200);
    let made_token = cluster.token("ada", 60).await;
    let ada = cluster.bearer(made_token["status"]["token"].as_str().unwrap()).await;
    assert_eq!(send(&ada, "POST", TASKS, task("t")).await.0, 403);
    let revision = cluster.running.context().store.revision().to_string();
    let body = json!({"revision": revision, "requests": [{"create": task("together")}]});
    assert_eq!(send(&admin, "POST", &format!("{G}/transaction"), body).await.0, 200);
    // Who says nothing fills no file.
    assert_eq!(send(&cluster.anonymous().await, "POST", TASKS, task("t")).await.0, 401);

    let (lines, refused) = (lines(&cluster), refused(&cluster));
    assert_eq!(
        refused.iter().map(brief).collect::<Vec<_>>(),
        [
            "admin create tasks/- default/- 409 AlreadyExists",
            "ada create tasks/- default/- 403 Forbidden",
        ]
    );
    let token = made_token["metadata"]["name"].as_str().unwrap();
    assert_eq!(
        lines.iter().map(brief).collect::<Vec<_>>(),
        [
            "admin create secrets/- default/s 201 -".to_owned(),
            "admin create tasks/- default/t 201 -".to_owned(),
            "admin patch tasks/- default/t 200 -".to_owned(),
            "admin delete tasks/- default/t 200 -".to_owned(),
            "admin deletecollection tasks/- default/- 200 -".to_owned(),
            format!("admin create usertokens/- -/{token} 201 -"),
            "admin create transaction/- -/- 200 -".to_owned(),
        ]
    );
    assert_eq!(lines[0]["uid"], made["metadata"]["uid"]);
    assert_eq!((&lines[1]["uid"], &lines[2]["uid"]), (&lines[3]["uid"], &lines[3]["uid"]));
    assert_eq!((&refused[1]["token"], &refused[1]["groups"][0]), (&token.into(), &"lab".into()));
    assert_eq!(lines[5]["objects"], json!([{"kind": "User", "name": "ada"}]));
    assert_eq!(lines[6]["objects"][0]["name"], "together");
    assert!(lines[0]["from"].as_str().unwrap().starts_with("127.0.0.1:"));
    let text = std::fs::read_to_string(file(&cluster)).unwrap();
    for never in ["never-to-be-read", "/bin/true", "\"a\":\"b\""] {
        assert!(!text.contains(never), "{text}");
    }
    cluster.running.shut_down().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn what_knows_no_dry_run_is_a_write_whatever_its_query_says() {
    let cluster = Cluster::start().await;
    let admin = cluster.admin().await;
    let spec = json!({"spec": {"user": "ada"}});
    let path = format!("{G}/usertokens?dryRun=All");
    assert_eq!(send(&admin, "POST", &path, spec).await.0, 201);
    assert_eq!(lines(&cluster).len(), 1);
    cluster.running.shut_down().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn the_answer_has_the_id_of_its_line() {
    let cluster = Cluster::start().await;
    let body = kube::client::Body::from(task("t").to_string().into_bytes());
    let request = http::Request::post(TASKS).header("content-type", "application/json");
    let response = cluster.admin().await.send(request.body(body).unwrap()).await.unwrap();
    let id = response.headers()["audit-id"].to_str().unwrap().to_owned();
    assert_eq!(lines(&cluster)[0]["requestId"], id.as_str());
    cluster.running.shut_down().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn while_no_line_can_be_written_nothing_is() {
    let cluster = Cluster::start().await;
    let admin = cluster.admin().await;
    let (audit, aside) = (cluster.dir.path().join("data/audit"), cluster.dir.path().join("aside"));
    // A file in the directory's place.
    std::fs::rename(&audit, &aside).ok();
    std::fs::write(&audit, "").unwrap();
    let refused = send(&admin, "POST", TASKS, task("t")).await;
    assert_eq!(refusal(&refused), (503, "ServiceUnavailable"));
    assert_eq!(get(&admin, &format!("{TASKS}/t")).await.0, 404, "it was not carried out");
    assert_eq!(get(&admin, TASKS).await.0, 200, "reading goes on");
    std::fs::remove_file(&audit).unwrap();
    assert_eq!(send(&admin, "POST", TASKS, task("t")).await.0, 201);
    assert_eq!(lines(&cluster).len(), 1);
    cluster.running.shut_down().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn what_only_stops_or_takes_away_is_done_though_no_line_can_be_written() {
    let cluster = Cluster::start().await;
    let admin = cluster.admin().await;
    register(&admin, "r1").await;
    for name in ["t", "u"] {
        assert_eq!(send(&admin, "POST", TASKS, task(name)).await.0, 201);
    }
    let token = cluster.token("ada", 60).await;
    // So that the log is opened anew.
    let cluster = cluster.restart().await;
    let admin = cluster.admin().await;
    let (audit, aside) = (cluster.dir.path().join("data/audit"), cluster.dir.path().join("aside"));
    std::fs::rename(&audit, &aside).unwrap();
    std::fs::write(&audit, "").unwrap();
    assert_eq!(send(&admin, "POST", TASKS, task("v")).await.0, 503);

    let node = format!("{G}/nodes/r1");
    let stop = json!({"spec": {"estop": "Cut"}}).to_string().into_bytes();
    let request =
        http::Request::patch(&node).header("content-type", "application/merge-patch+json");
    let request = request.body(kube::client::Body::from(stop)).unwrap();
    let stopped = admin.send(request).await.unwrap();
    assert_eq!(stopped.status(), 200);
    let warning = stopped.headers()["warning"].to_str().unwrap().to_owned();
    assert!(warning.starts_with("299 - ") && warning.contains("not written"), "{warning}");
    assert_eq!(get(&admin, &node).await.1["spec"]["estop"], "Cut");
    let release = json!({"spec": {"estop": null}});
    assert_eq!(send(&admin, "PATCH", &node, release).await.0, 200);
    assert_eq!(send(&admin, "DELETE", &format!("{TASKS}/t"), Value::Null).await.0, 200);
    assert_eq!(send(&admin, "DELETE", TASKS, Value::Null).await.0, 200);
    let token = format!("{G}/usertokens/{}", token["metadata"]["name"].as_str().unwrap());
    assert_eq!(send(&admin, "DELETE", &token, Value::Null).await.0, 200);
    // These two are answered by what they find: nobody drives, and the node was never there.
    for path in [format!("{G}/leases/r1/take"), format!("{node}/fence")] {
        assert_ne!(send(&admin, "POST", &path, json!({"reason": "a test"})).await.0, 503, "{path}");
    }
    std::fs::remove_file(&audit).unwrap();
    assert_eq!(send(&admin, "POST", TASKS, task("v")).await.0, 201);
    let lines = lines(&cluster);
    assert_eq!((lines.len(), &lines[0]["missing"]), (2, &7.into()), "{lines:?}");
    cluster.running.shut_down().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn what_a_collection_lost_is_said_also_when_some_of_it_stayed() {
    let cluster = Cluster::start().await;
    let admin = cluster.admin().await;
    for node in ["goes", "stays"] {
        register(&admin, node).await;
    }
    let stop = json!({"spec": {"estop": "Cut"}});
    assert_eq!(send(&admin, "PATCH", &format!("{G}/nodes/stays"), stop).await.0, 200);
    let ended = send(&admin, "DELETE", &format!("{G}/nodes"), Value::Null).await;
    assert_eq!(refusal(&ended), (409, "NodeStopped"));
    let line = lines(&cluster).pop().unwrap();
    assert_eq!(brief(&line), "admin deletecollection nodes/- -/- 409 NodeStopped");
    let names: Vec<&Value> =
        line["objects"].as_array().unwrap().iter().map(|object| &object["name"]).collect();
    assert_eq!(names, ["goes"]);
    cluster.running.shut_down().await.unwrap();
}
