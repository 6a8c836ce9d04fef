#!/usr/bin/env python3
"""Watches a function of a sensor, as a task that asked for it, and says what comes.

    resources: {sensors: ["kinect:ImageGen"]}
    run: {process: {command: [watch.py, "kinect:ImageGen"]}}
"""

from __future__ import annotations

import argparse
import sys
import time

import muster


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("function", help="DEVICE:FUNCTION, as in kinect:ImageGen")
    parser.add_argument("--queue", type=int, default=1, help="frames that may wait; 1: the latest value")
    parser.add_argument("--count", type=int, help="end after so many frames")
    arguments = parser.parse_args()
    try:
        with muster.Sensor(arguments.function, queue=arguments.queue) as sensor:
            for seen, frame in enumerate(sensor, start=1):
                age = (time.time_ns() - frame.stamp_ns) / 1e6
                print(
                    f"{frame.sequence} {len(frame.data)} bytes, {frame.dropped} dropped before, {age:.1f} ms old",
                    flush=True,
                )
                if seen == arguments.count:
                    break
    except muster.MusterError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
