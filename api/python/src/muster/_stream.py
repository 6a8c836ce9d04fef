"""One gRPC stream to the controller, and the watch that notices when nothing comes any more."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from typing import Any, Callable, Optional

import grpc

from muster._pb import framework as pb
from muster.errors import Disconnected, FrameworkError
from muster.kubeconfig import Target

_METHOD = "/muster.framework.v1.FrameworkService/Session"
#: A message has up to 4 MiB beside its frame; a list of offers of a large site has some more.
_MOST_RECEIVED = 64 * 1024 * 1024

#: No later attempt would end otherwise.
_FINAL = {
    grpc.StatusCode.UNAUTHENTICATED: "Unauthenticated",
    grpc.StatusCode.PERMISSION_DENIED: "PermissionDenied",
    grpc.StatusCode.UNIMPLEMENTED: "Unimplemented",
    grpc.StatusCode.INVALID_ARGUMENT: "InvalidArgument",
}


class Watch:
    """Calls ``expired`` once, when ``feed`` was not called for ``seconds``, or ``deadline`` has come."""

    def __init__(self, seconds: float, expired: Callable[[str], None]) -> None:
        self._changed = threading.Condition()
        self._seconds = seconds
        self._fed = time.monotonic()
        self._deadline: Optional[float] = None
        self._closed = False
        self._expired = expired
        threading.Thread(target=self._run, name="muster-watch", daemon=True).start()

    def feed(self) -> None:
        # Without the lock: a moment late is early enough, and every event comes by here.
        self._fed = time.monotonic()

    def allow(self, seconds: float) -> None:
        with self._changed:
            self._seconds = seconds
            self._changed.notify()

    def end_at(self, deadline: float) -> None:
        with self._changed:
            self._deadline = deadline
            self._changed.notify()

    def close(self) -> None:
        with self._changed:
            self._closed = True
            self._changed.notify()

    def _run(self) -> None:
        with self._changed:
            while not self._closed:
                silent = self._fed + self._seconds
                until = silent if self._deadline is None else min(silent, self._deadline)
                left = until - time.monotonic()
                if left <= 0:
                    break
                self._changed.wait(left)
            if self._closed:
                return
        if until == silent:
            self._expired(f"nothing came for {self._seconds:g} s")
        else:
            self._expired("the controller did not end the session")


class Stream:
    """The events of one session. Iterating raises Disconnected, or FrameworkError when trying again is of no use."""

    def __init__(self, target: Target, calls: Iterator[pb.Call], connect_seconds: float) -> None:
        credentials = grpc.ssl_channel_credentials(
            target.certificate_authority, target.client_key, target.client_certificate
        )
        options: list[tuple[str, object]] = [
            ("grpc.max_receive_message_length", _MOST_RECEIVED),
            ("grpc.max_send_message_length", -1),
            # The waits between attempts are the driver's, and the agents dial the controller without a proxy as well.
            ("grpc.use_local_subchannel_pool", 1),
            ("grpc.enable_http_proxy", 0),
        ]
        if target.server_name:
            options.append(("grpc.ssl_target_name_override", target.server_name))
        self._why: Optional[str] = None
        self._channel = grpc.secure_channel(target.address, credentials, options)
        session = self._channel.stream_stream(
            _METHOD, request_serializer=pb.Call.SerializeToString, response_deserializer=pb.Event.FromString
        )
        metadata = (("authorization", f"Bearer {target.token}"),) if target.token else None
        self._call: Optional[Any] = session(calls, metadata=metadata)
        self.watch = Watch(connect_seconds, self.cancel)

    def __iter__(self) -> Iterator[pb.Event]:
        try:
            for event in self._call or ():
                self.watch.feed()
                yield event
            return
        except grpc.RpcError as error:
            ended = self._translated(error)
            # It is the call itself, which its own traceback would keep alive: see `close`.
            error.__traceback__ = None
        raise ended

    def _translated(self, error: grpc.RpcError) -> Exception:
        if self._why is not None:
            return Disconnected(self._why)
        code = error.code() if isinstance(error, grpc.Call) else grpc.StatusCode.UNKNOWN
        details = (error.details() if isinstance(error, grpc.Call) else None) or str(error)
        if code in _FINAL:
            return FrameworkError(_FINAL[code], details)
        return Disconnected(f"{code.name}: {details}")

    def cancel(self, why: str) -> None:
        """From any thread."""
        self._why = why
        call = self._call
        if call is not None:
            call.cancel()

    def close(self) -> None:
        self.watch.close()
        self.cancel(self._why or "closed")
        # Nobody may have the call when Python ends: it takes a lock when it is collected, and gRPC's threads, which have that
        # lock at times, are dead by then. The program would hang.
        self._call = None
        self._channel.close()
