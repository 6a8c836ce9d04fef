#!/usr/bin/env python3
"""Drives through the gate, as fast as its first argument says and as many times a second as its second; prints each answer that is
another than the one before."""

import json
import sys
import time

import muster

twist = json.dumps({"linear": {"x": float(sys.argv[1])}}).encode()
before = None
while True:
    try:
        with muster.Gate() as gate:
            while True:
                verdict = gate.command("base:Drive", twist).verdict
                if verdict is not before:
                    print(verdict.name, flush=True)
                before = verdict
                time.sleep(1 / float(sys.argv[2]))
    except muster.Disconnected as error:
        print(f"gone: {error}", file=sys.stderr, flush=True)
        time.sleep(0.05)
