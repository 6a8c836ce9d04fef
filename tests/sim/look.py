#!/usr/bin/env python3
"""Reads a sensor of a simulated robot for tests, and prints a JSON line for each frame: what is ahead of the laser, how many colors
a picture has.

    look.py FUNCTION
"""
import json
import struct
import sys

import muster


def fields(data):
    """The fields of a protobuf message: number and value, bytes or a number."""
    at = 0

    def varint():
        nonlocal at
        value = shift = 0
        while True:
            byte = data[at]
            at += 1
            value |= (byte & 127) << shift
            shift += 7
            if byte < 128:
                return value

    while at < len(data):
        key = varint()
        number, kind = key >> 3, key & 7
        if kind == 0:
            yield number, varint()
        else:
            length = {1: 8, 5: 4}.get(kind) or varint()
            yield number, data[at : at + length]
            at += length


with muster.Sensor(sys.argv[1]) as sensor:
    for frame in sensor:
        message = dict(fields(bytes(frame.data)))
        said = {"format": sensor.format}
        if sensor.format.endswith("LaserScan"):
            ranges = struct.unpack(f"<{len(message[9]) // 4}f", message[9])
            said |= {"rays": len(ranges), "ahead": ranges[len(ranges) // 2]}
        else:
            pixels = message[7]
            colors = {pixels[i : i + 3] for i in range(0, len(pixels), 3)}
            said |= {"width": message[3], "height": message[2], "colors": len(colors)}
        print(json.dumps(said), flush=True)
