"""For the ``main`` of a framework: its arguments, and how it ends."""

from __future__ import annotations

import argparse
import logging
import math
import signal
import sys

from muster._life import DriverState
from muster.driver import SchedulerDriver
from muster.errors import MusterError
from muster.model import Position

#: What a shell gives a program that an interrupt ended.
INTERRUPTED = 130
_ENDING = (signal.SIGINT, signal.SIGTERM)
#: How soon a signal is looked at.
_SIGNAL_SECONDS = 0.2


def position(text: str) -> Position:
    """``X,Y`` or ``X,Y,Z``, metres; a type for argparse."""
    try:
        x, y, *rest = (float(part) for part in text.split(","))
        (z,) = rest or (0.0,)
        good = all(map(math.isfinite, (x, y, z)))
    except ValueError:
        good = False
    if not good:
        raise argparse.ArgumentTypeError(f"{text!r} is not a position: write X,Y or X,Y,Z (metres), as in 3.0,4.5")
    return Position(x, y, z)


def add_arguments(parser: argparse.ArgumentParser, name: str) -> None:
    """Those that every framework has."""
    parser.add_argument("--name", default=name, help="the framework's name (default: %(default)s)")
    parser.add_argument("--namespace", default="default")
    parser.add_argument("--kubeconfig", help="default: MUSTER_CONFIG, KUBECONFIG, ~/.muster/config")


def run(driver: SchedulerDriver, failover: bool = False) -> int:
    """Runs the driver until it has ended or SIGINT or SIGTERM comes; then stops it in order, or with a second one at
    once.

    For the main thread. Gives the program's exit code: 0 when the scheduler stopped the driver.
    """
    logging.basicConfig(level=logging.WARNING, format="%(levelname)s: %(message)s")
    came: list[int] = []
    # They only take note: an exception out of nowhere could leave the driver half started.
    before = {number: signal.signal(number, lambda which, _: came.append(which)) for number in _ENDING}
    try:
        driver.start()
        while driver.join(_SIGNAL_SECONDS) in (DriverState.RUNNING, DriverState.STOPPING):
            if len(came) > 1:
                driver.abort()
            elif came:
                driver.stop(failover)
    except MusterError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
    if came:
        return INTERRUPTED
    return 0 if driver.state is DriverState.STOPPED else 1
