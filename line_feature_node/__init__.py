"""Line segments from camera images: a ROS 2 node, an offline run over recordings, and a Python core."""

#: A picture with more pixels is not decoded: its header may say anything, and memory would be had for it.
MOST_PIXELS = 2**28
