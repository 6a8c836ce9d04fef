"""A robot's driver: subscribes /cmd_vel and prints what it is told, `X CALLER`, X the velocity ahead."""
import rospy
from geometry_msgs.msg import Twist


def drive(twist):
    print(twist.linear.x, twist._connection_header["callerid"], flush=True)


rospy.init_node("base_driver")
rospy.Subscriber("/cmd_vel", Twist, drive)
rospy.spin()
