#!/usr/bin/env python3
"""Reads a sensor for tests, and prints a JSON line for each frame.

    read.py FUNCTION [QUEUE [SECONDS_EACH]]
"""
import json
import sys
import time

import muster

function = sys.argv[1]
queue = int(sys.argv[2]) if len(sys.argv) > 2 else 1
pause = float(sys.argv[3]) if len(sys.argv) > 3 else 0.0
try:
    with muster.Sensor(function, queue=queue) as sensor:
        state = None
        while True:
            frame = sensor.next()
            time.sleep(pause)
            said = {
                "sequence": frame.sequence,
                "dropped": frame.dropped,
                "length": len(frame.data),
                "first": frame.data[0] if frame.data else None,
                "whole": bytes(frame.data) == bytes(frame.data[:1]) * len(frame.data),
                "life": sensor.life,
                "format": sensor.format,
                "text": bytes(frame.data[:80]).decode("ascii", "replace"),
            }
            print(json.dumps(said), flush=True)
except muster.MusterError as error:
    print(json.dumps({"error": type(error).__name__, "why": str(error)}), flush=True)
    sys.exit(3)
