"""Lets a class be written with the names, and the numbers of arguments, of the paper's Table I and of Mesos."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Optional


@dataclass(frozen=True)
class Foreign:
    """How others call one of our callbacks."""

    #: ``("slaveLost", "nodeLost")``
    names: tuple[str, ...] = ()
    #: From our arguments (the driver first) to theirs, where these are not the same.
    arguments: Optional[Callable[..., tuple[Any, ...]]] = None


def adopt(cls: type, callbacks: Mapping[str, Foreign]) -> None:
    """Gives ``cls`` our name for each callback that it defines under another's. Our own wins where both are there."""
    for ours, foreign in callbacks.items():
        defined = next((name for name in (ours, *foreign.names) if inspect.isfunction(cls.__dict__.get(name))), None)
        if defined is not None:
            setattr(cls, ours, _fitted(cls.__dict__[defined], foreign))


def _fitted(method: Callable[..., None], foreign: Foreign) -> Callable[..., None]:
    arguments = foreign.arguments
    if arguments is None:
        return method
    given = _positional(arguments)
    made = _positional(method)
    # Written for our arguments; or it takes whatever comes.
    if made is None or given is None or made - 1 == given:
        return method

    @functools.wraps(method)
    def fitted(self: object, *values: Any) -> None:
        # A subclass that calls super() does so with the arguments of the method that it sees.
        method(self, *(arguments(*values) if len(values) == given else values))

    return fitted


def _positional(method: Callable[..., Any]) -> Optional[int]:
    """How many; None: any number."""
    kinds = [parameter.kind for parameter in inspect.signature(method).parameters.values()]
    if inspect.Parameter.VAR_POSITIONAL in kinds:
        return None
    return len(kinds) - kinds.count(inspect.Parameter.KEYWORD_ONLY) - kinds.count(inspect.Parameter.VAR_KEYWORD)
