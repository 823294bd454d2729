"""The node in this process: its own context and executor for each test, no launch, no sleeping."""

import array
import gc
import re
import threading
import time
from pathlib import Path
from xml.etree import ElementTree

import cv2
import numpy as np
import pytest
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from lifecycle_msgs.msg import State, Transition
from lifecycle_msgs.srv import ChangeState, GetState
from rcl_interfaces.msg import Log, ParameterValue
from rcl_interfaces.msg import Parameter as ParameterMessage
from rcl_interfaces.srv import SetParameters
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.parameter import Parameter
from rclpy.parameter_client import AsyncParameterClient
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from rosgraph_msgs.msg import Clock as ClockMessage
from sensor_msgs.msg import CompressedImage, Image, PointCloud2
from visualization_msgs.msg import ImageMarker

from line_feature_node import node as node_module
from line_feature_node.core import STEPS, LineFeatureExtractor, Parameters, end_points
from line_feature_node.files import FOLDERS
from line_feature_node.images import compressed_image_of
from line_feature_node.messages import segments_of
from line_feature_node.node import OUTPUTS, ConfigurationError, LineFeatureNode, spin

#: Seconds after which something that a test waits for will not come any more.
DEADLINE = 10.0
NAME = '/line_feature_node'
SEGMENTS, MARKERS, OVERLAY, COMPRESSED, EDGES = (topic.replace('~', NAME) for topic in OUTPUTS)
RELIABLE, BEST_EFFORT = ReliabilityPolicy.RELIABLE, ReliabilityPolicy.BEST_EFFORT


def picture(shift=0):
    """A bright rectangle on dark ground."""
    pixels = np.full((60, 80), 30, np.uint8)
    pixels[15:45, 20 + shift:60] = 200
    return pixels


def image(pixels, encoding='mono8', stamp=(12, 345), frame_id='camera', **changes):
    """An Image; `changes` are fields that are to be wrong."""
    message = Image(
        height=pixels.shape[0], width=pixels.shape[1], encoding=encoding, step=pixels[0].nbytes,
        data=array.array('B', pixels.tobytes()))
    message.header.stamp.sec, message.header.stamp.nanosec = stamp
    message.header.frame_id = frame_id
    for name, value in changes.items():
        setattr(message, name, value)
    return message


def jpeg(pixels, share=1.0, form='mono8; jpeg compressed '):
    data = cv2.imencode('.jpg', pixels)[1].tobytes()
    message = CompressedImage(format=form, data=array.array('B', data[:int(len(data) * share)]))
    message.header.stamp.sec, message.header.frame_id = 7, 'camera'
    return message


def expected(pixels, mask=None, **parameters):
    return LineFeatureExtractor(Parameters(**parameters)).extract(pixels, mask)


class Bench:
    """Nodes under test and a peer that plays the robot around them, in one context, worked on by one executor."""

    def __init__(self, capfd):
        self._capfd = capfd
        self._log = ''
        self.context = Context()
        rclpy.init(context=self.context, args=['--ros-args', '--disable-external-lib-logs'])
        self.executor = SingleThreadedExecutor(context=self.context)
        self.nodes = []
        self.peer = rclpy.create_node('peer', context=self.context)
        self.add(self.peer)

    def add(self, node):
        self.nodes.append(node)
        self.executor.add_node(node)
        return node

    def node(self, *arguments, health_timer=False, node_name='line_feature_node', **parameters):
        """A node with overrides of parameters, and arguments as behind --ros-args.

        Its health is told when a test asks for it, so that none comes between the frames of a test.
        """
        overrides = [Parameter(name, value=value) for name, value in parameters.items()]
        cli_args = ['--ros-args', *arguments] if arguments else []
        node = LineFeatureNode(
            node_name, context=self.context, parameter_overrides=overrides, use_global_arguments=False,
            cli_args=cli_args)
        if not health_timer:
            for timer in node.timers:
                timer.cancel()
        return self.add(node)

    def until(self, condition, what, deadline=DEADLINE):
        """Work until something is the case."""
        end = time.monotonic() + deadline
        while not condition():
            self.executor.spin_once(timeout_sec=0.05)
            if time.monotonic() > end:
                pytest.fail(f'{what}: waited {deadline:g} s for it; the log was\n{self.log}')

    def work_off(self, quiet=20):
        """Work until nothing more is to be done."""
        for _ in range(quiet):
            self.executor.spin_once(timeout_sec=0)

    @property
    def log(self):
        captured = self._capfd.readouterr()
        self._log += captured.out + captured.err
        return self._log

    def warnings(self):
        """Of the nodes under test; rclpy has some for the peer, too."""
        lines = [line for line in self.log.splitlines() if re.match(r'\[(WARN|ERROR|FATAL)\]', line)]
        return [line for line in lines if '[peer]' not in line]

    def listen(self, topic=SEGMENTS, kind=PointCloud2, matched=True, **qos):
        """Messages of a topic, in a list that grows; once the publisher is known if it is to be `matched`."""
        messages = Messages()
        messages.subscription = self.peer.create_subscription(
            kind, topic, messages.append, QoSProfile(**{'depth': 10, **qos}))
        if matched:
            self.until(messages.subscription.get_publisher_count, f'publisher of {topic}')
        return messages

    def leave(self, messages):
        self.peer.destroy_subscription(messages.subscription)

    def camera(self, topic='/image', kind=Image, reliability=RELIABLE):
        """A publisher of images that the nodes do not know yet."""
        return self.peer.create_publisher(kind, topic, QoSProfile(depth=10, reliability=reliability))

    def connect(self, camera, node, publishers=1):
        """Work until a node and cameras know of each other."""
        self.until(lambda: camera.get_subscription_count() and node._subscription is not None
                   and node._subscription.get_publisher_count() == publishers, f'connection by {camera.topic_name}')

    def show(self, camera, node, *messages):
        """Publish images, each when the one before it was dealt with."""
        self.connect(camera, node)
        for message in messages:
            target = node._monitor.counts.received + 1
            camera.publish(message)
            self.until(lambda target=target: node._monitor.counts.received >= target, 'image')

    def result(self, camera, node, messages, *images):
        """The segments of images, published one after the other."""
        found = []
        for message in images:
            count = len(messages) + 1
            self.show(camera, node, message)
            self.until(lambda count=count: len(messages) >= count, 'result')
            found.append(messages[-1])
        return found if len(found) > 1 else found[0]

    def health(self, node):
        """Level, sentence and figures of a node as they come out on /diagnostics."""
        messages = self.listen('/diagnostics', DiagnosticArray)
        node._publish_diagnostics()
        self.until(lambda: messages, 'diagnostics')
        self.leave(messages)
        [status] = messages[-1].status
        return status.level, status.message, {value.key: value.value for value in status.values}

    def wait(self, future):
        self.until(future.done, 'answer')
        return future.result()

    def parameters(self, name=NAME):
        client = AsyncParameterClient(self.peer, name)
        self.until(client.services_are_ready, f'parameters of {name}')
        return client

    def set(self, client, **values):
        """Set parameters together over the service; the reason of a refusal, '' when they were set."""
        changes = [Parameter(name, value=value) for name, value in values.items()]
        answer = self.wait(client.set_parameters_atomically(changes)).result
        assert answer.successful == (answer.reason == '')
        return answer.reason

    def client(self, kind, name):
        client = self.peer.create_client(kind, name)
        self.until(client.service_is_ready, f'service {name}')
        return client

    def call(self, kind, name, request):
        return self.wait(self.client(kind, name).call_async(request))

    def change(self, transition, name=NAME, label=''):
        request = ChangeState.Request(transition=Transition(id=transition, label=label))
        return self.call(ChangeState, f'{name}/change_state', request).success

    def state(self, name=NAME):
        return self.call(GetState, f'{name}/get_state', GetState.Request()).current_state.id

    def close(self):
        self.executor.shutdown()
        for node in self.nodes:
            node.destroy_node()
        self.context.try_shutdown()


class Messages(list):
    subscription = None


@pytest.fixture
def counted(monkeypatch):
    """Counts what a node publishes, by topic."""
    def count(node):
        counts = dict.fromkeys(OUTPUTS, 0)

        def counting(topic, publish):
            def publish_and_count(message):
                counts[topic] += 1
                publish(message)
            return publish_and_count

        for topic, publisher in node._publishers_of.items():
            monkeypatch.setattr(publisher, 'publish', counting(topic, publisher.publish))
        return counts

    return count


# Results

def test_segments_are_those_of_the_extractor_to_the_bit(bench):
    node, camera, segments = bench.node(), bench.camera(), bench.listen()
    pixels = np.random.default_rng(1).normal(picture(), 8).clip(0, 255).astype(np.uint8)
    message = bench.result(camera, node, segments, image(pixels))
    assert len(expected(pixels)) >= 4
    assert segments_of(message).tobytes() == expected(pixels).tobytes()


def test_segments_have_the_whole_header_of_their_image(bench):
    node, camera, segments = bench.node(), bench.camera(), bench.listen()
    header = bench.result(camera, node, segments, image(picture(), stamp=(2**31 - 1, 999999999), frame_id='a/b')).header
    assert (header.stamp.sec, header.stamp.nanosec, header.frame_id) == (2**31 - 1, 999999999, 'a/b')


def test_every_output_has_the_whole_header(bench):
    node, camera = bench.node(), bench.camera()
    outputs = [bench.listen(topic.replace('~', NAME), kind) for topic, kind in OUTPUTS.items()]
    bench.show(camera, node, image(picture()))
    bench.until(lambda: all(outputs), 'all outputs')
    for [message] in outputs:
        header = message.header
        assert (header.stamp.sec, header.stamp.nanosec, header.frame_id) == (12, 345, 'camera')


def test_picture_without_segments_is_answered_by_none(bench):
    node, camera, segments = bench.node(), bench.camera(), bench.listen()
    message = bench.result(camera, node, segments, image(np.full((60, 80), 90, np.uint8)))
    assert (message.width, len(message.data), len(segments_of(message))) == (0, 0, 0)
    assert message.header.frame_id == 'camera'


def test_markers_are_the_lines_of_the_segments(bench):
    node, camera, markers = bench.node(), bench.camera(), bench.listen(MARKERS, ImageMarker)
    message = bench.result(camera, node, markers, image(picture()))
    segments = expected(picture())
    assert len(segments) > 0
    ends = [(point.x, point.y) for point in message.points]
    np.testing.assert_array_equal(ends[::2], np.stack([segments['x1'], segments['y1']], -1))
    np.testing.assert_array_equal(ends[1::2], np.stack([segments['x2'], segments['y2']], -1))


def pixels_of(message, channels):
    return np.frombuffer(message.data, np.uint8).reshape(message.height, message.width, channels)


def test_overlay_is_a_picture_of_the_same_size_with_colours(bench):
    node, camera, overlay = bench.node(), bench.camera(), bench.listen(OVERLAY, Image)
    message = bench.result(camera, node, overlay, image(picture()))
    assert (message.height, message.width, message.encoding, message.step) == (60, 80, 'bgr8', 240)
    pixels = pixels_of(message, 3).astype(int)
    assert np.ptp(pixels[30, 18:23], axis=-1).max() > 50  # the left side of the rectangle
    assert np.ptp(pixels[50:], axis=-1).max() == 0


@pytest.mark.parametrize(('pixels', 'encoding'), [
    (picture().astype(np.uint16) * 257, 'mono16'), (picture().astype(np.float32), '32FC1'),
    (np.repeat(picture()[..., None], 3, -1), 'rgb8')])
def test_overlay_shows_pictures_of_every_kind(bench, pixels, encoding):
    node, camera, overlay = bench.node(), bench.camera(), bench.listen(OVERLAY, Image)
    message = bench.result(camera, node, overlay, image(pixels, encoding))
    assert (message.encoding, message.height, message.width) == ('bgr8', 60, 80)
    np.testing.assert_allclose(pixels_of(message, 3)[30, 30:50], 0.7 * 200, atol=1)


def test_compressed_overlay_is_a_jpeg_of_the_overlay(bench):
    node, camera = bench.node(), bench.camera()
    overlay, compressed = bench.listen(OVERLAY, Image), bench.listen(COMPRESSED, CompressedImage)
    bench.show(camera, node, image(picture()))
    bench.until(lambda: overlay and compressed, 'both overlays')
    assert bytes(compressed[0].data[:3]) == b'\xff\xd8\xff'
    assert 'jpeg' in compressed[0].format
    decoded = cv2.imdecode(np.frombuffer(compressed[0].data, np.uint8), cv2.IMREAD_COLOR)
    assert np.abs(decoded.astype(int) - pixels_of(overlay[0], 3)).mean() < 12


def test_quality_of_the_compressed_overlay_can_be_chosen(bench):
    node, camera, compressed = bench.node(), bench.camera(), bench.listen(COMPRESSED, CompressedImage)
    sizes = []
    for quality in (10, 95):
        assert node.set_parameters([Parameter('jpeg_quality', value=quality)])[0].successful
        sizes.append(len(bench.result(camera, node, compressed, image(picture())).data))
    assert sizes[0] < sizes[1]


def test_edges_are_those_of_the_extractor(bench):
    node, camera, edges = bench.node(), bench.camera(), bench.listen(EDGES, Image)
    message = bench.result(camera, node, edges, image(picture()))
    assert (message.height, message.width, message.encoding, message.step) == (60, 80, 'mono8', 80)
    extractor = LineFeatureExtractor()
    extractor.extract(picture())
    np.testing.assert_array_equal(pixels_of(message, 1)[..., 0], extractor.edges())
    assert extractor.edges().any()


@pytest.mark.parametrize('topic', OUTPUTS)
def test_only_what_is_listened_to_is_published(bench, counted, topic):
    node, camera = bench.node(), bench.camera()
    bench.listen(topic.replace('~', NAME), OUTPUTS[topic])
    counts = counted(node)
    bench.show(camera, node, image(picture()), image(picture()))
    bench.until(lambda: counts[topic] == 2, topic)
    assert {name for name, count in counts.items() if count} == {topic}


def test_nothing_is_published_nor_drawn_while_nobody_listens(bench, counted, monkeypatch):
    node, camera = bench.node(lazy=False), bench.camera()
    counts = counted(node)
    monkeypatch.setattr(node_module, 'draw_overlay', lambda *_: pytest.fail('drawn'))
    bench.show(camera, node, image(picture()))
    assert node._monitor.counts.processed == 1
    assert not any(counts.values())


def test_overlay_is_drawn_once_for_both_topics(bench, monkeypatch):
    calls = []
    draw = node_module.draw_overlay
    monkeypatch.setattr(node_module, 'draw_overlay', lambda *arguments: calls.append(1) or draw(*arguments))
    node, camera = bench.node(), bench.camera()
    overlay, compressed = bench.listen(OVERLAY, Image), bench.listen(COMPRESSED, CompressedImage)
    bench.show(camera, node, image(picture()))
    bench.until(lambda: overlay and compressed, 'both overlays')
    assert len(calls) == 1


def test_message_is_not_changed_by_what_is_made_of_it(bench):
    """The image that is extracted from is a view of the message."""
    node, camera, segments = bench.node(), bench.camera(), bench.listen()
    bench.listen(OVERLAY, Image)
    first, second = bench.result(camera, node, segments, image(picture()), image(picture()))
    assert segments_of(first).tobytes() == segments_of(second).tobytes()


@pytest.mark.parametrize('shape', [(1, 1), (1, 9), (9, 1), (3, 3), (1, 3000)])
def test_every_output_comes_of_pictures_of_any_shape(bench, shape):
    node, camera = bench.node(), bench.camera()
    outputs = [bench.listen(topic.replace('~', NAME), kind) for topic, kind in OUTPUTS.items()]
    bench.show(camera, node, image(np.full(shape, 9, np.uint8)))
    bench.until(lambda: all(outputs), 'all outputs')
    assert node._monitor.counts.processed == 1


def test_picture_that_is_too_wide_for_a_jpeg_does_not_end_the_work(bench):
    """That of a line-scan camera, say; a JPEG has 65500 columns at most."""
    node, camera, segments = bench.node(), bench.camera(), bench.listen()
    bench.listen(COMPRESSED, CompressedImage)
    bench.result(camera, node, segments, image(np.full((2, 70000), 9, np.uint8)), image(picture()))
    assert len(segments) == 2


# Encodings and transports

@pytest.mark.parametrize('encoding', ['rgb8', 'bgr8', 'rgba8', 'mono16', '32FC1', 'yuv422'])
def test_encodings_come_through_the_topic(bench, encoding):
    node, camera, segments = bench.node(), bench.camera(), bench.listen()
    grey = picture()
    pixels = {
        'mono16': grey.astype(np.uint16) * 257, '32FC1': grey.astype(np.float32),
        'yuv422': np.stack([np.full_like(grey, 128), grey], -1), 'rgba8': np.repeat(grey[..., None], 4, -1),
    }.get(encoding, np.repeat(grey[..., None], 3, -1))
    found = segments_of(bench.result(camera, node, segments, image(pixels, encoding)))
    assert len(found) == len(expected(grey)) > 0
    # Which end of a vertical line comes first hangs on the last digit.
    np.testing.assert_allclose(*(np.sort(end_points(segments)[:, [[0, 2], [1, 3]]], -1)
                                 for segments in (found, expected(grey))), atol=1e-3)


@pytest.mark.parametrize(('remapping', 'topic'), [
    ([], '/image/compressed'), (['-r', 'image:=/front/image_raw'], '/front/image_raw/compressed'),
    (['-r', '__ns:=/robot'], '/robot/image/compressed')])
def test_compressed_images_come_from_the_topic_beside_the_raw_one(bench, remapping, topic):
    node, camera = bench.node(*remapping, image_transport='compressed'), bench.camera(topic, CompressedImage)
    segments = bench.listen(f'{node.get_fully_qualified_name()}/segments')
    message = bench.result(camera, node, segments, jpeg(picture()))
    assert segments_of(message).tobytes() == expected(compressed_image_of(jpeg(picture()))).tobytes()
    assert message.header.frame_id == 'camera'
    assert node.count_subscribers(topic.removesuffix('/compressed')) == 0


def test_image_topic_can_be_remapped(bench):
    node, camera = bench.node('-r', 'image:=/front/image_raw'), bench.camera('/front/image_raw')
    segments = bench.listen()
    assert segments_of(bench.result(camera, node, segments, image(picture()))).size > 0
    assert '/front/image_raw' in bench.log


def test_nodes_in_namespaces_do_not_mix_their_images(bench):
    left, right = bench.node('-r', '__ns:=/left'), bench.node('-r', '__ns:=/right')
    for node, side, pixels in ((left, '/left', picture()), (right, '/right', picture(20))):
        camera, segments = bench.camera(f'{side}/image'), bench.listen(f'{side}{NAME}/segments')
        message = bench.result(camera, node, segments, image(pixels, frame_id=side))
        assert message.header.frame_id == side
        assert segments_of(message).tobytes() == expected(pixels).tobytes()
        assert len(segments) == 1
    assert (left._monitor.counts.received, right._monitor.counts.received) == (1, 1)


# Lazy subscription

def subscribers(bench, topic='/image'):
    return bench.peer.count_subscribers(topic)


def test_images_are_subscribed_to_when_somebody_listens_and_no_longer(bench):
    node = bench.node()
    bench.work_off()
    assert subscribers(bench) == 0
    segments, overlay = bench.listen(), bench.listen(OVERLAY, Image)
    bench.until(lambda: subscribers(bench) == 1, 'subscription')
    bench.leave(segments)
    bench.until(lambda: node._publishers_of['~/segments'].get_subscription_count() == 0, 'listener leaving')
    bench.work_off()
    assert subscribers(bench) == 1
    bench.leave(overlay)
    bench.until(lambda: subscribers(bench) == 0, 'end of the subscription')
    bench.listen()
    bench.until(lambda: subscribers(bench) == 1, 'subscription again')


@pytest.mark.parametrize('topic', OUTPUTS)
def test_a_listener_of_any_output_is_enough(bench, topic):
    bench.node()
    bench.listen(topic.replace('~', NAME), OUTPUTS[topic])
    bench.until(lambda: subscribers(bench) == 1, 'subscription')


def test_lazy_node_says_what_it_waits_for(bench):
    bench.node('-r', 'image:=/front/image_raw')
    assert 'ready; waits for a subscriber of /line_feature_node/segments' in bench.log
    assert '/front/image_raw (lazy)' in bench.log
    segments = bench.listen()
    bench.until(lambda: 'ready; waits for images on /front/image_raw (best_effort, depth 1)' in bench.log, 'its word')
    bench.leave(segments)
    bench.until(lambda: 'nobody listens any more: unsubscribed from the images' in bench.log, 'its word')


def test_node_that_is_not_lazy_subscribes_at_once(bench):
    bench.node(lazy=False)
    assert 'ready; waits for images on /image (best_effort, depth 1)' in bench.log
    assert 'lazy' not in bench.log
    bench.until(lambda: subscribers(bench) == 1, 'subscription')


def test_lazy_can_be_changed_while_running(bench):
    bench.node()
    client = bench.parameters()
    assert subscribers(bench) == 0
    assert bench.set(client, lazy=False) == ''
    bench.until(lambda: subscribers(bench) == 1, 'subscription')
    assert bench.set(client, lazy=True) == ''
    bench.until(lambda: subscribers(bench) == 0, 'end of the subscription')


def test_kernels_are_compiled_before_the_node_says_that_it_is_ready(bench):
    bench.node()
    assert bench.log.index('kernels are ready') < bench.log.index('ready; waits')


def test_first_image_is_told_once(bench):
    node, camera, segments = bench.node(), bench.camera(), bench.listen()
    bench.result(camera, node, segments, image(picture()), image(picture()))
    assert bench.log.count(f'first image: 80×60 mono8, {len(expected(picture()))} segments') == 1
    assert bench.log.count('first image') == 1


# Bad frames

def float_picture(value):
    pixels = picture().astype(np.float32)
    pixels[:] = value
    return pixels


BAD = {
    'too little data': (image(picture(), data=array.array('B', bytes(100))), '100 bytes of data: expected 60 rows'),
    'too much data': (image(picture(), data=array.array('B', bytes(9999))), '9999 bytes of data'),
    'no data': (image(picture(), data=array.array('B')), '0 bytes of data'),
    'height 0': (image(picture(), height=0), 'an image of 80×0 pixels'),
    'width 0': (image(picture(), width=0), 'an image of 0×60 pixels'),
    'all sizes 0': (Image(encoding='mono8'), 'an image of 0×0 pixels'),
    'step 0': (image(picture(), step=0), 'step is 0'),
    'absurd height': (image(picture(), height=2**32 - 1), '4800 bytes of data: expected 4294967295 rows'),
    'absurd width': (image(picture(), width=2**32 - 1), 'step is 80: expected 4294967295 bytes'),
    'absurd step': (image(picture(), step=2**32 - 1), 'expected 60 rows of 4294967295'),
    'unknown encoding': (image(picture(), 'yuv444'), "unknown encoding 'yuv444': expected one of mono8"),
    'empty message': (Image(), "unknown encoding ''"),
    'all NaN': (image(float_picture(np.nan), '32FC1'), 'image must have finite pixels, got none'),
}


def check_bad_frame(bench, node, camera, segments, bad, good, reason):
    """It is counted, logged and in the diagnostics; and the next good frame is processed."""
    topic = camera.topic_name
    stamp = bad.header.stamp
    bench.show(camera, node, bad)
    level, summary, figures = bench.health(node)
    assert level == b'\2'
    assert summary.startswith('no image can be processed: ')
    assert reason in summary
    assert reason in figures['last error']
    assert (figures['frames failed'], figures['frames processed']) == ('1', '0')
    [line] = bench.warnings()
    assert f'image on {topic} with stamp {stamp.sec}.{stamp.nanosec:09d} is left out: ' in line
    assert reason in line
    message = bench.result(camera, node, segments, good)
    assert len(segments) == 1
    assert segments_of(message).size > 0
    level, _, figures = bench.health(node)
    assert level == b'\0'
    assert [figures[f'frames {name}'] for name in ('received', 'processed', 'failed')] == ['2', '1', '1']


@pytest.mark.parametrize('kind', BAD)
def test_bad_frame_is_told_of_and_the_next_good_one_is_processed(bench, kind):
    bad, reason = BAD[kind]
    node, camera, segments = bench.node(), bench.camera(), bench.listen()
    check_bad_frame(bench, node, camera, segments, bad, image(picture()), reason)


@pytest.mark.parametrize(('bad', 'reason'), [
    (jpeg(picture(), 0.5), 'a part of an image'), (jpeg(picture(), 0), 'no data'),
    (CompressedImage(format='jpeg', data=array.array('B', b'nonsense')), 'not an image'),
    (CompressedImage(format='16UC1; compressedDepth rvl', data=array.array('B', bytes(50))), 'is not supported'),
    (CompressedImage(format='h264', data=array.array('B', bytes(50))), 'not an image')])
def test_bad_compressed_frame_is_told_of_and_the_next_good_one_is_processed(bench, bad, reason):
    node, camera = bench.node(image_transport='compressed'), bench.camera('/image/compressed', CompressedImage)
    check_bad_frame(bench, node, camera, bench.listen(), bad, jpeg(picture()), reason)


def test_bad_frames_are_logged_once_in_a_while(bench):
    """Thirty a second would fill the log."""
    node, camera = bench.node(lazy=False), bench.camera()
    bench.show(camera, node, *[image(picture(), 'yuv444')] * 5)
    assert node._monitor.counts.failed == 5
    assert len(bench.warnings()) == 1


def test_bad_frames_among_good_ones_are_a_warning(bench):
    node, camera = bench.node(lazy=False), bench.camera()
    bench.show(camera, node, image(picture()), image(picture(), step=0), image(picture()))
    level, summary, figures = bench.health(node)
    assert level == b'\1'
    assert summary.startswith('1 of 3 images failed: step is 0')
    assert figures['failed: step is 0'] == '1'


def test_unknown_pixels_are_masked(bench):
    """A depth camera: no edge around what it could not measure."""
    node, camera, segments = bench.node(), bench.camera(), bench.listen()
    pixels = picture().astype(np.float32)
    pixels[25:35, 5:12] = np.nan
    found = segments_of(bench.result(camera, node, segments, image(pixels, '32FC1')))
    assert found.tobytes() == expected(pixels, np.isfinite(pixels)).tobytes()
    assert len(found) == len(expected(picture())) > 0
    assert node._monitor.counts.failed == 0


# Masks

@pytest.fixture
def mask_file(tmp_path):
    """A mask that leaves the left half of the picture."""
    mask = np.zeros((60, 80), np.uint8)
    mask[:, :40] = 255
    path = tmp_path / 'mask.png'
    cv2.imwrite(str(path), mask)
    return path


def test_no_edges_are_found_where_the_mask_is_black(bench, mask_file):
    node, camera, segments = bench.node(mask_file=str(mask_file)), bench.camera(), bench.listen()
    found = segments_of(bench.result(camera, node, segments, image(picture())))
    mask = np.arange(80) < np.full((60, 1), 40)
    assert found.tobytes() == expected(picture(), mask).tobytes()
    assert found.size > 0
    assert max(found['x1'].max(), found['x2'].max()) < 40 < expected(picture())['x2'].max()


def test_mask_and_unknown_pixels_count_together(bench, mask_file):
    node, camera, segments = bench.node(mask_file=str(mask_file)), bench.camera(), bench.listen()
    pixels = picture().astype(np.float32)
    pixels[25:35, 5:12] = np.nan
    found = segments_of(bench.result(camera, node, segments, image(pixels, '32FC1')))
    assert found.tobytes() == expected(pixels, np.isfinite(pixels) & (np.arange(80) < 40)).tobytes()
    assert found.size > 0


@pytest.mark.parametrize('value', [0, np.nan])
def test_mask_of_another_size_is_a_reason_for_each_frame(bench, mask_file, value):
    """Also where the picture has unknown pixels."""
    node, camera, segments = bench.node(mask_file=str(mask_file)), bench.camera(), bench.listen()
    pixels = np.full((30, 40), 9, np.float32)
    pixels[3, 4] = value
    check_bad_frame(bench, node, camera, segments, image(pixels, '32FC1'), image(picture()),
                    'an image of 40×30 pixels: mask_file has 80×60')


@pytest.mark.parametrize('content', [None, b'', b'no picture'])
def test_mask_that_cannot_be_read_keeps_the_node_from_starting(bench, tmp_path, content):
    path = tmp_path / 'none.png'
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(ConfigurationError, match=f'mask_file {path}: '):
        bench.node(mask_file=str(path))


def test_mask_outside_of_the_folders_of_the_operator_keeps_the_node_from_starting(bench, mask_file, monkeypatch):
    monkeypatch.setenv(FOLDERS, str(mask_file.parent / 'masks'))
    with pytest.raises(ConfigurationError, match=f'mask_file {mask_file}: .* allows files in '):
        bench.node(mask_file=str(mask_file))
    monkeypatch.setenv(FOLDERS, str(mask_file.parent))
    assert bench.node(mask_file=str(mask_file))._mask is not None


# Hints

def test_hint_on_the_range_of_16_bits_is_logged_once(bench, monkeypatch):
    monkeypatch.setattr(node_module, 'HINT_EVERY', 2)
    node, camera = bench.node(lazy=False), bench.camera()
    bench.show(camera, node, *[image(picture().astype(np.uint16) * 20, 'mono16')] * 5)
    assert bench.log.count('such as intensity_max 4095') == 1
    assert 'image on /image: pixels from 600 to 4000' in bench.log


@pytest.mark.parametrize(('pixels', 'encoding', 'parameters'), [
    (picture().astype(np.uint16) * 257, 'mono16', {}), (picture(), 'mono8', {}),
    (picture().astype(np.uint16) * 20, 'mono16', {'intensity_max': 4095.0})])
def test_no_hint_where_there_is_nothing_to_hint_at(bench, pixels, encoding, parameters):
    node, camera = bench.node(lazy=False, **parameters), bench.camera()
    bench.show(camera, node, image(pixels, encoding))
    assert node._monitor.counts.processed == 1
    assert 'intensity_max' not in bench.log


def test_hint_on_the_range_of_16_bits_comes_in_either_byte_order(bench):
    node, camera = bench.node(lazy=False), bench.camera()
    bench.show(camera, node, image((picture().astype('>u2') * 20).astype('>u2'), 'mono16', is_bigendian=1))
    assert node._monitor.counts.processed == 1
    assert 'such as intensity_max 4095' in bench.log


# Frames that are missed

def test_only_the_newest_of_waiting_frames_is_processed_and_the_others_are_counted(bench):
    node, camera, segments = bench.node(), bench.camera(), bench.listen()
    bench.result(camera, node, segments, image(picture()))
    for shift in (1, 3, 5, 7, 9):
        camera.publish(image(picture(shift), stamp=(shift, 0)))
    bench.until(lambda: segments[-1].header.stamp.sec == 9, 'the newest frame')
    assert len(segments) == 2
    assert segments_of(segments[-1]).tobytes() == expected(picture(9)).tobytes()
    level, summary, figures = bench.health(node)
    assert [figures[f'frames {name}'] for name in ('received', 'processed', 'dropped')] == ['2', '2', '4']
    assert (level, summary) == (b'\1', '4 of 6 images were dropped')


def test_frames_in_time_are_not_dropped(bench):
    node, camera = bench.node(lazy=False), bench.camera()
    bench.show(camera, node, *[image(picture())] * 20)
    assert vars(node._monitor.counts) == {'received': 20, 'processed': 20, 'dropped': 0, 'failed': 0}


def test_several_publishers_drop_nothing(bench):
    node, first, second = bench.node(lazy=False), bench.camera(), bench.camera()
    bench.connect(first, node, publishers=2)
    bench.connect(second, node, publishers=2)
    for count, camera in enumerate((first, first, first, second, first, second, second), 1):
        camera.publish(image(picture()))
        bench.until(lambda count=count: node._monitor.counts.received == count, 'image')
    assert node._monitor.counts.dropped == 0


def test_publisher_that_was_restarted_drops_nothing(bench):
    node, camera = bench.node(lazy=False), bench.camera()
    bench.show(camera, node, *[image(picture())] * 3)
    bench.peer.destroy_publisher(camera)
    bench.until(lambda: node._subscription.get_publisher_count() == 0, 'publisher leaving')
    again = bench.camera()
    bench.show(again, node, *[image(picture())] * 5)
    assert vars(node._monitor.counts) == {'received': 8, 'processed': 8, 'dropped': 0, 'failed': 0}


def test_frames_that_nobody_wanted_were_not_dropped(bench):
    """The sequence goes on while a lazy node does not listen."""
    node, camera, segments = bench.node(), bench.camera(), bench.listen()
    bench.show(camera, node, image(picture()))
    bench.leave(segments)
    bench.until(lambda: camera.get_subscription_count() == 0, 'end of the subscription')
    for _ in range(5):
        camera.publish(image(picture()))
    segments = bench.listen()
    bench.result(camera, node, segments, image(picture()))
    assert node._monitor.counts.dropped == 0


# Parameters while running

def test_parameters_are_taken_up_between_two_frames(bench):
    node, camera, segments = bench.node(), bench.camera(), bench.listen()
    client = bench.parameters()
    pixels = np.random.default_rng(1).normal(picture(), 8).clip(0, 255).astype(np.uint8)
    first = bench.result(camera, node, segments, image(pixels))
    assert bench.set(client, T1=30.0, T2=20.0, alpha=0.5) == ''
    second = bench.result(camera, node, segments, image(pixels))
    assert segments_of(first).tobytes() == expected(pixels).tobytes()
    assert segments_of(second).tobytes() == expected(pixels, T1=30.0, T2=20.0, alpha=0.5).tobytes()
    assert segments_of(first).tobytes() != segments_of(second).tobytes()


def test_parameters_at_the_start_are_used(bench):
    node, camera, segments = bench.node(max_segments=2, theta_min=-0.5, theta_max=0.5), bench.camera(), bench.listen()
    found = segments_of(bench.result(camera, node, segments, image(picture())))
    assert found.tobytes() == expected(picture(), max_segments=2, theta_min=-0.5, theta_max=0.5).tobytes()
    assert found.size == 2


def test_region_of_interest_and_scale_give_segments_in_pixels_of_the_full_picture(bench):
    node, camera, segments = bench.node(roi=[10, 5, 60, 50], scale=0.5), bench.camera(), bench.listen()
    found = segments_of(bench.result(camera, node, segments, image(picture())))
    assert found.tobytes() == expected(picture(), roi=(10, 5, 60, 50), scale=0.5).tobytes()
    vertical = found[found['code'] == 1]
    np.testing.assert_allclose(np.sort(vertical['x']), [19.5, 59.5], atol=1)


@pytest.mark.parametrize('kind', [
    ('lazy', False), ('autostart', False), ('image_transport', 'compressed'), ('mask_file', 'x.png')])
def test_constant_parameters_stay_as_they_were_at_the_start(bench, kind):
    name, value = kind
    node = bench.node()
    reason = bench.set(bench.parameters(), **{name: value})
    assert ('read-only' in reason) == (name != 'lazy')
    assert (getattr(node._settings.options, name) == value) == (name == 'lazy')


# Quality of service

def qos_at(bench, topic, node, end):
    """As others see it."""
    infos = getattr(bench.peer, f'get_{end}s_info_by_topic')
    found = []

    def known():
        found[:] = [info for info in infos(topic) if info.node_name == node.get_name()]
        return found

    bench.until(known, f'{end} of {topic}')
    return found[0].qos_profile


def test_images_are_asked_for_as_sensor_data_and_results_are_reliable(bench):
    node = bench.node(lazy=False)
    assert qos_at(bench, '/image', node, 'subscription').reliability == BEST_EFFORT
    assert node._subscription.qos_profile.depth == 1
    for topic in OUTPUTS:
        qos = qos_at(bench, topic.replace('~', NAME), node, 'publisher')
        assert (qos.reliability, qos.durability) == (RELIABLE, DurabilityPolicy.VOLATILE)


@pytest.mark.parametrize('reliability', [RELIABLE, BEST_EFFORT])
def test_listeners_of_both_kinds_are_served(bench, reliability):
    node, camera, segments = bench.node(), bench.camera(), bench.listen(reliability=reliability)
    assert segments_of(bench.result(camera, node, segments, image(picture()))).size > 0


def test_quality_of_service_of_the_input_can_be_overridden(bench):
    prefix = 'qos_overrides./image.subscription.'
    node = bench.node(lazy=False, **{
        f'{prefix}reliability': 'reliable', f'{prefix}depth': 7, f'{prefix}durability': 'transient_local',
        f'{prefix}history': 'keep_last'})
    qos = qos_at(bench, '/image', node, 'subscription')
    assert (qos.reliability, qos.durability) == (RELIABLE, DurabilityPolicy.TRANSIENT_LOCAL)
    chosen = node._subscription.qos_profile
    assert (chosen.depth, chosen.history) == (7, HistoryPolicy.KEEP_LAST)
    assert not bench.warnings()
    assert '(reliable, depth 7)' in bench.log


def test_quality_of_service_of_an_output_can_be_overridden_and_the_others_stay(bench):
    prefix = f'qos_overrides.{SEGMENTS}.publisher.'
    node = bench.node(**{f'{prefix}reliability': 'best_effort', f'{prefix}depth': 9})
    assert qos_at(bench, SEGMENTS, node, 'publisher').reliability == BEST_EFFORT
    assert qos_at(bench, MARKERS, node, 'publisher').reliability == RELIABLE
    assert node.get_parameter(f'{prefix}depth').value == 9
    assert node.get_parameter(f'qos_overrides.{MARKERS}.publisher.depth').value == node_module.OUTPUT_DEPTH
    assert not bench.warnings()


def test_quality_of_service_of_remapped_and_compressed_images_can_be_overridden(bench):
    node = bench.node('-r', 'image:=/front/image_raw', '-p',
                      'qos_overrides./front/image_raw/compressed.subscription.reliability:=reliable',
                      lazy=False, image_transport='compressed')
    assert qos_at(bench, '/front/image_raw/compressed', node, 'subscription').reliability == RELIABLE
    assert not bench.warnings()


def test_quality_of_service_holds_when_the_subscription_is_made_again(bench):
    node = bench.node(**{'qos_overrides./image.subscription.reliability': 'reliable'})
    for _ in range(3):
        segments = bench.listen()
        bench.until(lambda: subscribers(bench) == 1, 'subscription')
        assert qos_at(bench, '/image', node, 'subscription').reliability == RELIABLE
        bench.leave(segments)
        bench.until(lambda: subscribers(bench) == 0, 'end of the subscription')


@pytest.mark.parametrize('lazy', [False, True])
@pytest.mark.parametrize('end', ['/image.subscription', f'{SEGMENTS}.publisher', f'{COMPRESSED}.publisher'])
@pytest.mark.parametrize(('policy', 'value'), [
    ('reliability', 'very'), ('reliability', 1), ('reliability', ''), ('history', 'keep'), ('durability', True),
    ('depth', -1), ('depth', '5'), ('depth', 5.5), ('depth', 2**40)])
def test_impossible_quality_of_service_keeps_the_node_from_starting_and_is_named(bench, end, policy, value, lazy):
    """Also that of the input of a lazy node, which is made only when somebody listens."""
    name = f'qos_overrides.{end}.{policy}'
    with pytest.raises(ConfigurationError, match=f'{name} must be '):
        bench.node(lazy=lazy, **{name: value})


@pytest.mark.parametrize('end', ['/image.subscription', f'{SEGMENTS}.publisher'])
@pytest.mark.parametrize(('policy', 'value'), [
    (policy, value) for policy, values in node_module.QOS_POLICIES.items() for value in values or (1, 100)])
def test_every_quality_of_service_that_may_be_chosen_is_possible(bench, end, policy, value):
    node = bench.node(lazy=False, **{f'qos_overrides.{end}.{policy}': value})
    assert node.get_parameter(f'qos_overrides.{end}.{policy}').value == value
    assert not bench.warnings()


REMEDY = re.compile(r'start the node with (-p) (\S+:=\w+)')


def test_input_of_an_incompatible_publisher_is_warned_of_with_a_remedy_that_works(bench):
    camera = bench.camera(reliability=BEST_EFFORT)
    bench.node(lazy=False, **{'qos_overrides./image.subscription.reliability': 'reliable'})
    bench.until(lambda: REMEDY.search(bench.log), 'the warning')
    [warning] = bench.warnings()
    assert 'no image comes from a publisher of /image, as it offers another reliability' in warning
    node, segments = bench.node(*REMEDY.search(warning).groups(), node_name='other'), bench.listen('/other/segments')
    assert segments_of(bench.result(camera, node, segments, image(picture()))).size > 0


def test_incompatible_durability_of_the_input_is_warned_of_with_a_remedy_that_works(bench):
    camera = bench.camera()
    bench.node(lazy=False, **{'qos_overrides./image.subscription.durability': 'transient_local'})
    bench.until(lambda: REMEDY.search(bench.log), 'the warning')
    [warning] = bench.warnings()
    node, segments = bench.node(*REMEDY.search(warning).groups(), node_name='other'), bench.listen('/other/segments')
    assert segments_of(bench.result(camera, node, segments, image(picture()))).size > 0


@pytest.mark.parametrize(('overrides', 'asked', 'policy'), [
    ({}, {'durability': DurabilityPolicy.TRANSIENT_LOCAL}, 'durability'),
    ({f'qos_overrides.{SEGMENTS}.publisher.reliability': 'best_effort'}, {'reliability': RELIABLE}, 'reliability')])
def test_subscriber_that_asks_for_too_much_is_warned_of_with_a_remedy_that_works(bench, overrides, asked, policy):
    bench.node(**overrides)
    bench.listen(matched=False, **asked)
    bench.until(lambda: REMEDY.search(bench.log), 'the warning')
    warning = next(line for line in bench.warnings() if 'start the node' in line)
    assert f'a subscriber of {SEGMENTS} gets nothing, as it asks for another {policy} than this node offers' in warning
    switch, setting = REMEDY.search(warning).groups()
    node, camera = bench.node(switch, setting.replace(NAME, '/other'), node_name='other'), bench.camera()
    segments = bench.listen('/other/segments', **asked)
    assert segments_of(bench.result(camera, node, segments, image(picture()))).size > 0


# Health

def test_health_is_told_once_a_second_by_the_steady_clock(bench):
    """In real time, as nothing else shows it: three messages, about a second between each."""
    bench.node(health_timer=True)
    times = []
    bench.peer.create_subscription(DiagnosticArray, '/diagnostics', lambda _: times.append(time.monotonic()), 10)
    bench.until(lambda: len(times) == 3, 'three messages')
    assert times[2] - times[1] == pytest.approx(1, abs=0.5)


def test_health_has_every_figure(bench):
    node, camera = bench.node(lazy=False), bench.camera()
    bench.show(camera, node, image(picture()), image(picture()))
    level, summary, figures = bench.health(node)
    count = len(expected(picture()))
    assert (level, summary) == (b'\0', f'{count} segments in the last image')
    assert set(figures) >= {
        'frames received', 'frames processed', 'frames dropped', 'frames failed', 'rate (Hz)', 'latency p50 (ms)',
        'latency p95 (ms)', 'latency p99 (ms)', 'extraction (ms)', 'segments', 'last error',
        *(f'{step} (ms)' for step in STEPS)}
    assert figures['segments'] == str(count)
    assert 0 < float(figures['latency p50 (ms)']) <= float(figures['latency p99 (ms)']) < 1000 * DEADLINE
    assert float(figures['latency p99 (ms)']) > float(figures['extraction (ms)']) / 2 > 0
    assert float(figures['rate (Hz)']) > 0


def test_health_has_the_name_of_the_node_the_topic_and_a_stamp(bench):
    node = bench.node('-r', 'image:=/front/image_raw', '-r', '__ns:=/robot')
    messages = bench.listen('/diagnostics', DiagnosticArray)
    node._publish_diagnostics()
    bench.until(lambda: messages, 'diagnostics')
    [status] = messages[0].status
    assert status.name == '/robot/line_feature_node: line features'
    assert status.hardware_id == '/front/image_raw'
    now = Clock(clock_type=ClockType.SYSTEM_TIME).now().nanoseconds * 1e-9
    assert messages[0].header.stamp.sec == pytest.approx(now, abs=DEADLINE)


def test_health_of_a_node_that_waits_is_good(bench):
    node = bench.node()
    assert bench.health(node)[:2] == (b'\0', 'waits for a subscriber (lazy)')


def test_health_of_a_node_that_is_not_active_is_good(bench):
    node = bench.node(autostart=False)
    assert bench.health(node)[:2] == (b'\0', 'not active')


def advance(node, seconds):
    """Let a node's monitor believe that time went by."""
    clock = node._monitor.clock
    node._monitor.clock = lambda: clock() + seconds


@pytest.mark.parametrize(('publish', 'reason'), [(False, 'the topic has no publisher'), (True, 'sends nothing')])
def test_silence_is_an_error(bench, publish, reason):
    node, camera = bench.node(lazy=False, image_timeout=5.0), bench.camera()
    bench.connect(camera, node)
    if not publish:
        bench.peer.destroy_publisher(camera)
        bench.until(lambda: node._subscription.get_publisher_count() == 0, 'publisher leaving')
    assert bench.health(node)[0] == b'\0'
    advance(node, 6)
    level, summary, _ = bench.health(node)
    assert level == b'\2'
    assert summary.startswith('no image for 6 s')
    assert reason in summary


def test_silence_by_incompatible_quality_of_service_is_not_said_to_be_for_want_of_a_publisher(bench):
    bench.camera(reliability=BEST_EFFORT)
    node = bench.node(lazy=False, **{'qos_overrides./image.subscription.reliability': 'reliable'})
    bench.until(lambda: REMEDY.search(bench.log), 'the warning')
    advance(node, 6)
    assert 'does not fit, see the log' in bench.health(node)[1]


def test_late_segments_are_a_warning(bench):
    node, camera = bench.node(lazy=False, max_latency=0.0), bench.camera()
    bench.show(camera, node, image(picture()))
    level, summary, _ = bench.health(node)
    assert level == b'\1'
    assert re.fullmatch(r'5 % of the segments come \d+ ms or later after their images', summary)


# Simulated time

def test_node_works_while_simulated_time_stands_still(bench):
    """Health is told in real time, and stamps stay those of the images."""
    node, camera, segments = bench.node(use_sim_time=True, health_timer=True), bench.camera(), bench.listen()
    health = bench.listen('/diagnostics', DiagnosticArray)
    clock = bench.peer.create_publisher(ClockMessage, '/clock', 10)
    bench.until(clock.get_subscription_count, 'subscriber of /clock')
    message = ClockMessage()
    message.clock.sec = 1234
    clock.publish(message)
    bench.until(lambda: node.get_clock().now().nanoseconds == 1234 * 10**9, 'simulated time')
    assert bench.result(camera, node, segments, image(picture(), stamp=(3, 4))).header.stamp.sec == 3
    bench.until(lambda: len(health) == 2, 'two diagnostics')
    assert [message.header.stamp.sec for message in health] == [1234, 1234]
    assert not bench.warnings()


# Life cycle

def test_node_is_active_by_itself(bench):
    bench.node()
    assert bench.state() == State.PRIMARY_STATE_ACTIVE


def test_node_without_autostart_waits_for_a_manager(bench):
    node = bench.node(autostart=False, lazy=False)
    assert bench.state() == State.PRIMARY_STATE_UNCONFIGURED
    bench.work_off()
    assert subscribers(bench) == 0
    assert 'kernels' not in bench.log
    assert bench.change(Transition.TRANSITION_CONFIGURE)
    assert bench.state() == State.PRIMARY_STATE_INACTIVE
    assert 'kernels are ready' in bench.log
    segments = bench.listen()
    assert subscribers(bench) == 0
    assert bench.change(Transition.TRANSITION_ACTIVATE)
    assert bench.state() == State.PRIMARY_STATE_ACTIVE
    assert segments_of(bench.result(bench.camera(), node, segments, image(picture()))).size > 0


def test_nothing_is_published_while_the_node_is_not_active(bench, counted):
    node, camera, segments = bench.node(), bench.camera(), bench.listen()
    bench.result(camera, node, segments, image(picture()))
    assert bench.change(Transition.TRANSITION_DEACTIVATE)
    bench.until(lambda: camera.get_subscription_count() == 0, 'end of the subscription')
    counts = counted(node)
    camera.publish(image(picture()))
    bench.work_off()
    assert not any(counts.values())
    assert 'deactivated' in bench.log
    assert bench.health(node)[1] == 'not active'
    assert bench.change(Transition.TRANSITION_ACTIVATE)
    assert bench.result(camera, node, segments, image(picture(), stamp=(5, 6))).header.stamp.sec == 5
    assert len(segments) == 2


def test_frame_that_waits_when_the_node_is_cleaned_up_does_no_harm(bench):
    node, camera, segments = bench.node(), bench.camera(), bench.listen()
    bench.connect(camera, node)
    camera.publish(image(picture()))
    node.trigger_deactivate()
    node.trigger_cleanup()
    bench.work_off()
    assert bench.state() == State.PRIMARY_STATE_UNCONFIGURED
    assert not segments


def test_node_goes_round_its_life_cycle_again(bench):
    """With its quality of service, whose parameters are declared only once."""
    node = bench.node(**{'qos_overrides./image.subscription.reliability': 'reliable',
                         f'qos_overrides.{SEGMENTS}.publisher.depth': 9})
    camera, segments = bench.camera(), bench.listen()
    for turn in range(2):
        bench.result(camera, node, segments, image(picture(), stamp=(turn, 0)))
        assert qos_at(bench, '/image', node, 'subscription').reliability == RELIABLE
        assert bench.change(Transition.TRANSITION_DEACTIVATE)
        assert bench.change(Transition.TRANSITION_CLEANUP)
        assert bench.state() == State.PRIMARY_STATE_UNCONFIGURED
        assert 'cleaned up' in bench.log
        bench.until(lambda: not node.count_publishers(SEGMENTS) and not subscribers(bench), 'end of the topics')
        assert bench.change(Transition.TRANSITION_CONFIGURE)
        assert bench.change(Transition.TRANSITION_ACTIVATE)
        bench.until(segments.subscription.get_publisher_count, 'publisher')
    assert [message.header.stamp.sec for message in segments] == [0, 1]
    assert not bench.warnings()


@pytest.mark.parametrize(('before', 'transition'), [
    ([], Transition.TRANSITION_ACTIVE_SHUTDOWN),
    ([Transition.TRANSITION_DEACTIVATE], Transition.TRANSITION_INACTIVE_SHUTDOWN),
    ([Transition.TRANSITION_DEACTIVATE, Transition.TRANSITION_CLEANUP], Transition.TRANSITION_UNCONFIGURED_SHUTDOWN)])
def test_node_can_be_shut_down_from_every_state(bench, before, transition):
    node = bench.node(lazy=False)
    for step in before:
        assert bench.change(step)
    assert bench.change(transition)
    assert bench.state() == State.PRIMARY_STATE_FINALIZED
    bench.until(lambda: not node.count_publishers(SEGMENTS) and not subscribers(bench), 'end of the topics')


@pytest.mark.parametrize(('transition', 'label'), [
    (Transition.TRANSITION_CONFIGURE, ''), (Transition.TRANSITION_ACTIVATE, ''), (Transition.TRANSITION_CLEANUP, ''),
    (Transition.TRANSITION_UNCONFIGURED_SHUTDOWN, ''), (200, ''), (0, 'nonsense'), (0, 'configure')])
def test_invalid_transition_is_refused_and_the_node_works_on(bench, transition, label):
    node, camera, segments = bench.node(), bench.camera(), bench.listen()
    assert bench.change(transition, label=label) is False
    assert bench.state() == State.PRIMARY_STATE_ACTIVE
    assert segments_of(bench.result(camera, node, segments, image(picture()))).size > 0
    if label == '':
        warnings = [line for line in bench.warnings() if NAME[1:] in line]
        assert len(warnings) == 1
        assert f'transition {transition} was asked for, which is not possible in this state' in warnings[0]


def test_transition_can_be_asked_for_by_its_label(bench):
    bench.node()
    assert bench.change(0, label='deactivate')
    assert bench.state() == State.PRIMARY_STATE_INACTIVE


def test_configuring_that_fails_leaves_the_node_unconfigured_with_a_reason(bench, mask_file):
    bench.node(autostart=False, mask_file=str(mask_file))
    kept = mask_file.read_bytes()
    mask_file.unlink()
    assert bench.change(Transition.TRANSITION_CONFIGURE) is False
    assert bench.state() == State.PRIMARY_STATE_UNCONFIGURED
    assert f'cannot be configured: mask_file {mask_file}: No such file' in bench.warnings()[0]
    mask_file.write_bytes(kept)
    assert bench.change(Transition.TRANSITION_CONFIGURE)


def test_configuring_that_fails_halfway_leaves_no_publishers(bench, monkeypatch):
    node = bench.node(autostart=False)
    create, made = node.create_publisher, []

    def create_two(*arguments, **options):
        made.append(arguments)
        if len(made) > 2:
            raise RuntimeError('no room')
        return create(*arguments, **options)

    monkeypatch.setattr(node, 'create_publisher', create_two)
    assert bench.change(Transition.TRANSITION_CONFIGURE) is False
    assert 'cannot be configured: no room' in bench.warnings()[0]
    bench.until(lambda: node.count_publishers(SEGMENTS) == 0, 'end of the publishers')
    monkeypatch.undo()
    assert bench.change(Transition.TRANSITION_CONFIGURE)
    assert node.count_publishers(SEGMENTS) == 1


def test_activating_that_fails_can_be_tried_again(bench, monkeypatch):
    node, camera = bench.node(autostart=False, lazy=False), bench.camera()
    assert bench.change(Transition.TRANSITION_CONFIGURE)

    def refuse(*_, **__):
        raise RuntimeError('no room')

    monkeypatch.setattr(node, 'create_subscription', refuse)
    assert bench.change(Transition.TRANSITION_ACTIVATE) is False
    monkeypatch.undo()
    assert bench.state() == State.PRIMARY_STATE_INACTIVE
    assert bench.change(Transition.TRANSITION_ACTIVATE)
    segments = bench.listen()
    assert segments_of(bench.result(camera, node, segments, image(picture()))).size > 0


@pytest.mark.parametrize(('autostart', 'times'), [(True, 1), (False, 0)])
def test_kernels_of_new_parameters_are_compiled_before_the_next_frame(bench, monkeypatch, autostart, times):
    """Not before the node is configured: then all are compiled."""
    node, calls = bench.node(autostart=autostart), []
    monkeypatch.setattr(node._extractor, 'warm_up', lambda: calls.append(node._extractor.parameters.operator))
    client = bench.parameters()
    assert bench.set(client, operator='sobel') == ''
    assert bench.set(client, jpeg_quality=50) == ''
    assert calls == ['sobel'] * times


def test_parameters_can_be_set_in_every_state(bench):
    node = bench.node(autostart=False)
    client = bench.parameters()
    assert bench.set(client, T1=50.0) == ''
    assert bench.change(Transition.TRANSITION_CONFIGURE)
    assert bench.set(client, T2=40.0) == ''
    assert bench.set(client, lazy=False) == ''
    assert subscribers(bench) == 0
    assert bench.change(Transition.TRANSITION_ACTIVATE)
    camera, segments = bench.camera(), bench.listen()
    pixels = np.random.default_rng(1).normal(picture(), 20).clip(0, 255).astype(np.uint8)
    found = segments_of(bench.result(camera, node, segments, image(pixels)))
    assert found.tobytes() == expected(pixels, T1=50.0, T2=40.0).tobytes()


# Spinning

@pytest.fixture
def spinning(bench):
    """A node that the function `spin` works on in another thread, while the bench works on the peer."""
    threads = []

    def start(**parameters):
        node = bench.node(**parameters)
        bench.executor.remove_node(node)
        threads.append(threading.Thread(target=spin, args=(node,)))
        threads[-1].start()
        bench.state()  # which the thread answers
        return node, threads[-1]

    yield start
    bench.context.try_shutdown()
    for thread in threads:
        thread.join(DEADLINE)
        assert not thread.is_alive()


def malformed(bench):
    """Ask for what fails in a callback, and wait until the node says so; what it prints meanwhile may be missed."""
    log = bench.listen('/rosout', Log)
    client = bench.client(SetParameters, f'{NAME}/set_parameters')
    value = ParameterValue(type=99)
    client.call_async(SetParameters.Request(parameters=[ParameterMessage(name='T1', value=value)]))
    bench.until(lambda: any('a callback failed: ' in entry.msg for entry in log), 'the error in the log')


def test_malformed_request_does_not_end_the_spinning(bench, spinning):
    _, thread = spinning()
    malformed(bench)
    values = bench.wait(bench.parameters().get_parameters(['T1'])).values
    assert values[0].double_value == Parameters().T1
    assert thread.is_alive()


def test_node_processes_images_after_a_malformed_request(bench, spinning):
    node, _ = spinning()
    malformed(bench)
    camera, segments = bench.camera(), bench.listen()
    assert segments_of(bench.result(camera, node, segments, image(picture()))).size > 0


def test_invalid_transition_does_not_end_the_spinning(bench, spinning):
    _, thread = spinning()
    assert bench.change(Transition.TRANSITION_CONFIGURE) is False
    assert bench.state() == State.PRIMARY_STATE_ACTIVE
    assert thread.is_alive()


def test_spinning_ends_at_once_where_the_context_is_shut_down_already(bench, monkeypatch):
    def make_executor(context):
        """As rclpy's own, which leaves something behind that fails when it is deleted."""
        if not context.ok():
            raise node_module.RCLError('the given context is not valid')
        return SingleThreadedExecutor(context=context)

    monkeypatch.setattr(node_module, 'SingleThreadedExecutor', make_executor)
    node = bench.node()
    bench.context.try_shutdown()
    spin(node)


def test_spinning_ends_with_the_context(bench, spinning):
    _, thread = spinning()
    assert thread.is_alive()
    bench.context.try_shutdown()
    thread.join(DEADLINE)
    assert not thread.is_alive()


# End

def test_node_that_was_destroyed_is_not_seen_any_more(bench):
    node = bench.node()
    bench.until(lambda: len(bench.peer.get_node_names()) == 2, 'both nodes')
    gc.disable()
    try:
        bench.executor.remove_node(node)
        node.destroy_node()
        bench.work_off()
        assert bench.peer.get_node_names() == ['peer']
    finally:
        gc.enable()


# Who may do what

POLICY = Path(__file__).resolve().parents[1] / 'config' / 'sros2' / 'line_feature_node.policy.xml'


def allowed(tag, what):
    """Names that the policy of SROS 2 allows, as its tools expand them for a node in the root namespace."""
    [profile] = ElementTree.parse(POLICY).getroot().iterfind('enclaves/enclave/profiles/profile')
    assert (profile.get('ns'), f'/{profile.get("node")}') == ('/', NAME)
    names = [entry.text for group in profile.iterfind(f'{tag}s[@{what}="ALLOW"]') for entry in group.iterfind(tag)]
    expanded = {name.replace('~', NAME) if name.startswith('~') else f'/{name.removeprefix("/")}' for name in names}
    assert len(expanded) == len(names)
    return expanded


def graph(bench, end):
    """What the node has, as others see it."""
    look = getattr(bench.peer, f'get_{end}_names_and_types_by_node')
    return {name for name, _ in look(NAME[1:], '/')}


def test_the_policy_allows_what_the_node_has_and_nothing_else(bench):
    found = {end: set() for end in ('subscriber', 'publisher', 'service', 'client')}
    for transport in ('raw', 'compressed'):
        node = bench.node(image_transport=transport, lazy=False, use_sim_time=True)
        bench.until(lambda: len(graph(bench, 'subscriber')) == 2, 'subscriptions')
        bench.until(lambda: allowed('topic', 'publish') <= graph(bench, 'publisher'), 'publishers')
        bench.until(lambda: allowed('service', 'reply') <= graph(bench, 'service'), 'services')
        for end, names in found.items():
            names |= graph(bench, end)
        bench.nodes.remove(node)
        bench.executor.remove_node(node)
        node.destroy_node()
        bench.until(lambda: NAME[1:] not in bench.peer.get_node_names(), 'end of the node')
    assert found == {
        'subscriber': allowed('topic', 'subscribe'), 'publisher': allowed('topic', 'publish'),
        'service': allowed('service', 'reply'), 'client': set()}


def test_the_policy_has_the_form_of_the_tools():
    policy = ElementTree.parse(POLICY).getroot()
    assert (policy.tag, policy.attrib) == ('policy', {'version': '0.2.0'})
    assert [enclave.get('path') for enclave in policy.iterfind('enclaves/enclave')] == [NAME]
    [profile] = policy.iterfind('enclaves/enclave/profiles/profile')
    assert [(group.tag, group.attrib) for group in profile] == [
        ('topics', {'subscribe': 'ALLOW'}), ('topics', {'publish': 'ALLOW'}), ('services', {'reply': 'ALLOW'})]
