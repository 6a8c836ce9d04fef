"""What waits for the callback thread, in order and bounded.

The thread that reads the session never waits for callbacks: heartbeats and answers come the same way. So events that
are overtaken before they are delivered take their place in the queue instead of a new one: a newer update of a task
replaces the older, a rescind takes back its offer, a lost session all of them. Messages, which nothing overtakes and
which are delivered at most once anyhow, are dropped above ``MOST_MESSAGE_BYTES``.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Hashable
from dataclasses import dataclass, replace
from typing import Callable, Optional, Union

from muster.errors import FrameworkError
from muster.model import Offer, Position, RescindReason, TaskStatus

log = logging.getLogger("muster")

MOST_MESSAGE_BYTES = 64 * 1024 * 1024


@dataclass(frozen=True)
class Registered:
    framework_id: str


@dataclass(frozen=True)
class Reregistered:
    pass


@dataclass(frozen=True)
class Lost:
    """The session broke."""


@dataclass(frozen=True)
class Offered:
    offers: tuple[Offer, ...]


@dataclass(frozen=True)
class Rescinded:
    offer_id: str
    reason: RescindReason


@dataclass(frozen=True)
class Updated:
    status: TaskStatus


@dataclass(frozen=True)
class Message:
    executor: str
    node: str
    data: bytes


@dataclass(frozen=True)
class NodeLost:
    node: str
    message: str


@dataclass(frozen=True)
class ExecutorLost:
    executor: str
    node: str
    exit_code: Optional[int]
    message: str


@dataclass(frozen=True)
class Moved:
    position: Optional[Position]
    by: str


@dataclass(frozen=True)
class Failed:
    error: FrameworkError


@dataclass(frozen=True)
class Deferred:
    """A done-callback of a call's result."""

    run: Callable[[], None]


Event = Union[
    Registered,
    Reregistered,
    Lost,
    Offered,
    Rescinded,
    Updated,
    Message,
    NodeLost,
    ExecutorLost,
    Moved,
    Failed,
    Deferred,
]


class Inbox:
    def __init__(self, most_message_bytes: int = MOST_MESSAGE_BYTES) -> None:
        self._changed = threading.Condition()
        self._events: dict[int, Event] = {}
        # Where an event is that a later one may overtake.
        self._places: dict[Hashable, int] = {}
        self._next = 0
        self._message_bytes = 0
        self._most_message_bytes = most_message_bytes
        self._closed = False

    def put(self, event: Event) -> bool:
        """False: nobody will take it any more."""
        with self._changed:
            if self._closed:
                return False
            if isinstance(event, Rescinded):
                self._rescind(event)
            elif isinstance(event, Lost):
                self._lose(event)
            elif isinstance(event, Message):
                self._message(event)
            else:
                self._append(event)
            self._changed.notify()
            return True

    def take(self) -> Optional[Event]:
        """The next event, waiting for it; None when closed."""
        with self._changed:
            while not self._events and not self._closed:
                self._changed.wait()
            if self._closed:
                return None
            place = next(iter(self._events))
            event = self._remove(place)
            if isinstance(event, Message):
                self._message_bytes -= len(event.data)
            return event

    def close(self) -> list[Deferred]:
        """Nothing more is taken. What somebody still waits for is handed back."""
        with self._changed:
            self._closed = True
            left = [event for event in self._events.values() if isinstance(event, Deferred)]
            self._events.clear()
            self._places.clear()
            self._changed.notify_all()
            return left

    def _append(self, event: Event) -> None:
        keys = _keys(event)
        if not isinstance(event, Offered):
            taken = next((self._places[key] for key in keys if key in self._places), None)
            if taken is not None:
                self._events[taken] = event
                return
        self._events[self._next] = event
        self._places.update((key, self._next) for key in keys)
        self._next += 1

    def _remove(self, place: int) -> Event:
        event = self._events.pop(place)
        for key in _keys(event):
            self._places.pop(key, None)
        return event

    def _rescind(self, event: Rescinded) -> None:
        place = self._places.pop(("offer", event.offer_id), None)
        if place is None:
            self._append(event)
            return
        waiting = self._events[place]
        assert isinstance(waiting, Offered)
        left = tuple(offer for offer in waiting.offers if offer.id != event.offer_id)
        if left:
            self._events[place] = replace(waiting, offers=left)
        else:
            del self._events[place]

    def _lose(self, event: Lost) -> None:
        void = [place for place, waiting in self._events.items() if isinstance(waiting, (Offered, Rescinded))]
        for place in void:
            self._remove(place)
        back = next((place for place, waiting in self._events.items() if isinstance(waiting, Reregistered)), None)
        if back is None:
            self._append(event)
        else:  # Was back and is gone again, while nobody looked.
            self._remove(back)

    def _message(self, event: Message) -> None:
        if self._message_bytes + len(event.data) > self._most_message_bytes:
            log.warning("a message from executor %s is dropped: the callbacks are too slow", event.executor)
            return
        self._message_bytes += len(event.data)
        self._append(event)


def _keys(event: Event) -> tuple[Hashable, ...]:
    if isinstance(event, Offered):
        return tuple(("offer", offer.id) for offer in event.offers)
    if isinstance(event, Updated):
        return (("task", event.status.task_id),)
    if isinstance(event, NodeLost):
        return (("node", event.node),)
    if isinstance(event, ExecutorLost):
        return (("executor", event.executor),)
    return ()
