"""Prints the checksum of each message type given, as `rosmsg md5` does."""
import sys

import rosmsg

for name in sys.argv[1:]:
    print(name, rosmsg.rosmsg_md5(rosmsg.MODE_MSG, name), flush=True)
