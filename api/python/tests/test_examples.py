"""The examples as programs, against a controller that the test plays."""

from __future__ import annotations

import signal
import subprocess
import sys
from pathlib import Path

import pytest

from fake_controller import PATIENCE
from muster._pb import framework as pb

EXAMPLES = Path(__file__).parent.parent / "examples"


@pytest.fixture
def run(controller):
    programs = []

    def run(example, *arguments):
        command = [sys.executable, str(EXAMPLES / example), "--kubeconfig", str(controller.kubeconfig), *arguments]
        program = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        programs.append(program)
        return program

    yield run
    for program in programs:
        program.kill()
        program.communicate()


def offer(id, node, score, **more):
    fields = {"kind": pb.NODE_KIND_ROBOT, "actuators": ["base:Drive"], **more}
    free = pb.Compute(cpu_millis=2000, memory_bytes=1 << 30)
    return pb.Offer(id=id, node=node, score=score, free=free, **fields)


def offers(session, *several):
    session.send(offers=pb.Offers(offers=several))


def update(session, task, version, state, name="x"):
    session.send(update=pb.Update(task=task, name=name, node="n", state=f"TASK_STATE_{state}", version=version))


def launched(session, task):
    """Expects a launch, and answers it."""
    accept = session.expect("accept")
    session.answer(launched=[pb.Launched(name=accept.launches[0].name, task=task, node="n")])
    return accept


def test_deliver_goes_to_each_goal_with_the_nearest_robot(controller, run):
    program = run("deliver.py", "--goal", "3,4", "--goal=-1,2", "--radius", "20")
    session = controller.accept()
    subscribe = session.subscribed()
    assert (subscribe.position.x, subscribe.position.radius) == (3, 20)
    assert subscribe.filter.any_actuator
    offers(session, offer("far", "tb-2", 9.0), offer("held", "tb-3", 0.5, actuators=[]), offer("near", "tb-1", 2.0))
    assert sorted(session.expect("decline").offers) == ["far", "held"]
    session.answer()
    accept = launched(session, "t-1")
    assert list(accept.offers) == ["near"]
    assert accept.launches[0].spec["run"]["process"]["env"][0]["value"] == "3.0"
    session.expect("suppress")
    session.answer()
    update(session, "t-1", 1, "FAILED")
    # The acknowledgement is written before or after what the callback asked for.
    assert {session.call().WhichOneof("call") for _ in range(2)} == {"acknowledge", "revive"}
    offers(session, offer("again", "tb-1", 2.0))
    launched(session, "t-2")
    session.expect("suppress")
    update(session, "t-2", 2, "SUCCEEDED")
    calls = [session.call() for _ in range(3)]
    moved = next(call for call in calls if call.HasField("set_position"))
    assert moved.set_position.position.x == -1
    offers(session, offer("third", "tb-1", 2.0))
    launched(session, "t-3")
    session.expect("suppress")
    update(session, "t-3", 3, "SUCCEEDED")
    while not (call := session.call()).HasField("teardown"):
        assert call.HasField("acknowledge")
    for unanswered in range(1, int(call.id) + 1):
        session.send(answer=pb.Answer(id=str(unanswered)))
    session.expect_end()
    session.end()
    out, err = program.communicate(timeout=PATIENCE)
    assert (program.returncode, err) == (0, ""), err
    assert "goal 3.0,4.0: tb-1, 2.00 m away" in out


def test_an_interrupted_deliver_tears_its_framework_down(controller, run):
    program = run("deliver.py", "--goal", "3,4")
    session = controller.accept()
    session.subscribed()
    assert program.stdout.readline() == "registered as f-1\n"
    program.send_signal(signal.SIGINT)
    session.expect("teardown")
    session.answer()
    session.expect_end()
    session.end()
    out, err = program.communicate(timeout=PATIENCE)
    assert (program.returncode, err) == (130, "")


def test_patrol_fills_three_posts_and_fills_them_again(controller, run, tmp_path):
    state = str(tmp_path / "state")
    program = run("patrol.py", "--state-file", state)
    session = controller.accept()
    session.subscribed()
    cloud = {"kind": pb.NODE_KIND_CLOUD, "actuators": []}
    robots = [offer("a", "tb-1", 1), offer("b", "tb-2", 2), offer("c", "tb-3", 3)]
    offers(session, *robots, offer("d", "cloud-1", 0, **cloud))
    roles = []
    for task in ("t-1", "t-2", "t-3"):
        accept = launched(session, task)
        roles.append((accept.offers[0], accept.launches[0].name.rsplit("-", 1)[0]))
    assert roles == [("a", "patrol-drive-1"), ("b", "patrol-drive-2"), ("d", "patrol-recognise")]
    assert list(session.expect("decline").offers) == ["c"]
    session.answer()
    session.expect("suppress")
    session.answer()
    update(session, "t-2", 1, "FAILED")
    assert {session.call().WhichOneof("call") for _ in range(2)} == {"acknowledge", "revive"}
    offers(session, offer("e", "tb-3", 3))
    again = launched(session, "t-4")
    assert again.launches[0].name.startswith("patrol-drive-2-")
    session.expect("suppress")

    program.send_signal(signal.SIGTERM)
    for unanswered in range(1, 20):
        session.send(answer=pb.Answer(id=str(unanswered)))
    session.expect_end()
    session.end()
    _, err = program.communicate(timeout=PATIENCE)
    assert (program.returncode, err) == (130, ""), err

    # The next patrol finds its tasks, and fills only the post that is vacant.
    program = run("patrol.py", "--state-file", state)
    session = controller.accept()
    assert session.subscribed(reregistered=True).framework_id == "f-1"
    session.expect("reconcile")
    session.expect("revive")
    update(session, "t-1", 5, "RUNNING", name="patrol-drive-1-0")
    update(session, "t-9", 5, "RUNNING", name="patrol-drive-1-1")
    calls = [session.call() for _ in range(4)]
    assert [call.kill.task for call in calls if call.HasField("kill")] == ["t-9"]
    assert [call.acknowledge.task for call in calls if call.HasField("acknowledge")] == ["t-1", "t-9"]
    program.send_signal(signal.SIGINT)
    for unanswered in range(1, 20):
        session.send(answer=pb.Answer(id=str(unanswered)))
    session.expect_end()
    session.end()
    program.communicate(timeout=PATIENCE)
    assert program.returncode == 130


@pytest.mark.parametrize("example", ["deliver.py", "patrol.py"])
def test_a_missing_kubeconfig_is_an_error_and_no_traceback(example, tmp_path):
    command = [sys.executable, str(EXAMPLES / example), "--kubeconfig", str(tmp_path / "none")]
    if example == "deliver.py":
        command += ["--goal", "1,2"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE)
    assert done.returncode == 1
    assert done.stderr.startswith("error: there is no kubeconfig"), done.stderr
