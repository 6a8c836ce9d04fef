"""A node in a task's own graph: prints what it hears, `chatter DATA` and `odom X`, and commands the speed of its argument."""
import sys

import rospy
from geometry_msgs.msg import Twist
from nav_msgs.msg import Odometry
from std_msgs.msg import String

rospy.init_node("viewer")
rospy.Subscriber("/chatter", String, lambda heard: print("chatter", heard.data, flush=True))
rospy.Subscriber("/odom", Odometry, lambda heard: print("odom", heard.pose.pose.position.x, flush=True))
publisher = rospy.Publisher("/cmd_vel", Twist, queue_size=1)
twist = Twist()
twist.linear.x = float(sys.argv[1])
rate = rospy.Rate(20)
while not rospy.is_shutdown():
    publisher.publish(twist)
    rate.sleep()
