"""Large images: `publish` one on each new connection, `check` those of somebody else."""
import sys
import zlib

import rospy
from sensor_msgs.msg import Image

WIDTH, HEIGHT = 1920, 1080

rospy.init_node("image_" + sys.argv[1])
if sys.argv[1] == "publish":
    data = bytes(n % 251 for n in range(WIDTH * HEIGHT * 3))
    image = Image(height=HEIGHT, width=WIDTH, encoding="rgb8", step=WIDTH * 3, data=data)
    image.header.frame_id = "camera"
    publisher = rospy.Publisher("/image", Image, queue_size=1, latch=True)
    publisher.publish(image)
    print(zlib.crc32(data), flush=True)
else:
    rospy.Subscriber(
        "/image", Image, lambda m: print(m.width, m.height, m.header.frame_id, zlib.crc32(m.data), flush=True)
    )
    print("ready", flush=True)
rospy.spin()
