"""What anybody who reaches the nodes of a ROS graph may do, and then prints what was answered.

push NODE TOPIC     publishes a Twist, unknown to the master, and tells NODE that this is who publishes it
end NODE            wants NODE to end
evict NODE          registers with NODE's name"""
import os
import sys
import threading
from xmlrpc.client import ServerProxy
from xmlrpc.server import SimpleXMLRPCServer

import rospy
from geometry_msgs.msg import Twist

what, node = sys.argv[1:3]
master = ServerProxy(os.environ["ROS_MASTER_URI"])
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
