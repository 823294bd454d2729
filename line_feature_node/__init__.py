"""Line segments from camera images: a ROS 2 node, an offline run over recordings, and a Python core."""
