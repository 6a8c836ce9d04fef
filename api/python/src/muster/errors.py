"""Everything that the SDK raises of its own."""

from __future__ import annotations

import enum
from dataclasses import dataclass
from typing import Optional


class MusterError(Exception):
    """Base of all of them."""


class ConfigError(MusterError):
    """What the program was started with cannot be used: kubeconfig, state file, environment."""


class RefusalReason(enum.Enum):
    """Why the controller refused a call. The values are the wire's."""

    UNSPECIFIED = 0
    #: The call means nothing, or a task's spec is refused; ``CallRefused.causes`` says where.
    INVALID = 1
    #: Rescinded, expired, answered before, or never this framework's.
    OFFER_GONE = 2
    #: The tasks want more than was offered.
    EXCEEDS_OFFER = 3
    #: Another one was first.
    CONFLICT = 4
    QUOTA = 5
    NOT_FOUND = 6
    #: Try again.
    UNAVAILABLE = 7


@dataclass(frozen=True)
class Cause:
    """One thing that is wrong, by its place in the call: ``launches[0].spec.resources.cpu``."""

    field: str
    message: str


class CallRefused(MusterError):
    """The controller refused a call; nothing of it was done."""

    def __init__(self, reason: RefusalReason, message: str, causes: tuple[Cause, ...] = ()) -> None:
        super().__init__(reason, message, causes)
        self.reason = reason
        self.message = message
        self.causes = causes

    def __str__(self) -> str:
        places = "".join(f"; {cause.field}: {cause.message}" for cause in self.causes)
        return f"{self.reason.name}: {self.message}{places}"


class Disconnected(MusterError):
    """There is no session. A call that was under way may have been done: ``reconcile_tasks`` tells."""


class Overloaded(MusterError):
    """More calls wait for the controller, or more bytes for the wire, than the driver keeps."""


class DriverNotRunning(MusterError):
    """The driver was not started, or has ended."""


class FrameworkError(MusterError):
    """The controller, or the way to it, ended the session for good. ``reason`` is one CamelCase word."""

    def __init__(self, reason: str, message: str) -> None:
        super().__init__(reason, message)
        self.reason = reason
        self.message = message

    def __str__(self) -> str:
        return f"{self.reason}: {self.message}"


class WireError(MusterError):
    """The other side sent what its protocol does not allow."""

    def __init__(self, what: str, field: Optional[str] = None) -> None:
        super().__init__(what if field is None else f"{field}: {what}")
