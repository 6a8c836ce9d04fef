"""The stock Kubernetes client of PyPI against a controller with one node: every line that it prints is one thing that works."""

import threading
import time

from kubernetes import client, config, dynamic, watch
from kubernetes.stream import stream

DEADLINE = 60
GROUP, VERSION = "muster.dev", "v1alpha1"


def until(what, holds):
    end = time.monotonic() + DEADLINE
    while not holds():
        if time.monotonic() > end:
            raise SystemExit(f"{what}: too late")
        time.sleep(0.05)


def task(name, *command):
    return {
        "apiVersion": f"{GROUP}/{VERSION}",
        "kind": "Task",
        "metadata": {"name": name, "labels": {"app": name}},
        "spec": {"run": {"process": {"command": list(command)}}, "gracePeriodSeconds": 0},
    }


def custom_objects():
    api = client.CustomObjectsApi()
    at = (GROUP, VERSION, "default", "tasks")
    api.create_namespaced_custom_object(*at, task("custom", "sleep", "1000"))
    changed = api.patch_namespaced_custom_object(*at, "custom", {"spec": {"priority": 3}})
    assert changed["spec"]["priority"] == 3
    try:
        api.create_namespaced_custom_object(*at, task("custom", "sleep", "1000"))
        raise SystemExit("it was created twice")
    except client.ApiException as error:
        assert error.status == 409, error
    until("it runs", lambda: api.get_namespaced_custom_object(*at, "custom").get("status", {}).get("phase") == "Running")
    found = api.list_namespaced_custom_object(*at, label_selector="app=custom", limit=1)
    assert [item["metadata"]["name"] for item in found["items"]] == ["custom"]


def dynamic_client():
    dyn = dynamic.DynamicClient(client.ApiClient())
    tasks = dyn.resources.get(api_version=f"{GROUP}/{VERSION}", kind="Task")
    body = task("dynamic", "sh", "-c", "echo from python; exec sleep 1000")
    applied = tasks.server_side_apply(body=body, namespace="default", name="dynamic", field_manager="python")
    assert applied.metadata.managedFields[0].manager == "python", applied
    seen = []
    for event in tasks.watch(namespace="default", name="dynamic", timeout=DEADLINE):
        seen.append(event["type"])
        if event["object"].status and event["object"].status.phase == "Running":
            break
    assert seen[0] == "ADDED" and "MODIFIED" in seen or len(seen) == 1, seen


def core():
    v1 = client.CoreV1Api()
    assert [node.metadata.name for node in v1.list_node().items] == ["cloud-1"]
    pods = v1.list_namespaced_pod("default", field_selector="spec.nodeName=cloud-1", limit=1)
    assert len(pods.items) == 1 and pods.metadata._continue
    rest = v1.list_namespaced_pod("default", limit=10, _continue=pods.metadata._continue)
    assert len(rest.items) == 1 and rest.items[0].status.container_statuses[0].ready
    until("a log", lambda: v1.read_namespaced_pod_log("dynamic", "default") == "from python\n")


def programs():
    """Programs in a task: what they write, how they end, and a mebibyte through one and back."""
    v1 = client.CoreV1Api()

    def run(*command, **how):
        how = {"stdin": False, "stdout": True, "stderr": True, "tty": False, **how}
        return stream(v1.connect_get_namespaced_pod_exec, "dynamic", "default", command=list(command), **how)

    assert run("sh", "-c", "echo out; echo err >&2") in ("out\nerr\n", "err\nout\n")
    ended = run("sh", "-c", "echo some; exit 7", _preload_content=False)
    ended.run_forever(timeout=DEADLINE)
    assert (ended.read_stdout(), ended.returncode) == ("some\n", 7), ended.returncode

    sent = "".join(f"{n:07}\n" for n in range(1 << 17))
    cat = run("cat", stdin=True, _preload_content=False)
    came, at, end = "", 0, time.monotonic() + DEADLINE
    while len(came) < len(sent):
        if at < len(sent):
            cat.write_stdin(sent[at:at + 32768])
            at += 32768
        cat.update(timeout=0 if at < len(sent) else 1)
        if cat.peek_stdout():
            came += cat.read_stdout()
        assert time.monotonic() < end, len(came)
    assert came == sent
    cat.close()
    try:
        stream(v1.connect_get_namespaced_pod_exec, "none", "default", command=["true"], stdout=True)
        raise SystemExit("there is no such pod")
    except client.ApiException as error:
        assert "not found" in str(error), error


def watch_goes_on():
    """A watch that ends is taken up where it was: nothing is missed, nothing comes twice."""
    v1 = client.CoreV1Api()
    body = {"metadata": {"name": "counted"}, "data": {"n": "0"}}
    first = v1.create_namespaced_config_map("default", body)
    ended, done = threading.Event(), threading.Event()

    def write():
        for n in range(1, 41):
            if n == 40:
                ended.wait(DEADLINE)  # There is something left for another watch.
            v1.patch_namespaced_config_map("counted", "default", {"data": {"n": str(n)}})
            time.sleep(0.05)
        done.set()

    threading.Thread(target=write, daemon=True).start()
    numbers, revision, ends = [], first.metadata.resource_version, 0
    while len(numbers) < 40:
        stream = watch.Watch().stream(
            v1.list_namespaced_config_map, "default", field_selector="metadata.name=counted",
            resource_version=revision, timeout_seconds=1,
        )
        for event in stream:
            numbers.append(int(event["object"].data["n"]))
            revision = event["object"].metadata.resource_version
            if len(numbers) == 40:
                break
        ends += 1
        ended.set()
    assert numbers == list(range(1, 41)), numbers
    assert done.wait(DEADLINE) and ends > 1, ends


config.load_kube_config()
for what in (custom_objects, dynamic_client, core, programs, watch_goes_on):
    what()
    print(what.__name__, flush=True)
