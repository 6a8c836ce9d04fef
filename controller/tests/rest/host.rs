//! Tasks that reach into their nodes are written, changed and entered only by who has access to hosts.

use kube::Client;
use serde_json::{Value, json};

use super::support::*;

const SETS: &str = "/apis/muster.dev/v1alpha1/namespaces/default/tasksets";
const APPLICATIONS: &str = "/apis/muster.dev/v1alpha1/namespaces/default/applications";

fn container() -> Value {
    json!({"container": {"image": "busybox", "network": "Bridge"}})
}

fn process() -> Value {
    json!({"process": {"command": ["/bin/true"], "user": "nobody"}})
}

fn of(kind: &str, name: &str, spec: Value) -> Value {
    json!({"apiVersion": "muster.dev/v1alpha1", "kind": kind, "metadata": {"name": name}, "spec": spec})
}

fn set(run: Value) -> Value {
    of("TaskSet", "s", json!({"replicas": 0, "template": {"spec": {"run": run}}}))
}

/// The fields that a refusal names.
fn fields(answer: &(u16, Value)) -> Vec<&str> {
    assert_eq!(refusal(answer), (422, "Invalid"), "{}", answer.1);
    let causes = answer.1["details"]["causes"].as_array().unwrap().iter();
    causes.map(|cause| cause["field"].as_str().unwrap()).collect()
}

async fn developer(cluster: &Cluster) -> Client {
    cluster.give("ada", "developer", json!(["default"])).await;
    cluster.user("ada").await
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn who_has_no_access_to_hosts_writes_nothing_that_reaches_into_them() {
    let cluster = Cluster::start().await;
    let ada = developer(&cluster).await;

    // However it is written.
    let run = json!({"container": {"image": "busybox", "mounts": [{"hostPath": "/etc", "mountPath": "/x"}]}});
    let refused = send(&ada, "POST", TASKS, of("Task", "t", json!({"run": run}))).await;
    assert_eq!(
        fields(&refused),
        ["spec.run.container.mounts[0].hostPath", "spec.run.container.network"]
    );
    let told = refused.1["message"].as_str().unwrap();
    assert!(
        told.contains("User \"ada\" has no access to hosts in the namespace \"default\"")
            && told.contains("`network: Bridge`"),
        "{told}"
    );
    let made = of("Task", "t", json!({"run": process()}));
    let place = ["spec.run.process"];
    assert_eq!(fields(&send(&ada, "POST", TASKS, made.clone()).await), place);
    assert_eq!(
        fields(&send(&ada, "POST", &format!("{TASKS}?dryRun=All"), made.clone()).await),
        place
    );
    let apply = format!("{TASKS}/t?fieldManager=x");
    let yaml = "application/apply-patch+yaml";
    assert_eq!(fields(&send_as(&ada, "PATCH", &apply, yaml, made.to_string()).await), place);
    let (_, plan) = send(&ada, "POST", &format!("{G}/plan"), json!({"objects": []})).await;
    let whole = json!({"revision": plan["revision"], "requests": [{"create": made}]});
    let (_, whole) = send(&ada, "POST", &format!("{G}/transaction"), whole).await;
    assert_eq!(
        whole["refusals"][0]["status"]["details"]["causes"][0]["field"], place[0],
        "{whole}"
    );
    // Whatever it stands in.
    assert_eq!(
        fields(&send(&ada, "POST", SETS, set(process())).await),
        ["spec.template.spec.run.process"]
    );
    let part = |name: &str, run: Value| json!({"name": name, "template": {"spec": {"run": run}}});
    let parts = json!([part("a", container()), part("b", process())]);
    let scales = json!({"nodes": ["laptop"]});
    let application =
        of("Application", "a", json!({"home": "rover", "scales": scales, "parts": parts}));
    let refused = send(&ada, "POST", APPLICATIONS, application).await;
    assert_eq!(fields(&refused), ["spec.parts[1].template.spec.run.process"]);

    // What has all that it needs in itself is hers to run.
    let made = of("Task", "t", json!({"run": container()}));
    assert_eq!(send(&ada, "POST", TASKS, made).await.0, 201);
    let made = send(&ada, "POST", SETS, set(container())).await;
    assert_eq!(made.0, 201, "{}", made.1);
    // Nor does it become anything else.
    let patch =
        json!({"spec": {"template": {"spec": {"run": {"container": {"network": "Host"}}}}}});
    let place = ["spec.template.spec.run.container.network"];
    assert_eq!(fields(&send(&ada, "PATCH", &format!("{SETS}/s"), patch.clone()).await), place);
    let (_, mut present) = get(&ada, &format!("{SETS}/s")).await;
    present["spec"]["template"]["spec"]["run"]["container"]["network"] = "Host".into();
    // Its status is being written meanwhile: the newest is meant.
    present["metadata"].as_object_mut().unwrap().remove("resourceVersion");
    assert_eq!(fields(&send(&ada, "PUT", &format!("{SETS}/s"), present).await), place);

    // With it she may, from the next request on.
    let path = format!("{G}/accesses/ada");
    let admin = cluster.admin().await;
    let given = send(&admin, "PATCH", &path, json!({"spec": {"hostAccess": true}})).await;
    assert_eq!(given.0, 200, "{}", given.1);
    assert_eq!(send(&ada, "PATCH", &format!("{SETS}/s"), patch).await.0, 200);
    let made = of("Task", "u", json!({"run": process()}));
    assert_eq!(send(&ada, "POST", TASKS, made).await.0, 201);
    cluster.running.shut_down().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn what_others_let_in_is_scaled_and_deleted_and_not_changed_or_entered() {
    let cluster = Cluster::start().await;
    let admin = cluster.admin().await;
    let ada = developer(&cluster).await;
    assert_eq!(send(&admin, "POST", SETS, set(process())).await.0, 201);
    assert_eq!(
        send(&admin, "POST", TASKS, of("Task", "t", json!({"run": process()}))).await.0,
        201
    );

    let path = format!("{SETS}/s");
    let label = json!({"metadata": {"labels": {"team": "red"}}, "spec": {"minReadySeconds": 3}});
    assert_eq!(send(&ada, "PATCH", &path, label).await.0, 200);
    let scale = json!({"spec": {"replicas": 2}});
    assert_eq!(send(&ada, "PATCH", &format!("{path}/scale"), scale).await.0, 200);
    let command =
        json!({"spec": {"template": {"spec": {"run": {"process": {"command": ["/bin/sh"]}}}}}});
    assert_eq!(
        fields(&send(&ada, "PATCH", &path, command).await),
        ["spec.template.spec.run.process"]
    );

    let enter =
        |name: &str| format!("/api/v1/namespaces/default/pods/{name}/exec?command=sh&stdout=true");
    let refused = get(&ada, &enter("t")).await;
    assert_eq!(refusal(&refused), (403, "Forbidden"));
    let told = refused.1["message"].as_str().unwrap();
    assert!(told.contains("spec.run.process") && told.contains("hostAccess"), "{told}");
    assert_eq!(refusal(&get(&admin, &enter("t")).await), (400, "BadRequest"), "it does not run");

    for path in [path, format!("{TASKS}/t")] {
        assert_eq!(send(&ada, "DELETE", &path, Value::Null).await.0, 200, "{path}");
    }
    cluster.running.shut_down().await.unwrap();
}
