"""The sensors' client against an agent that says what the test says."""

import os
import socket
import struct
import threading

import pytest

import muster
from muster import _frames
from muster._pb import sensor as pb


class FakeAgent:
    """Serves one connection after the other, each with what the test wants said."""

    def __init__(self, path, *scripts):
        self.calls = []
        self.path = path
        self.listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        self.listener.bind(path)
        self.listener.listen(1)
        self.thread = threading.Thread(target=self.serve, args=(scripts,), daemon=True)
        self.thread.start()

    def serve(self, scripts):
        for script in scripts:
            connection, _ = self.listener.accept()
            with connection:
                self.hear(connection)
                script(self, connection)

    def hear(self, connection):
        frame = _frames.read(connection)
        if frame is not None:
            self.calls.append(pb.Call.FromString(frame))

    @staticmethod
    def say(connection, descriptor=None, **event):
        message = pb.Event(**event).SerializeToString()
        control = []
        if descriptor is not None:
            control = [(socket.SOL_SOCKET, socket.SCM_RIGHTS, struct.pack("i", descriptor))]
        connection.sendmsg([struct.pack(">I", len(message)) + message], control)


@pytest.fixture
def directory(tmp_path, monkeypatch):
    (tmp_path / "kinect").mkdir()
    monkeypatch.setenv("MUSTER_SENSORS_DIR", str(tmp_path))
    monkeypatch.setenv("MUSTER_SENSORS_TOKEN", "secret")
    return tmp_path


def memory(text):
    descriptor = os.memfd_create("test")
    os.ftruncate(descriptor, 8192)
    os.pwrite(descriptor, text, 0)
    return descriptor


def test_frames_are_lent_and_given_back(directory):
    descriptor = memory(b"one")

    def script(fake, connection):
        fake.say(connection, opened=pb.Opened(function="kinect:ImageGen", life="l"))
        fake.say(connection, source=pb.Source(state=pb.STATE_FAILING, why="no camera", format="ros1:x/Y"))
        shared = {"slot": 1, "length": 3, "capacity": 8192}
        fake.say(connection, descriptor, frame=pb.Frame(sequence=7, stamp_ns=5, shared=pb.Shared(**shared, attached=True)))
        fake.hear(connection)
        os.pwrite(descriptor, b"two", 0)
        fake.say(connection, frame=pb.Frame(sequence=9, dropped=1, shared=pb.Shared(**shared)))
        fake.hear(connection)
        fake.say(connection, frame=pb.Frame(sequence=10, data=b"three"))

    fake = FakeAgent(str(directory / "kinect/ImageGen"), script)
    with muster.Sensor("kinect:ImageGen", queue=4) as sensor:
        first = sensor.next(timeout=10)
        assert (first.sequence, first.dropped, bytes(first.data)) == (7, 0, b"one")
        assert (sensor.state, sensor.why, sensor.format, sensor.life) == (
            muster.SourceState.FAILING,
            "no camera",
            "ros1:x/Y",
            "l",
        )
        with pytest.raises(TypeError):
            first.data[0] = 0
        second = sensor.next(timeout=10)
        assert (second.sequence, second.dropped, bytes(second.data)) == (9, 1, b"two")
        assert bytes(sensor.next(timeout=10).data) == b"three"
    opened = fake.calls[0].open
    assert (opened.version, opened.token, opened.queue, opened.inline) == (1, "secret", 4, False)
    assert [call.done.sequence for call in fake.calls[1:]] == [7, 9]


def test_an_agent_that_comes_back_is_connected_to_again_and_a_refusal_is_told(directory):
    def gone(fake, connection):
        fake.say(connection, frame=pb.Frame(sequence=1, data=b"a"))

    def slow(fake, connection):
        fake.say(connection, closed=pb.Closed(reason=pb.REASON_TOO_SLOW, message="too slow"))

    def refuses(fake, connection):
        fake.say(connection, frame=pb.Frame(sequence=1, data=b"b"))
        fake.hear(connection)
        fake.say(connection, closed=pb.Closed(reason=pb.REASON_REFUSED, message="no process of the task"))

    FakeAgent(str(directory / "kinect/ImageGen"), gone, slow, refuses)
    with muster.Sensor("kinect:ImageGen") as sensor:
        assert bytes(sensor.next(timeout=10).data) == b"a"
        assert bytes(sensor.next(timeout=10).data) == b"b"
        with pytest.raises(muster.Disconnected, match="no process of the task"):
            sensor.next(timeout=10)


def test_what_is_not_there_is_told_so(directory, monkeypatch):
    with pytest.raises(muster.ConfigError, match="did not ask for it"):
        muster.Sensor("kinect:LaserGen")
    path = str(directory / "kinect/Silent")
    FakeAgent(path, lambda fake, connection: fake.hear(connection))
    with muster.Sensor("kinect:Silent") as sensor, pytest.raises(TimeoutError):
        sensor.next(timeout=0.05)
    monkeypatch.delenv("MUSTER_SENSORS_DIR")
    with pytest.raises(muster.ConfigError, match="MUSTER_SENSORS_DIR is not set"):
        muster.Sensor("kinect:ImageGen")
