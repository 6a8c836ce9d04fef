#!/usr/bin/env python3
"""A camera for tests: frames of one size, all bytes of a frame its number, to the standard output.

    camera.py BYTES HZ [LOG]     says in LOG that it was started
"""
import os
import sys
import time

size, hz = int(sys.argv[1]), float(sys.argv[2])
if len(sys.argv) > 3:
    with open(sys.argv[3], "a") as log:
        log.write(f"{os.getpid()}\n")
number, due = 0, time.monotonic()
while True:
    number += 1
    sys.stdout.buffer.write(bytes([number % 251]) * size)
    sys.stdout.buffer.flush()
    due += 1 / hz
    time.sleep(max(0, due - time.monotonic()))
