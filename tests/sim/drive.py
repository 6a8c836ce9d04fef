#!/usr/bin/env python3
"""Drives a simulated robot for tests: the same velocity twenty times a second.

    drive.py LINEAR ANGULAR
"""
import json
import sys
import time

import muster

command = json.dumps({"linear": float(sys.argv[1]), "angular": float(sys.argv[2])}).encode()
with muster.Gate() as gate:
    while True:
        gate.command("base:Drive", command)
        time.sleep(0.05)
