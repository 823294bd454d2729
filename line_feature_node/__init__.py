"""Line segments from camera images: a ROS 2 node, an offline run over recordings, and a Python core."""

import os

#: A picture with more pixels is not decoded: its header may say anything, and memory would be had for it.
MOST_PIXELS = 2**28

# OpenCV, which has many formats, reads its own limit when it is loaded.
os.environ.setdefault('OPENCV_IO_MAX_IMAGE_PIXELS', str(MOST_PIXELS))
