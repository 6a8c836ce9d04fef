"""An agent that does what a test says: its end of an executor's Unix socket."""

from __future__ import annotations

import socket
from pathlib import Path
from typing import Any

from fake_controller import PATIENCE
from muster import _frames
from muster._pb import executor as pb


class FakeConnection:
    def __init__(self, connection: socket.socket) -> None:
        self._connection = connection
        connection.settimeout(PATIENCE)

    def send(self, **event: Any) -> None:
        _frames.write(self._connection, pb.Event(**event).SerializeToString())

    def send_raw(self, data: bytes) -> None:
        self._connection.sendall(data)

    def expect(self, kind: str) -> Any:
        frame = _frames.read(self._connection)
        assert frame is not None, f"the connection ended where {kind} was due"
        call = pb.Call.FromString(frame)
        assert call.WhichOneof("call") == kind, call
        return getattr(call, kind)

    def expect_end(self) -> None:
        assert _frames.read(self._connection) is None

    def registered(self, reregistered: bool = False) -> Any:
        """Waits for Register and answers it."""
        register = self.expect("register")
        self.send(
            registered=pb.Registered(
                executor="e-1",
                namespace="default",
                framework="deliver",
                framework_id="f-1",
                node="turtlebot-1",
                reregistered=reregistered,
            )
        )
        return register

    def close(self) -> None:
        self._connection.close()


class FakeAgent:
    def __init__(self, directory: Path) -> None:
        self.path = directory / "executor.sock"
        self._connections: list[FakeConnection] = []
        self.listen()

    def listen(self) -> None:
        self._socket = socket.socket(socket.AF_UNIX)
        self._socket.settimeout(PATIENCE)
        self._socket.bind(str(self.path))
        self._socket.listen()

    def accept(self) -> FakeConnection:
        connection = FakeConnection(self._socket.accept()[0])
        self._connections.append(connection)
        return connection

    def environ(self) -> dict[str, str]:
        return {"MUSTER_EXECUTOR_SOCKET": str(self.path), "MUSTER_EXECUTOR_TOKEN": "secret"}

    def close(self) -> None:
        """Dies, as an agent does that is restarted."""
        for connection in self._connections:
            connection.close()
        self._socket.close()
        self.path.unlink(missing_ok=True)
