"""An executor, against an agent that the test plays."""

from __future__ import annotations

import pytest
from google.protobuf.struct_pb2 import Struct

import muster
from fake_agent import FakeAgent
from fake_controller import PATIENCE
from muster import ExecutorTaskState as State
from muster._pb import executor as pb
from recorder import ExecutorRecorder


@pytest.fixture
def agent(tmp_path):
    agent = FakeAgent(tmp_path)
    yield agent
    agent.close()


@pytest.fixture
def executor(agent):
    """A driver that runs and is registered, its recorder, and the agent's end of its connection."""
    recorder = ExecutorRecorder()
    driver = muster.ExecutorDriver(recorder, agent.environ())
    driver.start()
    connection = agent.accept()
    register = connection.registered()
    assert (register.token, list(register.tasks), list(register.unacknowledged)) == ("secret", [], [])
    (info,) = recorder.heard.expect("registered")
    assert info == muster.ExecutorInfo("e-1", "default", "deliver", "turtlebot-1", "f-1")
    yield driver, recorder.heard, connection
    driver.abort()
    assert driver.join(PATIENCE) in (muster.DriverState.STOPPED, muster.DriverState.ABORTED)


def a_launch(task="t-1", **data):
    made = Struct()
    made.update(data)
    return pb.Launch(task=task, name="drive", data=made)


def launched(heard, connection, task="t-1"):
    connection.send(launch=a_launch(task))
    assert heard.expect("launch_task")[0].task_id == task


def test_a_launch_brings_its_data_and_its_lease(executor):
    _, heard, connection = executor
    launch = a_launch(goal=[3, 4], say="走廊 🤖")
    launch.lease.CopyFrom(pb.Lease(node="turtlebot-1", group="body", epoch=7))
    connection.send(launch=launch)
    (task,) = heard.expect("launch_task")
    assert (task.task_id, task.name, task.data) == ("t-1", "drive", {"goal": [3, 4], "say": "走廊 🤖"})
    assert str(task.lease) == "turtlebot-1.body:7"
    connection.send(kill=pb.Kill(task="t-1", grace_period_ms=1500))
    assert heard.expect("kill_task") == ("t-1", 1.5)


def test_updates_are_said_until_they_are_acknowledged(executor, agent):
    driver, heard, connection = executor
    launched(heard, connection, "t-1")
    launched(heard, connection, "t-2")
    driver.send_status_update("t-1", State.RUNNING)
    driver.send_status_update("t-2", State.RUNNING)
    first, second = connection.expect("status_update"), connection.expect("status_update")
    assert (first.sequence, second.sequence) == (1, 2)
    connection.send(acknowledged=pb.Acknowledged(sequence=1))
    driver.send_status_update("t-1", State.FAILED, "no way", exit_code=3)
    last = connection.expect("status_update")
    assert (last.state, last.message, last.exit_code) == (pb.TASK_STATE_FAILED, "no way", 3)
    connection.send(message=pb.Message(data=b"so far"))
    heard.expect("framework_message")  # So the acknowledgement was read.

    agent.close()
    heard.expect("disconnected")
    driver.send_status_update("t-2", State.SUCCEEDED, exit_code=0)
    with pytest.raises(muster.Disconnected):
        driver.send_framework_message(b"lost")
    agent.listen()
    again = agent.accept()
    register = again.registered(reregistered=True)
    heard.expect("reregistered")
    assert list(register.tasks) == []
    assert [(update.task, update.state) for update in register.unacknowledged] == [
        ("t-1", pb.TASK_STATE_FAILED),
        ("t-2", pb.TASK_STATE_SUCCEEDED),
    ]


def test_running_tasks_are_named_after_a_reconnect_and_a_second_launch_is_none(executor, agent):
    driver, heard, connection = executor
    launched(heard, connection)
    connection.close()
    heard.expect("disconnected")
    again = agent.accept()
    assert list(again.registered(reregistered=True).tasks) == ["t-1"]
    heard.expect("reregistered")
    again.send(launch=a_launch("t-1"))
    launched(heard, again, "t-2")


def test_a_launch_that_is_said_again_hears_the_end_again(executor):
    driver, heard, connection = executor
    launched(heard, connection)
    driver.send_status_update("t-1", State.SUCCEEDED)
    connection.expect("status_update")
    connection.send(launch=a_launch("t-1"))
    assert connection.expect("status_update").state == pb.TASK_STATE_SUCCEEDED


def test_the_first_end_of_a_task_counts(executor):
    driver, heard, connection = executor
    launched(heard, connection)
    assert driver.send_status_update("t-1", State.KILLED)
    assert not driver.send_status_update("t-1", State.SUCCEEDED)
    assert not driver.send_status_update("t-9", State.RUNNING)
    assert connection.expect("status_update").state == pb.TASK_STATE_KILLED


def test_messages_of_four_mebibytes(executor):
    driver, heard, connection = executor
    data = b"\x00\xff" * (2 << 20)
    driver.send_framework_message(data)
    assert connection.expect("message").data == data
    connection.send(message=pb.Message(data=data))
    assert heard.expect("framework_message") == (data,)
    with pytest.raises(ValueError):
        driver.send_framework_message(data + b"x")


def test_shutdown_ends_when_the_agent_has_the_last_updates(agent):
    class Ending(ExecutorRecorder):
        def shutdown(self, driver, grace_seconds):
            super().shutdown(driver, grace_seconds)
            driver.send_status_update("t-1", State.KILLED)

    recorder = Ending()
    driver = muster.ExecutorDriver(recorder, agent.environ())
    driver.start()
    connection = agent.accept()
    connection.registered()
    recorder.heard.expect("registered")
    launched(recorder.heard, connection)
    connection.send(shutdown=pb.Shutdown(grace_period_ms=60_000))
    assert recorder.heard.expect("shutdown") == (60,)
    update = connection.expect("status_update")
    connection.send(acknowledged=pb.Acknowledged(sequence=update.sequence))
    assert driver.join(PATIENCE) is muster.DriverState.STOPPED
    connection.expect_end()


@pytest.mark.parametrize("noise", [b"\xff\xff\xff\xff", b"\x00\x00\x00\x02\xff\xff", b"GET / HTTP/1.1\r\n\r\n"])
def test_an_agent_that_speaks_something_else_is_an_error(agent, noise):
    recorder = ExecutorRecorder()
    driver = muster.ExecutorDriver(recorder, agent.environ())
    driver.start()
    connection = agent.accept()
    connection.expect("register")
    connection.send_raw(noise)
    recorder.heard.expect("error")
    assert driver.join(PATIENCE) is muster.DriverState.ABORTED


def test_an_exception_of_a_callback_comes_out_of_join(agent):
    class Broken(muster.Executor):
        def launch_task(self, driver, task):
            raise LookupError("a bug")

    driver = muster.ExecutorDriver(Broken(), agent.environ())
    driver.start()
    connection = agent.accept()
    connection.registered()
    connection.send(launch=a_launch())
    with pytest.raises(LookupError):
        driver.join(PATIENCE)


def test_the_environment_is_the_agents():
    with pytest.raises(muster.ConfigError, match="MUSTER_EXECUTOR_TOKEN"):
        muster.ExecutorDriver(muster.Executor(), {"MUSTER_EXECUTOR_SOCKET": "/s"})
