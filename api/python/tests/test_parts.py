"""The parts that need no other side: kubeconfig, quantities, specs, queues, the state file."""

from __future__ import annotations

import argparse
import ast
import base64
import json
import re
import types
from pathlib import Path

import pytest

import muster
from muster import _inbox as inbox
from muster import kubeconfig, program
from muster._backoff import Backoff
from muster._pb import executor as executor_pb
from muster._pb import framework as framework_pb
from muster._seen import Seen, Verdict
from muster._state_file import StateFile
from muster._yaml import YamlError, parse
from muster.model import FrameworkInfo, TaskStatus
from muster.quantity import cpu_millis, memory_bytes
from muster.task import plain


ROOT = Path(__file__).parent.parent


def encoded(text):
    return base64.b64encode(text.encode()).decode()


def a_config(server="https://127.0.0.1:7443", **user):
    user = user or {"client-certificate-data": encoded("cert"), "client-key-data": encoded("key")}
    return {
        "current-context": "lab",
        "clusters": [{"name": "c", "cluster": {"server": server, "certificate-authority-data": encoded("ca")}}],
        "users": [{"name": "u", "user": user}],
        "contexts": [{"name": "lab", "context": {"cluster": "c", "user": "u", "namespace": "hall"}}],
    }


def written(path, config):
    path.write_text(json.dumps(config))
    return path


def test_a_kubeconfig_gives_address_and_credentials(tmp_path):
    target = kubeconfig.load(written(tmp_path / "config", a_config()), {})
    assert (target.address, target.namespace) == ("127.0.0.1:7443", "hall")
    assert (target.certificate_authority, target.client_certificate, target.client_key) == (b"ca", b"cert", b"key")
    assert "key'" not in repr(target), "keys do not get into logs"


def test_a_token_stands_for_a_certificate(tmp_path):
    target = kubeconfig.load(written(tmp_path / "config", a_config(token="musteru1.ab.cd")), {})
    assert (target.token, target.client_certificate, target.client_key) == ("musteru1.ab.cd", None, None)
    assert "musteru1" not in repr(target), "tokens do not get into logs"


def test_credentials_may_be_files_beside_the_kubeconfig(tmp_path):
    (tmp_path / "k.pem").write_text("key of a file")
    config = a_config(**{"client-certificate-data": encoded("cert"), "client-key": "k.pem"})
    assert kubeconfig.load(written(tmp_path / "config", config), {}).client_key == b"key of a file"


def test_argument_then_muster_config_then_kubeconfig(tmp_path):
    paths = {}
    for port, name in enumerate(("argument", "muster", "kube"), 1):
        paths[name] = str(written(tmp_path / name, a_config(f"https://h:{port}")))
    environ = {"MUSTER_CONFIG": paths["muster"], "KUBECONFIG": f"/nowhere:{paths['kube']}"}
    assert kubeconfig.load(paths["argument"], environ).address == "h:1"
    assert kubeconfig.load(None, environ).address == "h:2"
    assert kubeconfig.load(None, {**environ, "MUSTER_CONFIG": ""}).address == "h:3"


@pytest.mark.parametrize(
    ("config", "complaint"),
    [
        (a_config("http://h:1"), "https://host:port"),
        (a_config("https://h:x"), "https://host:port"),
        (a_config(tokenFile="t"), "tokenFile is not enough"),
        (a_config(**{"client-certificate-data": "!", "client-key-data": "a"}), "not base64"),
        ({**a_config(), "current-context": "home"}, "'home'"),
        ({**a_config(), "users": []}, "'u'"),
    ],
)
def test_a_bad_kubeconfig_is_told_with_its_name(tmp_path, config, complaint):
    with pytest.raises(muster.ConfigError, match=complaint) as error:
        kubeconfig.load(written(tmp_path / "bad.json", config), {})
    assert "bad.json" in str(error.value)


def test_kubectls_ways_of_writing_yaml():
    text = """---
# written by hand
clusters:
  - cluster:
      server: "https://[::1]:7443"   # with a comment
    name: 'it''s'
contexts: []
preferences: {}
users:
- name: "caf\\u00e9"
  user:
    client-key-data: a+/=
nothing:
"""
    assert parse(text) == {
        "clusters": [{"cluster": {"server": "https://[::1]:7443"}, "name": "it's"}],
        "contexts": [],
        "preferences": {},
        "users": [{"name": "café", "user": {"client-key-data": "a+/="}}],
        "nothing": None,
    }


@pytest.mark.parametrize(
    "text",
    ["a: &x 1", "a: |\n  b", "a: {b: c}", "a: !t b", "a: 'b", "a: 1\na: 2", "a: 1\n  b: 2", "\ta: 1", "a", "- a\nb: c"],
)
def test_other_yaml_is_refused(text):
    with pytest.raises(YamlError, match="line "):
        parse(text)


def test_quantities_are_the_controllers():
    assert [cpu_millis(amount) for amount in ("500m", "1.5", 2, 0.5, "0.0001")] == [500, 1500, 2000, 500, 1]
    assert [memory_bytes(amount) for amount in ("64Mi", "2G", 100, "1.5Ki")] == [64 << 20, 2 * 10**9, 100, 1536]
    for wrong in ("2core", "", "-1", "1e999", "nan"):
        with pytest.raises(ValueError, match="not a quantity of cpu"):
            cpu_millis(wrong)
    for wrong in ("128m", "64MiB", "x", "-1"):
        with pytest.raises(ValueError, match="not a quantity of bytes"):
            memory_bytes(wrong)


def test_specs_are_what_a_manifest_says():
    task = muster.container("a/b", ["run"], memory="1Gi", sensors=["gps:Fix"], restart_policy="OnFailure")
    assert task.spec == {
        "restartPolicy": "OnFailure",
        "resources": {"memory": str(1 << 30), "sensors": ["gps:Fix"]},
        "run": {"container": {"image": "a/b", "command": ["run"]}},
    }
    work = muster.executor("driver", data={"goal": (1, 2)}, actuators=["base:Drive"], resources={"pids": 5})
    assert work.spec["run"] == {"executor": {"task": "driver", "data": {"goal": (1, 2)}}}
    assert work.spec["resources"] == {"pids": 5, "actuators": ["base:Drive"]}
    assert plain(work.spec)["run"]["executor"]["data"] == {"goal": [1, 2]}


@pytest.mark.parametrize(
    ("value", "place"),
    [({"a": [float("nan")]}, r"spec\.a\[0\]"), ({"a": b""}, r"spec\.a"), ({1: 2}, "key 1"), ({"n": 2**60}, r"spec\.n")],
)
def test_what_json_has_not_is_told_with_its_place(value, place):
    with pytest.raises(ValueError, match=place):
        plain(value)


@pytest.mark.parametrize(
    ("ours", "theirs", "prefix", "has_zero"),
    [
        (muster.NodeKind, framework_pb.NodeKind, "NODE_KIND", False),
        (muster.Cost, framework_pb.Cost, "COST", False),
        (muster.TaskState, framework_pb.TaskState, "TASK_STATE", False),
        (muster.RescindReason, framework_pb.RescindReason, "RESCIND_REASON", True),
        (muster.RefusalReason, framework_pb.RefusalReason, "REFUSAL_REASON", True),
        (muster.ExecutorTaskState, executor_pb.TaskState, "TASK_STATE", False),
    ],
)
def test_enums_are_the_contracts(ours, theirs, prefix, has_zero):
    contract = {name[len(prefix) + 1 :]: number for name, number in theirs.items() if number or has_zero}
    assert {member.name: member.value for member in ours} == contract


def test_a_clicked_point_is_a_position():
    clicked = types.SimpleNamespace(
        header=types.SimpleNamespace(frame_id="/hall"), point=types.SimpleNamespace(x=1, y=2.5, z=0)
    )
    assert muster.position_from_clicked_point(clicked, radius=5) == muster.Position(1, 2.5, map="hall", radius=5)


def test_a_position_on_the_command_line():
    assert program.position("3, -4.5") == muster.Position(3, -4.5)
    assert program.position("1,2,3").z == 3
    for wrong in ("", "1", "1,2,3,4", "1,x", "1,nan"):
        with pytest.raises(argparse.ArgumentTypeError, match="as in"):
            program.position(wrong)


def test_backoff_doubles_up_to_its_most_and_half_of_it_is_chance():
    backoff = Backoff(first=1, most=5, chance=lambda: 1.0)
    assert [backoff.next() for _ in range(5)] == [1, 2, 4, 5, 5]
    backoff.reset()
    assert backoff.next() == 1
    assert Backoff(first=1, chance=lambda: 0.0).next() == 0.5


def test_seen_forgets_the_longest_silent_task_first():
    seen = Seen(most=2)
    for task in ("a", "b", "a", "c"):
        seen.judge(task, 1)
    assert seen.judge("a", 1) is Verdict.DROP
    assert seen.judge("b", 1) is Verdict.DELIVER
    seen.acknowledged("b", 1)
    assert seen.judge("b", 1) is Verdict.ACKNOWLEDGE_AGAIN


def status(task, version):
    return inbox.Updated(TaskStatus(task, "", "", muster.TaskState.RUNNING, "", "", None, 1, version))


def taken(box, count):
    return [box.take() for _ in range(count)]


def test_what_is_overtaken_takes_no_place_in_the_inbox():
    box = inbox.Inbox()
    box.put(status("a", 1))
    box.put(inbox.NodeLost("n", "first"))
    box.put(status("b", 1))
    box.put(status("a", 2))
    box.put(inbox.NodeLost("n", "second"))
    assert taken(box, 3) == [status("a", 2), inbox.NodeLost("n", "second"), status("b", 1)]
    box.put(status("a", 3))
    assert box.take() == status("a", 3)


def test_a_flapping_connection_takes_no_place_either():
    box = inbox.Inbox()
    for _ in range(100):
        box.put(inbox.Lost())
        box.put(inbox.Reregistered())
    assert taken(box, 2) == [inbox.Lost(), inbox.Reregistered()]
    assert box.close() == []


def test_messages_are_bounded_by_their_bytes():
    box = inbox.Inbox(most_message_bytes=10)
    for data in (b"123456", b"too much", b"1234"):
        box.put(inbox.Message("e", "n", data))
    assert [event.data for event in taken(box, 2)] == [b"123456", b"1234"]
    box.put(inbox.Message("e", "n", b"1234567890"))
    assert box.take().data == b"1234567890"


def test_the_state_file_is_written_whole_and_for_one_framework(tmp_path):
    info = FrameworkInfo(name="deliver")
    file = StateFile(tmp_path / "state")
    assert file.read(info) == ""
    file.write(info, "f-1")
    file.write(info, "f-2")
    assert file.read(info) == "f-2"
    assert [path.name for path in tmp_path.iterdir()] == ["state"]
    with pytest.raises(muster.ConfigError, match="hall/deliver"):
        file.read(FrameworkInfo(name="deliver", namespace="hall"))
    (tmp_path / "state").write_text("{}")
    with pytest.raises(muster.ConfigError, match="not a framework's state"):
        file.read(info)


@pytest.mark.parametrize("file", sorted(ROOT.glob("src/muster/*.py")) + sorted(ROOT.glob("examples/*.py")), ids=str)
def test_the_oldest_python_that_is_promised_reads_it(file):
    promised = re.search(r'requires-python = ">=3\.(\d+)"', (ROOT / "pyproject.toml").read_text())
    ast.parse(file.read_text(), file.name, feature_version=(3, int(promised.group(1))))
