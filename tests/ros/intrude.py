"""What anybody who reaches the nodes of a ROS graph may do, and then prints what was answered.

push NODE TOPIC     publishes a Twist, unknown to the master, and tells NODE that this is who publishes it
end NODE            wants NODE to end
evict NODE          registers with NODE's name
lend NODE TOPIC     reads TOPIC in NODE's name"""
import os
import socket
import struct
import sys
import threading
import time
from xmlrpc.client import ServerProxy
from xmlrpc.server import SimpleXMLRPCServer

import rospy
from geometry_msgs.msg import Twist

what, node = sys.argv[1:3]
master = ServerProxy(os.environ["ROS_MASTER_URI"])
while master.lookupNode("/intruder", node)[0] != 1:
    time.sleep(0.05)
slave = ServerProxy(master.lookupNode("/intruder", node)[2])
if what == "push":
    topic = sys.argv[3]
    rospy.init_node("intruder")
    publisher = rospy.Publisher(topic, Twist, queue_size=1)
    api = rospy.get_node_uri()
    # As if the master had never heard of it.
    master.unregisterPublisher("/intruder", topic, api)
    known = dict(master.getSystemState("/intruder")[2][0]).get(topic, [])
    others = [master.lookupNode("/intruder", name)[2] for name in known]
    print(slave.publisherUpdate("/master", topic, others + [api])[0], flush=True)
    rospy.spin()
elif what == "lend":
    publishers = []
    while not publishers:
        time.sleep(0.05)
        publishers = dict(master.getSystemState("/intruder")[2][0]).get(sys.argv[3], [])
    publisher = ServerProxy(master.lookupNode("/intruder", publishers[0])[2])
    _, host, port = publisher.requestTopic(node, sys.argv[3], [["TCPROS"]])[2]
    fields = [f"callerid={node}", f"topic={sys.argv[3]}", "type=geometry_msgs/Twist", "md5sum=*"]
    header = b"".join(struct.pack("<I", len(field)) + field.encode() for field in fields)
    stream = socket.create_connection((host, port))
    stream.sendall(struct.pack("<I", len(header)) + header)
    print(1, flush=True)
    while stream.recv(4096):
        pass
elif what == "end":
    print(slave.shutdown("/master", "for a test")[0], flush=True)
else:
    # Somebody who answers to the name.
    server = SimpleXMLRPCServer(("127.0.0.1", 0), logRequests=False)
    server.register_function(lambda *_: [1, "", os.getpid()], "getPid")
    server.register_function(lambda *_: [1, "", 0], "shutdown")
    threading.Thread(target=server.serve_forever, daemon=True).start()
    api = "http://127.0.0.1:%d/" % server.server_address[1]
    print(master.registerPublisher(node, "/elsewhere", "geometry_msgs/Twist", api)[0], flush=True)
    threading.Event().wait()
