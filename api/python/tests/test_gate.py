"""The gate's client against a gate that says what the test says."""

import socket
import threading

import pytest

import muster
from muster import _frames
from muster._pb import gate as pb


class FakeGate:
    def __init__(self, path, answers):
        self.calls = []
        self.listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        self.listener.bind(path)
        self.listener.listen(1)
        self.answers = answers
        self.thread = threading.Thread(target=self.serve, daemon=True)
        self.thread.start()

    def serve(self):
        connection, _ = self.listener.accept()
        with connection:
            while frame := _frames.read(connection):
                call = pb.Call.FromString(frame)
                self.calls.append(call)
                if call.HasField("register"):
                    event = pb.Event(registered=pb.Registered(group="body", task="t"))
                else:
                    said = call.command if call.HasField("command") else call.delegate
                    if not self.answers:
                        return
                    holder = pb.Holder(task="other", epoch=7)
                    newest = pb.Lease(epoch=7, sequence=[1])
                    answer = pb.Answer(id=said.id, verdict=self.answers.pop(0), holder=holder, newest=newest)
                    event = pb.Event(answer=answer)
                _frames.write(connection, event.SerializeToString())


def test_commands_show_the_lease_and_are_answered(tmp_path, monkeypatch):
    path = str(tmp_path / "socket")
    fake = FakeGate(path, [pb.VERDICT_OK, pb.VERDICT_OLDER, pb.VERDICT_OK])
    monkeypatch.setenv("MUSTER_GATE_SOCKET", path)
    monkeypatch.setenv("MUSTER_GATE_TOKEN", "secret")
    monkeypatch.setenv("MUSTER_LEASE", "tb-1.body:6")
    with muster.Gate() as gate:
        assert gate.command("base:Drive", b"go").verdict is muster.Verdict.OK
        gate.lease = (6, 2)
        answer = gate.command("base:Drive", b"on")
        assert (answer.verdict, answer.holder, answer.newest) == (muster.Verdict.OLDER, "other", (7, 1))
        assert gate.delegate((6, 3), "friend").verdict is muster.Verdict.OK
        with pytest.raises(muster.Disconnected):
            gate.command("base:Drive", b"gone")
    assert fake.calls[0].register.token == "secret"
    leases = [(c.command.lease.epoch, *c.command.lease.sequence) for c in fake.calls[1:3]]
    assert leases == [(6,), (6, 2)]
    assert fake.calls[3].delegate.task == "friend"


def test_what_is_no_task_is_told_so(monkeypatch):
    monkeypatch.delenv("MUSTER_LEASE", raising=False)
    with pytest.raises(muster.ConfigError, match="MUSTER_LEASE is not set"):
        muster.Gate()
    monkeypatch.setenv("MUSTER_LEASE", "tb-1.body")
    with pytest.raises(muster.ConfigError, match="is no lease"):
        muster.Gate()
