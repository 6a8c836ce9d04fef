"""Frames on the executor's socket: a big-endian 32-bit length, then one message."""

from __future__ import annotations

import socket
import struct
from typing import Optional

from muster.errors import WireError

_LENGTH = struct.Struct(">I")
#: A message of a framework has up to 4 MiB; a launch has its task's data. More is not a frame but noise.
MOST_BYTES = 16 * 1024 * 1024


def write(connection: socket.socket, message: bytes) -> None:
    connection.sendall(_LENGTH.pack(len(message)) + message)


def read(connection: socket.socket) -> Optional[bytes]:
    """None at the end of the stream; WireError in the middle of a frame."""
    head = _exactly(connection, _LENGTH.size)
    if not head:
        return None
    (length,) = _LENGTH.unpack(head)
    if length > MOST_BYTES:
        raise WireError(f"a frame of {length} bytes")
    return _exactly(connection, length, inside=True)


def _exactly(connection: socket.socket, length: int, inside: bool = False) -> bytes:
    parts = bytearray()
    while len(parts) < length:
        part = connection.recv(min(length - len(parts), 1 << 20))
        if not part:
            if parts or inside:
                raise WireError("the stream ended within a frame")
            break
        parts += part
    return bytes(parts)
