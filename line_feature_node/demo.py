"""The demo: a robot drives down the rendered corridor, and its camera's images go through the real node over ROS 2."""

import contextlib
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field
from multiprocessing import get_context

import cv2
import numpy as np
import rclpy
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray
from numpy.typing import NDArray
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import QoSProfile
from sensor_msgs.msg import CompressedImage, Image, PointCloud2
from std_msgs.msg import Header

from line_feature_node.core import end_points
from line_feature_node.images import decode
from line_feature_node.messages import segments_of
from line_feature_node.monitor import Level
from line_feature_node.node import MESSAGES
from line_feature_node.scenes import Camera, Scene, corridor
from line_feature_node.truth import Agreement, compare

#: Frames a second.
RATE = 30.0
#: Seconds until the node must be ready: compiling takes a while where it was never done.
PATIENCE = 300.0
#: The node is to have every frame. Grey ones fit into the shared memory of the default transport; for colour images of
#: this size config/ has a profile.
RELIABLE = ['-p', 'qos_overrides./image.subscription.reliability:=reliable',
            '-p', 'qos_overrides./image.subscription.depth:=30']
#: Seconds that the last results have to arrive.
GRACE = 10.0
#: Counts of the node that are shown.
COUNTED = ('processed', 'dropped', 'failed')
#: Metres that the robot drives, from the first frame to the last.
DRIVE = (2.0, 14.0)


@dataclass
class Outcome:
    """What came back from the node.

    Attributes:
        published: Frames that were published.
        latencies: Seconds from publishing each frame that was answered to receiving its segments.
        agreements: How the segments of each agree with the ground truth.
        segments: Segments of each.
        overlay: The last overlay, H×W×3 BGR; None where none came.
        health, counts: What the node last said of itself, and of its frames.
    """

    published: int
    latencies: list[float] = field(default_factory=list)
    agreements: list[Agreement] = field(default_factory=list)
    segments: list[int] = field(default_factory=list)
    overlay: NDArray[np.uint8] | None = None
    health: str = ''
    counts: str = ''


def render(frames: int) -> list[Scene]:
    """The drive, rendered with as many processes as there are processors."""
    places = np.linspace(*DRIVE, frames)
    with ProcessPoolExecutor(mp_context=get_context('spawn')) as pool:
        return list(pool.map(_scene, places.tolist(), range(frames)))


def _scene(x: float, number: int) -> Scene:
    """One frame: the robot sways a little, and each frame has noise of its own."""
    sway = np.sin(x)
    return corridor(Camera(x=x, y=0.2 + 0.15 * sway, yaw=0.06 - 0.05 * sway), seed=number)


def play(scenes: list[Scene], arguments: list[str]) -> Outcome:
    """Play the scenes to a node as a process of its own, and collect what comes back.

    Everything stays on this machine, in a domain of its own.

    Args:
        scenes: The frames.
        arguments: For the node, to stand behind --ros-args.

    Raises:
        RuntimeError: The node does not get ready; the message says why.
    """
    os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'LOCALHOST'
    os.environ['ROS_DOMAIN_ID'] = str(1 + os.getpid() % 100)
    context = Context()
    rclpy.init(context=context)
    try:
        with _process(arguments) as node:
            return _Player(context, scenes).play(node)
    finally:
        rclpy.shutdown(context=context)


@contextlib.contextmanager
def _process(arguments: list[str]) -> 'Iterator[subprocess.Popen[str]]':
    """The node as a process, which ends with the block."""
    command = [sys.executable, '-m', 'line_feature_node', '--ros-args', '--log-level', 'warn', *RELIABLE, *arguments]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
    try:
        yield process
    finally:
        process.terminate()
        try:
            process.communicate(timeout=10)
        except subprocess.TimeoutExpired:
            process.kill()
            process.communicate()


class _Player:
    """Publishes frames and receives results."""

    def __init__(self, context: Context, scenes: list[Scene]) -> None:
        self._scenes = scenes
        self._outcome = Outcome(len(scenes))
        self._sent: dict[int, float] = {}
        self._told = False
        self._node = rclpy.create_node('line_feature_demo', context=context)
        self._executor = SingleThreadedExecutor(context=context)
        self._executor.add_node(self._node)
        self._images = self._node.create_publisher(Image, 'image', QoSProfile(depth=30))
        self._node.create_subscription(PointCloud2, 'line_feature_node/segments', self._on_segments, 5)
        # Raw ones would fill the shared memory of the default transport, and make the segments late.
        self._node.create_subscription(
            CompressedImage, 'line_feature_node/overlay/compressed', self._on_overlay, 5)
        self._node.create_subscription(DiagnosticArray, '/diagnostics', self._on_diagnostics, 5)

    def play(self, node: 'subprocess.Popen[str]') -> Outcome:
        """Wait for the node, publish the frames at their rate, and wait for the last results."""
        try:
            self._wait_for(node)
            begin = time.monotonic()
            for number, scene in enumerate(self._scenes):
                self._wait_until(begin + number / RATE)
                self._publish(number, scene)
            self._spin(lambda: not self._sent, GRACE)
            self._told = False
            self._spin(lambda: self._told, GRACE)
            return self._outcome
        finally:
            self._executor.shutdown()
            self._node.destroy_node()

    def _wait_for(self, node: 'subprocess.Popen[str]') -> None:
        self._spin(lambda: self._images.get_subscription_count() > 0 or node.poll() is not None, PATIENCE)
        if node.poll() is not None:
            raise RuntimeError((node.stderr and node.stderr.read().strip()) or f'the node ended with {node.returncode}')
        if not self._images.get_subscription_count():
            raise RuntimeError(f'the node was not ready within {PATIENCE:.0f} s')

    def _wait_until(self, due: float) -> None:
        self._spin(lambda: time.monotonic() >= due, GRACE)

    def _spin(self, done: Callable[[], bool], patience: float) -> None:
        end = time.monotonic() + patience
        while not done() and time.monotonic() < end:
            self._executor.spin_once(timeout_sec=0.001)

    def _publish(self, number: int, scene: Scene) -> None:
        header = Header(stamp=Time(sec=number, nanosec=0), frame_id='camera')
        message = MESSAGES.image(np.asarray(cv2.cvtColor(scene.image, cv2.COLOR_BGR2GRAY), np.uint8), header)
        self._sent[number] = time.monotonic()
        self._images.publish(message)

    def _on_segments(self, message: PointCloud2) -> None:
        number = message.header.stamp.sec
        segments = segments_of(message)
        self._outcome.latencies.append(time.monotonic() - self._sent.pop(number))
        self._outcome.segments.append(len(segments))
        scene = self._scenes[number]
        self._outcome.agreements.append(compare(end_points(segments), scene.truth, scene.weak))

    def _on_overlay(self, message: CompressedImage) -> None:
        self._outcome.overlay = np.asarray(decode(bytes(message.data)), np.uint8)

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        if self._outcome.segments:
            status = message.status[0]
            values = {value.key: value.value for value in status.values}
            self._outcome.health = f'{Level(status.level[0]).name}: {status.message}'
            self._told = True
            self._outcome.counts = ', '.join(f'{values[f"frames {name}"]} {name}' for name in COUNTED)
