//! Every role × every verb × every kind and every part of one, against the real server. What is expected is written out here;
//! what there is to ask for is read from discovery, so that something new is not forgotten.

use std::collections::{BTreeMap, BTreeSet};

use futures::{StreamExt as _, stream};
use http::{Method, Request};
use kube::Client;
use serde_json::{Value, json};

use super::support::*;

/// Get, List, Watch, Create, Update, Patch, Delete, deletecollection (X). A GET of exec and attach is no reading: it is
/// decided as a creation.
const EVERYWHERE: &str = "
    RESOURCE                          framework  viewer  developer  operator  admin     node
    muster.dev/tasks                  GLW        GLW     GLWCUPDX   GLWCUPDX  GLWCUPDX  -
    muster.dev/tasks/status           G          G       G          G         GUP       -
    muster.dev/tasks/log              G          G       G          G         G         -
    muster.dev/tasksets               -          GLW     GLWCUPDX   GLWCUPDX  GLWCUPDX  -
    muster.dev/tasksets/status        -          G       G          G         GUP       -
    muster.dev/tasksets/scale         -          G       GUP        GUP       GUP       -
    muster.dev/tasksetrevisions       -          GLW     GLWDX      GLWDX     GLWDX     -
    muster.dev/applications           -          GLW     GLWCUPDX   GLWCUPDX  GLWCUPDX  -
    muster.dev/applications/status    -          G       G          G         GUP       -
    muster.dev/frameworks             GLW        GLW     GLWDX      GLWDX     GLWDX     -
    muster.dev/frameworks/position    C          -       C          C         C         -
    muster.dev/frameworks/status      G          G       G          G         GUP       -
    muster.dev/quotas                 -          GLW     GLW        GLW       GLWCUPDX  -
    muster.dev/quotas/status          -          G       G          G         GUP       -
    muster.dev/nodes                  GLW        GLW     GLW        GLWCUPDX  GLWCUPDX  G
    muster.dev/nodes/status           G          G       G          G         GUP       -
    muster.dev/nodes/fence            -          -       -          C         C         -
    muster.dev/leases                 GLW        GLW     GLW        GLW       GLW       -
    muster.dev/leases/status          G          G       G          G         G         -
    muster.dev/leases/acquire         -          -       C          C         C         -
    muster.dev/leases/return          -          -       C          C         C         -
    muster.dev/leases/take            -          -       -          C         C         -
    muster.dev/sites                  GLW        GLW     GLW        GLWCUPDX  GLWCUPDX  -
    muster.dev/accesses               -          -       -          GLW       GLWCUPDX  -
    v1/pods                           GLW        GLW     GLWCUPDX   GLWCUPDX  GLWCUPDX  -
    v1/pods/status                    G          G       G          G         GUP       -
    v1/pods/log                       G          G       G          G         G         -
    v1/pods/exec                      -          -       GC         GC        GC        -
    v1/pods/attach                    -          -       GC         GC        GC        -
    v1/pods/eviction                  -          -       C          C         C         -
    v1/configmaps                     -          GLW     GLWCUPDX   GLWCUPDX  GLWCUPDX  -
    v1/secrets                        -          -       GLWCUPDX   GLWCUPDX  GLWCUPDX  -
    v1/services                       GLW        GLW     GLW        GLW       GLW       -
    v1/events                         GLW        GLW     GLW        GLW       GLWCUPDX  -
    v1/namespaces                     GLW        GLW     GLW        GLW       GLWCUPDX  -
    v1/namespaces/status              G          G       G          G         GUP       -
    v1/nodes                          GLW        GLW     GLW        GLWCUPDX  GLWCUPDX  G
    v1/nodes/status                   G          G       G          G         GUP       -
    metrics.k8s.io/nodes              GL         GL      GL         GL        GL        G
    metrics.k8s.io/pods               GL         GL      GL         GL        GL        -
";

/// What somebody who holds the role in `lab` alone may there, and with what is in no namespace.
const IN_LAB: &str = "
    RESOURCE                          framework  viewer  developer  operator  admin
    muster.dev/tasks                  GLW        GLW     GLWCUPDX   GLWCUPDX  GLWCUPDX
    muster.dev/tasks/status           G          G       G          G         G
    muster.dev/tasks/log              G          G       G          G         G
    muster.dev/tasksets               -          GLW     GLWCUPDX   GLWCUPDX  GLWCUPDX
    muster.dev/tasksets/status        -          G       G          G         G
    muster.dev/tasksets/scale         -          G       GUP        GUP       GUP
    muster.dev/tasksetrevisions       -          GLW     GLWDX      GLWDX     GLWDX
    muster.dev/applications           -          GLW     GLWCUPDX   GLWCUPDX  GLWCUPDX
    muster.dev/applications/status    -          G       G          G         G
    muster.dev/frameworks             GLW        GLW     GLWDX      GLWDX     GLWDX
    muster.dev/frameworks/position    C          -       C          C         C
    muster.dev/frameworks/status      G          G       G          G         G
    muster.dev/quotas                 -          GLW     GLW        GLW       GLW
    muster.dev/quotas/status          -          G       G          G         G
    muster.dev/nodes                  GLW        GLW     GLW        GLW       GLW
    muster.dev/nodes/status           G          G       G          G         G
    muster.dev/nodes/fence            -          -       -          -         -
    muster.dev/leases                 GLW        GLW     GLW        GLW       GLW
    muster.dev/leases/status          G          G       G          G         G
    muster.dev/leases/acquire         -          -       -          -         -
    muster.dev/leases/return          -          -       -          -         -
    muster.dev/leases/take            -          -       -          -         -
    muster.dev/sites                  GLW        GLW     GLW        GLW       GLW
    muster.dev/accesses               -          -       -          -         -
    v1/pods                           GLW        GLW     GLWCUPDX   GLWCUPDX  GLWCUPDX
    v1/pods/status                    G          G       G          G         G
    v1/pods/log                       G          G       G          G         G
    v1/pods/exec                      -          -       GC         GC        GC
    v1/pods/attach                    -          -       GC         GC        GC
    v1/pods/eviction                  -          -       C          C         C
    v1/configmaps                     -          GLW     GLWCUPDX   GLWCUPDX  GLWCUPDX
    v1/secrets                        -          -       GLWCUPDX   GLWCUPDX  GLWCUPDX
    v1/services                       GLW        GLW     GLW        GLW       GLW
    v1/events                         GLW        GLW     GLW        GLW       GLWCUPDX
    v1/namespaces                     G          G       G          G         G
    v1/namespaces/status              G          G       G          G         G
    v1/nodes                          GLW        GLW     GLW        GLW       GLW
    v1/nodes/status                   G          G       G          G         G
    metrics.k8s.io/nodes              GL         GL      GL         GL        GL
    metrics.k8s.io/pods               GL         GL      GL         GL        GL
";

/// What is no kind, everywhere: method and path, and who may.
const OTHERS: &str = "
    PATH                                  framework  viewer  developer  operator  admin  node
    POST_plan                             -          yes     yes        yes       yes    -
    POST_check                            -          yes     yes        yes       yes    -
    POST_transaction                      -          -       yes        yes       yes    -
    GET_usage                             yes        yes     yes        yes       yes    -
    GET_offers                            yes        yes     yes        yes       yes    -
    GET_poses                             yes        yes     yes        yes       yes    -
    GET_nodes/x/pose                      yes        yes     yes        yes       yes    yes
    GET_namespaces/lab/tasks/x/why        yes        yes     yes        yes       yes    -
    GET_namespaces/lab/frameworks/x/why   yes        yes     yes        yes       yes    -
    GET_jointokens                        -          -       -          yes       yes    -
    DELETE_jointokens/x                   -          -       -          yes       yes    -
    GET_usertokens                        -          -       -          -         yes    -
    POST_usertokens                       -          -       -          -         yes    -
    DELETE_usertokens/x                   -          -       -          -         yes    -
    GET_/metrics                          -          yes     yes        yes       yes    -
    GET_/version                          yes        yes     yes        yes       yes    yes
    GET_/apis                             yes        yes     yes        yes       yes    yes
    GET_/openapi/v3                       yes        yes     yes        yes       yes    yes
    POST_/apis/authorization.k8s.io/v1/selfsubjectaccessreviews  yes  yes  yes  yes  yes  yes
    POST_/apis/authorization.k8s.io/v1/subjectaccessreviews      -    -    -    -    yes  -
";

const LETTERS: &str = "GLWCUPDX";

type Table = BTreeMap<String, BTreeMap<String, String>>;

/// By row, by column.
fn table(text: &str) -> Table {
    let mut lines = text.lines().map(str::trim).filter(|line| !line.is_empty());
    let head: Vec<&str> = lines.next().unwrap().split_whitespace().collect();
    let row = |line: &str| {
        let cells: Vec<&str> = line.split_whitespace().collect();
        assert_eq!(cells.len(), head.len(), "{line}");
        let named = head.iter().zip(&cells).skip(1);
        let cells = named.map(|(role, cell)| ((*role).to_owned(), (*cell).to_owned())).collect();
        (line.split_whitespace().next().unwrap().to_owned(), cells)
    };
    lines.map(row).collect()
}

/// A resource or a part of one, as discovery has it.
struct Served {
    label: String,
    root: String,
    namespaced: bool,
}

async fn served(admin: &Client) -> Vec<Served> {
    let mut all = Vec::new();
    let groups =
        [("muster.dev", G), ("v1", "/api/v1"), ("metrics.k8s.io", "/apis/metrics.k8s.io/v1beta1")];
    for (group, root) in groups {
        let (_, list) = get(admin, root).await;
        for resource in list["resources"].as_array().unwrap() {
            let name = resource["name"].as_str().unwrap();
            all.push(Served {
                label: format!("{group}/{name}"),
                root: root.to_owned(),
                namespaced: resource["namespaced"].as_bool().unwrap(),
            });
        }
    }
    all
}

impl Served {
    /// Method and path of a verb on the object `x` in a namespace; none: HTTP has no such request.
    fn request(&self, letter: char, namespace: &str) -> Option<(&'static str, String)> {
        let mut parts = self.label.split('/').skip(1);
        let (plural, part) = (parts.next().unwrap(), parts.next());
        if self.root.contains("metrics") && !"GL".contains(letter) {
            return None;
        }
        let name = if plural == "namespaces" { namespace } else { "x" };
        let all = match self.namespaced {
            true => format!("{}/namespaces/{namespace}/{plural}", self.root),
            false => format!("{}/{plural}", self.root),
        };
        let one = match part {
            Some(part) => format!("{all}/{name}/{part}"),
            None => format!("{all}/{name}"),
        };
        Some(match (letter, part) {
            ('G', _) => ("GET", one),
            ('U', _) => ("PUT", one),
            ('P', _) => ("PATCH", one),
            ('D', _) => ("DELETE", one),
            ('C', Some(_)) => ("POST", one),
            ('C', None) => ("POST", all),
            ('L', None) => ("GET", all),
            ('W', None) => ("GET", format!("{all}?watch=true")),
            ('X', None) => ("DELETE", all),
            _ => return None,
        })
    }
}

/// Whether the server lets this client do it, whatever comes of it.
async fn lets(client: &Client, method: &str, path: &str) -> bool {
    let mark = if path.contains('?') { '&' } else { '?' };
    let request = Request::builder()
        .method(method.parse::<Method>().unwrap())
        // Everything is asked for by everybody, and is to stay.
        .uri(format!("{path}{mark}dryRun=All"))
        .header("content-type", "application/json")
        .body(kube::client::Body::from(b"{}".to_vec()))
        .unwrap();
    let response = client.send(request).await.unwrap();
    let code = response.status().as_u16();
    assert!(code != 401 && code != 429, "{method} {path}: {code}");
    if code != 403 {
        return true;
    }
    let body = response.into_body().collect_bytes().await.unwrap();
    let status: Value = serde_json::from_slice(&body).unwrap();
    let message = status["message"].as_str().unwrap();
    // The namespace `default` may be deleted by nobody, for one.
    let by_right = message.contains("is forbidden: User \"");
    assert!(!by_right || message.contains(" cannot "), "{message}");
    !by_right
}

/// Gives `user` a role, and a client with a token.
async fn user(cluster: &Cluster, name: &str, role: &str, namespaces: Value) -> Client {
    cluster.give(name, role, namespaces).await;
    cluster.user(name).await
}

/// What of a resource the client may: the letters, or `-`.
async fn found(client: &Client, served: &Served, namespace: &str) -> String {
    let asked = LETTERS
        .chars()
        .filter_map(|letter| served.request(letter, namespace).map(|request| (letter, request)));
    let mut found = String::new();
    for (letter, (method, path)) in asked {
        if lets(client, method, &path).await {
            found.push(letter);
        }
    }
    if found.is_empty() { "-".to_owned() } else { found }
}

/// Every row for one client, against what is expected of it.
async fn hold(client: &Client, all: &[Served], namespace: &str, (table, role): (&Table, &str)) {
    let rows = stream::iter(all).map(|served| async move {
        (served.label.clone(), found(client, served, namespace).await)
    });
    let found: BTreeMap<String, String> = rows.buffer_unordered(8).collect().await;
    let expected: BTreeMap<String, String> =
        table.iter().map(|(row, cells)| (row.clone(), cells[role].clone())).collect();
    assert_eq!(found, expected, "{role} in {namespace}");
}

const ROLES: [&str; 5] = ["framework", "viewer", "developer", "operator", "admin"];

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn every_role_may_what_the_table_says() {
    let cluster = Cluster::start().await;
    let admin = cluster.admin().await;
    for name in ["lab", "hall"] {
        let namespace =
            json!({"apiVersion": "v1", "kind": "Namespace", "metadata": {"name": name}});
        assert_eq!(send(&admin, "POST", "/api/v1/namespaces", namespace).await.0, 201);
    }
    let all = served(&admin).await;
    let (everywhere, in_lab) = (table(EVERYWHERE), table(IN_LAB));
    let labels: BTreeSet<&str> = all.iter().map(|served| served.label.as_str()).collect();
    for table in [&everywhere, &in_lab] {
        let rows: BTreeSet<&str> = table.keys().map(String::as_str).collect();
        assert_eq!(labels, rows, "what is served, and what the table has");
    }
    let node = cluster.agent("x").await;
    hold(&node, &all, "lab", (&everywhere, "node")).await;
    for role in ROLES {
        let whole = user(&cluster, role, role, Value::Null).await;
        hold(&whole, &all, "lab", (&everywhere, role)).await;
        let lab = user(&cluster, &format!("{role}-lab"), role, json!(["lab"])).await;
        hold(&lab, &all, "lab", (&in_lab, role)).await;
        for served in &all {
            let shared = ["nodes", "leases", "sites"];
            let shared = shared.contains(&served.label.split('/').nth(1).unwrap());
            let elsewhere = if shared { in_lab[&served.label][role].as_str() } else { "-" };
            assert_eq!(found(&lab, served, "hall").await, elsewhere, "{role}: {}", served.label);
        }
    }
    cluster.running.shut_down().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn every_role_may_ask_what_the_table_says() {
    let cluster = Cluster::start().await;
    let mut clients = vec![("node", cluster.agent("x").await)];
    for role in ROLES {
        clients.push((role, user(&cluster, role, role, Value::Null).await));
    }
    for (row, cells) in table(OTHERS) {
        let (method, path) = row.split_once('_').unwrap();
        let path = match path.starts_with('/') {
            true => path.to_owned(),
            false => format!("{G}/{path}"),
        };
        for (role, client) in &clients {
            let expected = cells[*role] == "yes";
            assert_eq!(lets(client, method, &path).await, expected, "{role}: {row}");
        }
    }
    cluster.running.shut_down().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_refusal_has_kubernetes_words_and_says_what_would_do() {
    let cluster = Cluster::start().await;
    let ada = user(&cluster, "ada", "viewer", json!(["default"])).await;
    let refused = send(&ada, "DELETE", &format!("{TASKS}/patrol"), Value::Null).await;
    assert_eq!(refusal(&refused), (403, "Forbidden"));
    assert_eq!(
        refused.1["message"],
        "tasks.muster.dev \"patrol\" is forbidden: User \"ada\" cannot delete resource \"tasks\" in API group \
         \"muster.dev\" in the namespace \"default\": the user is viewer in the namespace \"default\"; developer in the \
         namespace \"default\" may"
    );
    let refused = send(&ada, "PATCH", &format!("{G}/nodes/r1"), json!({})).await;
    let message = refused.1["message"].as_str().unwrap();
    assert!(message.contains("at the cluster scope"), "{message}");
    // A right that is given counts at once, and so does its end.
    let task = format!("{TASKS}/patrol");
    let developer = json!({
        "apiVersion": "muster.dev/v1alpha1", "kind": "Access", "metadata": {"name": "more"},
        "spec": {"role": "developer", "namespaces": ["default"], "subjects": [{"kind": "Group", "name": "lab"}]},
    });
    let admin = cluster.admin().await;
    assert_eq!(send(&admin, "POST", &format!("{G}/accesses"), developer).await.0, 201);
    assert_eq!(send(&ada, "DELETE", &task, Value::Null).await.0, 404);
    assert_eq!(send(&admin, "DELETE", &format!("{G}/accesses/more"), Value::Null).await.0, 200);
    assert_eq!(send(&ada, "DELETE", &task, Value::Null).await.0, 403);
    cluster.running.shut_down().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn what_one_may_is_told_by_the_same_decision() {
    let cluster = Cluster::start().await;
    let ada = user(&cluster, "ada", "developer", json!(["lab"])).await;
    let root = "/apis/authorization.k8s.io/v1";
    let asks = |verb: &str, group: &str, resource: &str, part: &str, namespace: &str| {
        json!({"resourceAttributes": {"verb": verb, "group": group, "resource": resource,
            "subresource": part, "namespace": namespace}})
    };
    let cases = [
        (asks("create", "muster.dev", "tasks", "", "lab"), true),
        (asks("create", "muster.dev", "tasks", "", "hall"), false),
        (asks("create", "muster.dev", "tasks", "", ""), false),
        (asks("*", "muster.dev", "tasks", "", "lab"), true),
        (asks("create", "", "pods", "exec", "lab"), true),
        (asks("get", "", "pods", "log", "lab"), true),
        (asks("create", "muster.dev", "nodes", "fence", ""), false),
        (asks("get", "muster.dev", "usertokens", "", ""), false),
        (asks("get", "other.dev", "things", "", "lab"), false),
        (json!({"nonResourceAttributes": {"verb": "get", "path": "/metrics"}}), false),
        (json!({"nonResourceAttributes": {"verb": "get", "path": "/apis"}}), true),
    ];
    let admin = cluster.admin().await;
    for (spec, expected) in cases {
        let own = json!({ "spec": spec });
        let path = format!("{root}/selfsubjectaccessreviews");
        let (_, told) = send(&ada, "POST", &path, own).await;
        assert_eq!(told["status"]["allowed"], expected, "{told}");
        assert_eq!(told["status"]["reason"] == "", expected, "{told}");
        let mut of_ada = spec.clone();
        of_ada["user"] = "ada".into();
        let path = format!("{root}/subjectaccessreviews");
        let (_, told) = send(&admin, "POST", &path, json!({ "spec": of_ada })).await;
        assert_eq!(
            (&told["kind"], &told["status"]["allowed"]),
            (&"SubjectAccessReview".into(), &expected.into())
        );
    }
    let path = format!("{root}/selfsubjectrulesreviews");
    let (_, told) = send(&ada, "POST", &path, json!({"spec": {"namespace": "lab"}})).await;
    let rules = told["status"]["resourceRules"].as_array().unwrap();
    let secrets = rules.iter().find(|rule| rule["resources"] == json!(["secrets"])).unwrap();
    assert_eq!(
        (&secrets["apiGroups"], secrets["verbs"].as_array().unwrap().len()),
        (&json!([""]), 8)
    );
    let (_, told) = send(&ada, "POST", &path, json!({"spec": {"namespace": "hall"}})).await;
    let rules = told["status"]["resourceRules"].to_string();
    assert!(!rules.contains("secrets") && rules.contains("nodes"), "{rules}");
    cluster.running.shut_down().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn several_objects_at_once_are_decided_one_by_one() {
    let cluster = Cluster::start().await;
    let admin = cluster.admin().await;
    for name in ["lab", "hall"] {
        let namespace =
            json!({"apiVersion": "v1", "kind": "Namespace", "metadata": {"name": name}});
        assert_eq!(send(&admin, "POST", "/api/v1/namespaces", namespace).await.0, 201);
    }
    let ada = user(&cluster, "ada", "developer", json!(["lab"])).await;
    let of = |namespace: &str| {
        let mut task = task("t");
        task["metadata"]["namespace"] = namespace.into();
        task["spec"]["run"] = json!({"container": {"image": "busybox", "network": "None"}});
        task
    };
    let revision = cluster.running.context().store.revision().to_string();
    let body =
        json!({"revision": revision, "requests": [{"create": of("lab")}, {"create": of("hall")}]});
    let (code, told) = send(&ada, "POST", &format!("{G}/transaction"), body).await;
    assert_eq!(code, 200);
    let refusals = told["refusals"].as_array().unwrap();
    assert_eq!(
        (refusals.len(), &refusals[0]["index"], &refusals[0]["status"]["code"]),
        (1, &1.into(), &403.into())
    );
    assert_eq!(get(&admin, &format!("{G}/namespaces/lab/tasks/t")).await.0, 404);
    let path = format!("{G}/plan");
    let plan = |namespace| json!({"objects": [of(namespace)]});
    assert_eq!(send(&ada, "POST", &path, plan("lab")).await.0, 200);
    assert_eq!(refusal(&send(&ada, "POST", &path, plan("hall")).await), (403, "Forbidden"));
    cluster.running.shut_down().await.unwrap();
}
