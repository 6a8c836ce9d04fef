#!/usr/bin/env python3
"""Drives for tests: commands `go NAME` twenty times a second and prints each answer that is another than the one before."""

import os
import sys
import time

import muster

name = os.environ["MUSTER_TASK"]
before = None
while True:
    try:
        with muster.Gate() as gate:
            while True:
                verdict = gate.command("base:Drive", f"go {name}".encode()).verdict
                if verdict is not before:
                    print(verdict.name, flush=True)
                before = verdict
                time.sleep(0.05)
    except muster.Disconnected as error:
        print(f"gone: {error}", file=sys.stderr, flush=True)
        time.sleep(0.05)
