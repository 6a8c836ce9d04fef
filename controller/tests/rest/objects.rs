//! Create, read, change, list.

use kube::api::{Api, ListParams, Patch, PatchParams, PostParams};
use muster_api::kind::task::Task;
use serde_json::{Value, json};

use super::support::*;

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_task_lives_through_the_kube_client() {
    let cluster = Cluster::start().await;
    let tasks: Api<Task> = Api::default_namespaced(cluster.admin().await);
    let body: Task = serde_json::from_value(task("scan")).unwrap();
    let created = tasks.create(&PostParams::default(), &body).await.unwrap();
    assert_eq!(created.metadata.generation, Some(1));
    assert!(created.metadata.uid.is_some() && created.metadata.creation_timestamp.is_some());

    let changed = loop {
        let mut next = tasks.get("scan").await.unwrap();
        next.spec.priority = 5;
        match tasks.replace("scan", &PostParams::default(), &next).await {
            // The scheduler says why the task waits: a conflict is what every client meets.
            Err(kube::Error::Api(status)) if status.code == 409 => {}
            changed => break changed.unwrap(),
        }
    };
    assert_eq!(changed.metadata.generation, Some(2), "the spec changed");
    let error = tasks.replace("scan", &PostParams::default(), &created).await.unwrap_err();
    assert!(matches!(error, kube::Error::Api(ref s) if s.code == 409), "{error}");

    let patch = json!({"metadata": {"labels": {"app": null, "tier": "a"}}});
    let patched = tasks.patch("scan", &PatchParams::default(), &Patch::Merge(patch)).await.unwrap();
    assert_eq!(patched.metadata.generation, Some(2), "labels are not the spec");
    assert_eq!(patched.metadata.labels.unwrap().into_keys().collect::<Vec<_>>(), ["tier"]);

    let status = json!({"status": {"phase": "Bound", "node": "n1"}, "spec": {"priority": 9}});
    let patch = Patch::Merge(status);
    let with_status = tasks.patch_status("scan", &PatchParams::default(), &patch).await.unwrap();
    assert_eq!(with_status.status.unwrap().node.as_deref(), Some("n1"));
    assert_eq!(with_status.spec.priority, 5, "status writes status only");
    let nonsense = Patch::Merge(json!({"status": {"phase": "Dancing"}}));
    let refused = tasks.patch_status("scan", &PatchParams::default(), &nonsense).await.unwrap_err();
    assert!(matches!(refused, kube::Error::Api(ref s) if s.code == 422), "{refused}");
    let found = tasks.list(&ListParams::default().labels("tier=a")).await.unwrap();
    assert_eq!(found.items.len(), 1);
    cluster.running.shut_down().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn bad_objects_are_refused_whole() {
    let cluster = Cluster::start().await;
    let admin = cluster.admin().await;
    let mut bad = task("bad");
    bad["spec"]["resources"] = json!({"cpu": "2core"});
    bad["spec"]["priorty"] = 1.into();
    let answer = send(&admin, "POST", TASKS, bad.clone()).await;
    assert_eq!(refusal(&answer), (422, "Invalid"));
    let causes = answer.1["details"]["causes"].as_array().unwrap();
    let mut fields: Vec<_> = causes.iter().map(|c| c["field"].as_str().unwrap()).collect();
    fields.sort_unstable();
    assert_eq!(fields, ["spec.priorty", "spec.resources.cpu"], "all at once");

    bad["spec"]["resources"]["cpu"] = "2".into();
    let (code, made) = send(&admin, "POST", &format!("{TASKS}?fieldValidation=Warn"), bad).await;
    assert_eq!((code, &made["spec"]["priorty"]), (201, &Value::Null));

    let again = send(&admin, "POST", TASKS, task("bad")).await;
    assert_eq!(refusal(&again), (409, "AlreadyExists"));
    let nowhere = send(&admin, "POST", &format!("{G}/namespaces/nowhere/tasks"), task("x")).await;
    assert_eq!(refusal(&nowhere), (404, "NotFound"));
    let mut wrong = task("x");
    wrong["kind"] = "Node".into();
    let wrong = send(&admin, "POST", TASKS, wrong).await;
    assert_eq!(refusal(&wrong), (400, "BadRequest"));
    let yaml = send_as(&admin, "POST", TASKS, "application/yaml", "a: 1".into()).await;
    assert_eq!(refusal(&yaml), (415, "UnsupportedMediaType"));
    let huge = format!("{{\"metadata\":{{\"name\":\"{}\"}}}}", "x".repeat(4 << 20));
    let huge = send_as(&admin, "POST", TASKS, "application/json", huge).await;
    assert_eq!(refusal(&huge), (413, "RequestEntityTooLarge"));
    let unknown = get(&admin, "/apis/other.dev/v1/things").await;
    assert_eq!(refusal(&unknown), (404, "NotFound"));
    let lease = send(&admin, "POST", &format!("{G}/leases"), json!({})).await;
    assert_eq!(refusal(&lease), (405, "MethodNotAllowed"));
    cluster.running.shut_down().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn what_the_server_owns_is_not_taken_from_clients() {
    let cluster = Cluster::start().await;
    let admin = cluster.admin().await;
    let mut body = task("own");
    body["metadata"]["uid"] = "mine".into();
    body["metadata"]["deletionTimestamp"] = "2020-01-01T00:00:00Z".into();
    body["status"] = json!({"phase": "Running"});
    let (code, made) = send(&admin, "POST", TASKS, body).await;
    assert_eq!(code, 201, "{made}");
    assert_ne!(made["metadata"]["uid"], "mine");
    assert_eq!(made["metadata"]["deletionTimestamp"], Value::Null);
    assert_ne!(made["status"]["phase"], "Running");

    let mut moved = task("own");
    moved["spec"]["run"]["process"]["command"] = json!(["/bin/false"]);
    let moved = send(&admin, "PUT", &format!("{TASKS}/own"), moved).await;
    assert_eq!(refusal(&moved), (422, "Invalid"), "a spec stays");
    assert!(moved.1["details"]["causes"][0]["field"].as_str().unwrap().starts_with("spec.run"));

    let path = format!("{EVENTS}/own");
    let (_, made) = send(&admin, "POST", EVENTS, event("own")).await;
    // A PUT without uid and version keeps both going, as kubectl's replace needs.
    let (code, put) = send(&admin, "PUT", &path, event("own")).await;
    assert_eq!((code, &put["metadata"]["uid"]), (200, &made["metadata"]["uid"]));
    assert_eq!(
        put["metadata"]["resourceVersion"], made["metadata"]["resourceVersion"],
        "no change"
    );
    let mut other = event("own");
    other["metadata"]["uid"] = "another".into();
    assert_eq!(refusal(&send(&admin, "PUT", &path, other).await), (409, "Conflict"));
    let mut generated = task("x");
    generated["metadata"] = json!({"generateName": "run-"});
    let (code, generated) = send(&admin, "POST", TASKS, generated).await;
    assert_eq!(code, 201);
    assert!(generated["metadata"]["name"].as_str().unwrap().starts_with("run-"));

    // Who names it means this one.
    let mut named = task("own");
    named["metadata"]["generateName"] = "own-".into();
    let twice = send(&admin, "POST", TASKS, named).await;
    assert_eq!(refusal(&twice), (409, "AlreadyExists"));

    let (code, _) = send(&admin, "POST", &format!("{TASKS}?dryRun=All"), task("dry")).await;
    assert_eq!(code, 201);
    assert_eq!(get(&admin, &format!("{TASKS}/dry")).await.0, 404);
    cluster.running.shut_down().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn patches_are_of_two_kinds() {
    let cluster = Cluster::start().await;
    let admin = cluster.admin().await;
    send(&admin, "POST", EVENTS, event("p")).await;
    let path = format!("{EVENTS}/p");
    let json_patch = |ops: Value| {
        let (admin, path) = (admin.clone(), path.clone());
        async move {
            send_as(&admin, "PATCH", &path, "application/json-patch+json", ops.to_string()).await
        }
    };
    let add = json!([{"op": "add", "path": "/metadata/labels/x", "value": "y"}]);
    assert_eq!(json_patch(add).await.1["metadata"]["labels"]["x"], "y");
    let test = json!([{"op": "test", "path": "/metadata/labels/x", "value": "z"}]);
    assert_eq!(refusal(&json_patch(test).await), (422, "Invalid"));
    let stale = json!({"metadata": {"resourceVersion": "1"}});
    assert_eq!(refusal(&send(&admin, "PATCH", &path, stale).await), (409, "Conflict"));
    let media = "application/strategic-merge-patch+json";
    let strategic = send_as(&admin, "PATCH", &path, media, "{}".into()).await;
    assert_eq!(strategic.0, 200, "kubectl patches core kinds so: {}", strategic.1);
    send(&admin, "POST", TASKS, task("p")).await;
    let strategic = send_as(&admin, "PATCH", &format!("{TASKS}/p"), media, "{}".into()).await;
    assert_eq!(refusal(&strategic), (415, "UnsupportedMediaType"));
    let missing = send(&admin, "PATCH", &format!("{EVENTS}/none"), json!({})).await;
    assert_eq!(refusal(&missing), (404, "NotFound"));
    cluster.running.shut_down().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn lists_select_and_come_in_exact_pages() {
    let cluster = Cluster::start().await;
    let admin = cluster.admin().await;
    for name in ["a", "b", "c", "d", "e"] {
        send(&admin, "POST", EVENTS, event(name)).await;
    }
    let (_, page) = get(&admin, &format!("{EVENTS}?limit=2")).await;
    assert_eq!((page["kind"].as_str(), names(&page)), (Some("EventList"), vec!["a", "b"]));
    assert_eq!(page["metadata"]["remainingItemCount"], 3);
    let token = page["metadata"]["continue"].as_str().unwrap();
    send(&admin, "DELETE", &format!("{EVENTS}/c"), Value::Null).await;
    send(&admin, "POST", EVENTS, event("f")).await;
    let (_, rest) = get(&admin, &format!("{EVENTS}?limit=10&continue={token}")).await;
    assert_eq!(names(&rest), ["c", "d", "e"], "as it was when the list began");
    assert_eq!(rest["metadata"]["resourceVersion"], page["metadata"]["resourceVersion"]);

    // The history is forgotten: the rest can be had as it is now, by those who say that they know.
    let store = &cluster.running.context().store;
    store.compact(store.revision()).await.unwrap();
    let late = get(&admin, &format!("{EVENTS}?limit=10&continue={token}")).await;
    assert_eq!(refusal(&late), (410, "Expired"));
    let token = late.1["metadata"]["continue"].as_str().unwrap();
    let (_, rest) = get(&admin, &format!("{EVENTS}?limit=2&continue={token}")).await;
    assert_eq!(names(&rest), ["d", "e"], "c is gone");
    let token = rest["metadata"]["continue"].as_str().unwrap();
    let (_, rest) = get(&admin, &format!("{EVENTS}?continue={token}")).await;
    assert_eq!(names(&rest), ["f"]);
    assert_eq!(rest["metadata"]["continue"], Value::Null);

    let select = |query: &str| {
        let (admin, path) = (admin.clone(), format!("{EVENTS}?{query}"));
        async move { get(&admin, &path).await }
    };
    assert_eq!(names(&select("labelSelector=app%20in%20(a,b)").await.1), ["a", "b"]);
    assert_eq!(
        names(&select("fieldSelector=metadata.name!=a,metadata.name!=b&limit=1").await.1),
        ["d"]
    );
    let unknown = select("fieldSelector=spec.unknown=1").await;
    assert_eq!(refusal(&unknown), (400, "BadRequest"));
    assert_eq!(refusal(&select("continue=nonsense").await), (400, "BadRequest"));
    assert_eq!(refusal(&select("resourceVersion=99999").await), (504, "Timeout"));
    // A page of a revision, as Kubernetes means it, is of that one; and it goes on by its token alone.
    let (_, made) = send(&admin, "POST", EVENTS, event("g")).await;
    let then = made["metadata"]["resourceVersion"].as_str().unwrap();
    send(&admin, "POST", EVENTS, event("h")).await;
    let page = select(&format!("limit=10&resourceVersion={then}")).await.1;
    assert_eq!(names(&page), ["a", "b", "d", "e", "f", "g"]);
    assert_eq!(page["metadata"]["resourceVersion"], then);
    let page = select("limit=1").await.1;
    let token = page["metadata"]["continue"].as_str().unwrap();
    let mixed = select(&format!("resourceVersion={then}&continue={token}")).await;
    assert_eq!(refusal(&mixed), (400, "BadRequest"));
    assert_eq!(select(&format!("resourceVersion=0&continue={token}")).await.0, 200);
    use base64::Engine as _;
    let ahead = r#"{"revision":99999,"namespace":"default","name":"a"}"#;
    let ahead = base64::engine::general_purpose::URL_SAFE_NO_PAD.encode(ahead);
    assert_eq!(refusal(&select(&format!("continue={ahead}")).await), (504, "Timeout"));
    assert!(names(&select("fieldSelector=metadata.namespace=other").await.1).is_empty());
    assert_eq!(names(&select("fieldSelector=metadata.namespace=default&limit=1").await.1), ["a"]);
    cluster.running.shut_down().await.unwrap();
}

/// An answer as a table, of a list or of one.
async fn table(client: &kube::Client, path: &str) -> Value {
    let accept = "application/json;as=Table;v=v1;g=meta.k8s.io,application/json";
    let request = http::Request::get(path).header("accept", accept).body(Vec::new()).unwrap();
    let text = client.request_text(request).await.unwrap();
    serde_json::from_str(&text).unwrap()
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_table_has_what_kubectl_prints() {
    let cluster = Cluster::start().await;
    let admin = cluster.admin().await;
    send(&admin, "POST", TASKS, task("t")).await;
    let list = table(&admin, TASKS).await;
    assert_eq!((&list["kind"], &list["apiVersion"]), (&json!("Table"), &json!("meta.k8s.io/v1")));
    assert!(list["metadata"]["resourceVersion"].is_string());
    let columns = list["columnDefinitions"].as_array().unwrap();
    let of = |priority: i64| -> Vec<&str> {
        let shown = columns.iter().filter(|column| column["priority"] == priority);
        shown.map(|column| column["name"].as_str().unwrap()).collect()
    };
    assert_eq!((of(0)[0], columns[0]["format"].as_str()), ("Name", Some("name")));
    assert!(of(0).iter().any(|name| name.eq_ignore_ascii_case("age")), "{columns:?}");
    assert!(
        of(1).iter().any(|name| name.eq_ignore_ascii_case("message")),
        "for -o wide: {columns:?}"
    );
    let row = &list["rows"][0];
    assert_eq!(
        (&row["cells"][0], row["cells"].as_array().unwrap().len()),
        (&json!("t"), columns.len())
    );
    assert_eq!(row["object"]["kind"], "PartialObjectMetadata");
    assert_eq!(row["object"]["metadata"]["labels"]["app"], "t");
    let included = async |how: &str| table(&admin, &format!("{TASKS}?includeObject={how}")).await;
    assert_eq!(included("None").await["rows"][0]["object"], Value::Null);
    assert_eq!(included("Object").await["rows"][0]["object"]["kind"], "Task");
    let one = table(&admin, &format!("{TASKS}/t")).await;
    assert_eq!((&one["kind"], one["rows"].as_array().unwrap().len()), (&json!("Table"), 1));
    let refused = get(&admin, &format!("{TASKS}?includeObject=All")).await;
    assert_eq!(refused.0, 200, "it says nothing of other forms");
    cluster.running.shut_down().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn what_is_only_read_is_not_written() {
    let cluster = Cluster::start().await;
    let admin = cluster.admin().await;
    send(&admin, "POST", TASKS, task("t")).await;
    for sub in ["log", "why"] {
        for method in ["POST", "PUT", "PATCH", "DELETE"] {
            let refused = send(&admin, method, &format!("{TASKS}/t/{sub}"), json!({})).await;
            assert_eq!(refusal(&refused), (405, "MethodNotAllowed"), "{method} {sub}");
        }
        assert_ne!(get(&admin, &format!("{TASKS}/t/{sub}")).await.0, 405);
    }
    cluster.running.shut_down().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn discovery_tells_what_there_is() {
    let cluster = Cluster::start().await;
    let admin = cluster.admin().await;
    let groups = admin.list_api_groups().await.unwrap();
    assert_eq!(groups.groups[0].name, "muster.dev");
    let list = admin.list_api_group_resources("muster.dev/v1alpha1").await.unwrap();
    let mut named: Vec<_> = list.resources.iter().map(|r| r.name.as_str()).collect();
    named.sort_unstable();
    assert_eq!(
        named,
        [
            "accesses",
            "applications",
            "applications/status",
            "frameworks",
            "frameworks/position",
            "frameworks/status",
            "leases",
            "leases/acquire",
            "leases/return",
            "leases/status",
            "leases/take",
            "nodes",
            "nodes/fence",
            "nodes/status",
            "quotas",
            "quotas/status",
            "sites",
            "tasks",
            "tasks/log",
            "tasks/status",
            "tasksetrevisions",
            "tasksets",
            "tasksets/scale",
            "tasksets/status"
        ]
    );
    let task = list.resources.iter().find(|r| r.name == "tasks").unwrap();
    assert_eq!(task.short_names.as_deref(), Some(&["tk".to_owned()][..]));
    assert!(admin.apiserver_version().await.unwrap().git_version.contains("muster"));
    let discovery = kube::Discovery::new(admin).run().await.unwrap();
    assert!(discovery.has_group("muster.dev"));
    cluster.running.shut_down().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_restart_finds_everything_as_it_was() {
    let cluster = Cluster::start().await;
    let admin = cluster.admin().await;
    let (_, made) = send(&admin, "POST", EVENTS, event("kept")).await;
    drop(admin);
    let cluster = cluster.restart().await;
    let (code, kept) = get(&cluster.admin().await, &format!("{EVENTS}/kept")).await;
    assert_eq!((code, kept), (200, made));
    cluster.running.shut_down().await.unwrap();
}
