"""Render the sample recordings: a drive down a corridor and one along a road, with their ground truth.

    python bags/render.py [--frames 60]

Each has JPEG images of 640×480 at 10 Hz on /camera/image/compressed, and on /camera/image/compressed/truth the true
segments of each under the same stamp, in the layout of the node's segments; size 0 marks those that are too weak to be
asked for.
The same versions of the libraries write the same bytes.
"""

import argparse
import math
import shutil
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer

from line_feature_node import roads, scenes
from line_feature_node.bag import QOS, VERSION
from line_feature_node.overlay import encode_jpeg
from line_feature_node.recordings import typestore
from line_feature_node.slices import MESSAGES
from line_feature_node.truth import segments_of_truth

HERE = Path(__file__).resolve().parent
TOPIC = '/camera/image/compressed'
#: Nanoseconds: when the recordings begin, and from frame to frame.
BEGIN, PERIOD = 1_800_000_000 * 10**9, 10**8
QUALITY = 80


def corridor(number: int) -> scenes.Scene:
    """A frame of a robot at 2 m/s that sways a little."""
    x = 2.0 + 0.2 * number
    return scenes.corridor(
        scenes.Camera(x=x, y=0.2 * math.sin(x), yaw=0.05 * math.cos(x), pitch=0.02 + 0.004 * math.sin(5 * x)),
        seed=number, layout=7)


def road(number: int) -> scenes.Scene:
    """A frame of a car at 20 m/s that keeps its lane, more or less."""
    x = 40.0 + 2.0 * number
    return roads.road(
        roads.Camera(x=x, y=roads.DEFAULT_CAMERA.y + 0.2 * math.sin(x / 30), yaw=0.01 * math.cos(x / 30)),
        seed=number, layout=3)


def write(target: Path, render: Callable[[int], scenes.Scene], frames: int) -> None:
    """Render a drive into a new recording in place of the old one."""
    types = typestore(ros1=False)
    shutil.rmtree(target, ignore_errors=True)
    writer = Writer(target, version=VERSION, storage_plugin=StoragePlugin.MCAP)
    writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
    with writer, ProcessPoolExecutor(mp_context=get_context('spawn')) as pool:
        connect = partial(writer.add_connection, typestore=types, offered_qos_profiles=[QOS])
        image, cloud = 'sensor_msgs/msg/CompressedImage', 'sensor_msgs/msg/PointCloud2'
        images, truths = connect(TOPIC, image), connect(f'{TOPIC}/truth', cloud)
        for number, scene in enumerate(pool.map(render, range(frames))):
            stamp = BEGIN + number * PERIOD
            head = header(types, stamp)
            picture: Any = encode_jpeg(np.asarray(cv2.cvtColor(scene.image, cv2.COLOR_BGR2GRAY), np.uint8), QUALITY)
            writer.write(images, stamp, types.serialize_cdr(types.types[image](
                header=head, format='mono8; jpeg compressed ', data=picture.reshape(-1)), image))
            segments = segments_of_truth(scene.truth, scene.weak)
            writer.write(truths, stamp, types.serialize_cdr(MESSAGES.segments(segments, head), cloud))


def header(types: Any, stamp: int) -> Any:
    """The header of a frame."""
    time = types.types['builtin_interfaces/msg/Time'](sec=stamp // 10**9, nanosec=stamp % 10**9)
    return types.types['std_msgs/msg/Header'](stamp=time, frame_id='camera')


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--frames', type=int, default=60)
    parser.add_argument('--out', type=Path, default=HERE)
    options = parser.parse_args()
    for render in (corridor, road):
        write(options.out / render.__name__, render, options.frames)


if __name__ == '__main__':
    main()
