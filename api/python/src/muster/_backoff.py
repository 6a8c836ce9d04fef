"""How long to wait before the next attempt to connect."""

from __future__ import annotations

import random
from typing import Callable


class Backoff:
    """Doubles up to ``most`` seconds. Half of each wait is random, so that a fleet does not come back as one."""

    def __init__(self, first: float = 0.1, most: float = 10.0, chance: Callable[[], float] = random.random) -> None:
        self._first = first
        self._most = most
        self._chance = chance
        self._next = first

    def next(self) -> float:
        wait = self._next
        self._next = min(self._most, wait * 2)
        return wait * (0.5 + self._chance() / 2)

    def reset(self) -> None:
        self._next = self._first
