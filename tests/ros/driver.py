"""A robot's driver: subscribes /cmd_vel, or its argument, and prints what it is told, `X CALLER`, X the velocity ahead."""
import sys

import rospy
from geometry_msgs.msg import Twist


def drive(twist):
    print(twist.linear.x, twist._connection_header["callerid"], flush=True)


rospy.init_node("base_driver")
rospy.Subscriber(sys.argv[1] if len(sys.argv) > 1 else "/cmd_vel", Twist, drive)
rospy.spin()
