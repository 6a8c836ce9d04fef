"""A robot that drives: publishes where it is, and says so on standard output once a second at most.

    odometry.py odometry TOPIC HZ        nav_msgs/Odometry in `odom`
    odometry.py tf TOPIC HZ              odom -> base_footprint, and base_footprint -> base_link once on TOPIC_static;
                                         map -> odom on TOPIC at a fifth of the rate
    odometry.py amcl TOPIC HZ VARIANCE   geometry_msgs/PoseWithCovarianceStamped in `map`

The place at the n-th message is x = n / 1000, y = -2 x, yaw = x: what was received tells what was sent. `MAP=x,y,yaw` in the
environment is where tf's map -> odom is; `SIM=1` stamps with /clock, which this program then publishes too, 1 h after 0.
"""
import math
import os
import sys

import rospy
from geometry_msgs.msg import PoseWithCovarianceStamped, TransformStamped
from nav_msgs.msg import Odometry
from rosgraph_msgs.msg import Clock
from tf2_msgs.msg import TFMessage

kind, topic, hertz = sys.argv[1], sys.argv[2], float(sys.argv[3])
simulated = os.environ.get("SIM") == "1"


def turn(quaternion, yaw):
    quaternion.z, quaternion.w = math.sin(yaw / 2), math.cos(yaw / 2)


def transform(parent, child, x, y, yaw, stamp):
    one = TransformStamped(child_frame_id=child)
    one.header.frame_id, one.header.stamp = parent, stamp
    one.transform.translation.x, one.transform.translation.y = x, y
    turn(one.transform.rotation, yaw)
    return one


rospy.init_node("driver", anonymous=True, disable_signals=True)
types = {"odometry": Odometry, "tf": TFMessage, "amcl": PoseWithCovarianceStamped}
publisher = rospy.Publisher(topic, types[kind], queue_size=1)
ticks = rospy.Publisher("/clock", Clock, queue_size=1) if simulated else None
if kind == "tf":
    fixed = rospy.Publisher(topic + "_static", TFMessage, queue_size=1, latch=True)
    fixed.publish(TFMessage([transform("base_footprint", "base_link", 0, 0, 0, rospy.Time())]))
    place = [float(part) for part in os.environ.get("MAP", "0,0,0").split(",")]
print("drives", flush=True)
n = 0
import time

while True:
    n += 1
    x = n / 1000
    stamp = rospy.Time.from_sec(3600 + n / hertz) if simulated else rospy.Time.from_sec(time.time())
    if ticks:
        ticks.publish(Clock(stamp))
    if kind == "tf":
        both = [transform("odom", "base_footprint", x, -2 * x, x, stamp)]
        if n % 5 == 1:
            both.append(transform("map", "odom", *place, stamp))
        publisher.publish(TFMessage(both))
    else:
        message = types[kind]()
        message.header.stamp = stamp
        message.header.frame_id = "odom" if kind == "odometry" else "map"
        message.pose.pose.position.x, message.pose.pose.position.y = x, -2 * x
        turn(message.pose.pose.orientation, x)
        if len(sys.argv) > 4:
            message.pose.covariance[0] = message.pose.covariance[7] = float(sys.argv[4])
        publisher.publish(message)
    time.sleep(1 / hertz)
