"""The ROS 2 node: an image topic in, segments, markers, an overlay and edges out."""

import array
import contextlib
import ctypes
import importlib
import os
import sys
import time
from collections.abc import Callable
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from lifecycle_msgs.srv import ChangeState
from numpy.typing import NDArray
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.event_handler import PublisherEventCallbacks, SubscriptionEventCallbacks
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from rclpy.logging import get_logger
from rclpy.publisher import Publisher
from rclpy.qos import QoSPolicyKind, QoSProfile, QoSReliabilityPolicy, qos_policy_name_from_kind
from rclpy.qos_overriding_options import QoSOverridingOptions
from rclpy.signals import SignalHandlerOptions, install_signal_handlers
from rclpy.utilities import remove_ros_args
from sensor_msgs.msg import CompressedImage, Image, PointCloud2
from visualization_msgs.msg import ImageMarker

from line_feature_node.core import LineFeatureExtractor, warm_up_all
from line_feature_node.files import read_mask
from line_feature_node.images import compressed_image_of, displayable, image_of, range_hint, usable_pixels
from line_feature_node.messages import Messages
from line_feature_node.monitor import Monitor, Publishers, Throttle
from line_feature_node.node_parameters import QOS_POLICIES, NodeParameters
from line_feature_node.options import QOS_OVERRIDES
from line_feature_node.overlay import draw_overlay, encode_jpeg
from line_feature_node.parameter_files import read_parameter_file

RCLError, UnknownROSArgsError = rclpy_implementation.RCLError, rclpy_implementation.UnknownROSArgsError

#: What it subscribes to, by `image_transport`.
IMAGE_TYPES = {'raw': 'sensor_msgs/msg/Image', 'compressed': 'sensor_msgs/msg/CompressedImage'}
#: What the node publishes, by topic.
OUTPUTS = {
    '~/segments': PointCloud2, '~/markers': ImageMarker, '~/overlay': Image, '~/overlay/compressed': CompressedImage,
    '~/edges': Image,
}
#: Policies that a user may override for each topic.
POLICIES = [QoSPolicyKind[name.upper()] for name in QOS_POLICIES]
#: Seconds between two messages of one kind in the log.
THROTTLE = 5.0
#: How many outputs wait for a subscriber that is slow.
OUTPUT_DEPTH = 5
#: Of glibc's malloc.h: the largest block that comes from the heap, and how much of its end may lie unused.
MALLOC_OPTIONS = ((-3, 'MMAP', 32 << 20), (-1, 'TRIM', 256 << 20))
#: How rcl begins to say that it cannot make the folder of the log files.
NO_LOGGING = 'failed to initialize logging: '
#: Frames after which a 16-bit stream is looked at again, whether it uses its range.
HINT_EVERY = 100


@cache
def _type(name: str) -> Any:
    package, _, message = name.split('/')
    return getattr(importlib.import_module(f'{package}.msg'), message)


def _octets(data: NDArray[Any]) -> 'array.array[int]':
    """Bytes as a message wants them: assigning anything else but an array takes a hundred times as long."""
    octets = array.array('B')
    if data.size:
        octets.frombytes(data.reshape(-1).view(np.uint8).data)
    return octets


MESSAGES = Messages(_type, _octets)


class ConfigurationError(ValueError):
    """The node cannot start with these parameters; the message is a sentence for users."""


class LineFeatureNode(LifecycleNode):
    """Extracts line segments from the images of a topic.

    All work is done in the callbacks of one executor, which is to be single-threaded. With `autostart` the node is
    active when the constructor returns; its kernels are compiled by then.

    Attributes:
        throttle: Keeps its log from being flooded.
    """

    def __init__(self, node_name: str = 'line_feature_node', **options: Any) -> None:
        """Make the node and, with `autostart`, activate it.

        Args:
            node_name: Its name, unless it is remapped.
            **options: As for rclpy.node.Node: context, namespace, cli_args, parameter_overrides, use_global_arguments
                and others.

        Raises:
            ConfigurationError: A parameter has the wrong type or range or contradicts another, or the mask cannot be
                read.
        """
        try:
            super().__init__(node_name, automatically_declare_parameters_from_overrides=True, **options)
        except ValueError as error:
            raise ConfigurationError(self._empty_overrides() or str(error)) from None
        self._publishers_of: dict[str, Publisher] = {}
        self._subscription: Any = None
        self._active = False
        self._problem = ''
        self._hinted = False
        self._mask: NDArray[np.uint8] | None = None
        self._monitor = Monitor()
        self.throttle = Throttle(THROTTLE)
        try:
            self._settings = NodeParameters(self, self._qos_names(), self._on_parameters)
        except (TypeError, ValueError) as error:
            self.destroy_node()
            raise ConfigurationError(str(error)) from None
        own, of_process = options.get('cli_args') or [], options.get('use_global_arguments', True)
        self._warn_of_idle_files([*own, *(sys.argv if of_process else [])])
        self._extractor = LineFeatureExtractor(self._settings.parameters)
        self._diagnostics = self.create_publisher(DiagnosticArray, '/diagnostics', OUTPUT_DEPTH)
        # Health is told while a simulation stands still, too.
        self.create_timer(1.0, self._publish_diagnostics, clock=Clock(clock_type=ClockType.STEADY_TIME))
        self._survive_invalid_transitions()
        if self._settings.options.autostart:
            self._start()

    def _empty_overrides(self) -> str:
        """What is wrong with overrides that rclpy cannot declare, as an empty list has no type; '' where it is not."""
        empty = [name for name, given in getattr(self, '_parameter_overrides', {}).items() if given.value in (None, [])]
        return f'{", ".join(empty)} must have a value, got an empty one' if empty else ''

    def _warn_of_idle_files(self, args: list[str]) -> None:
        """Say so where a parameter file of a command line has nothing for this node: rcl passes over it silently."""
        pairs = list(pairwise(args))
        single = {after.partition(':=')[0].rpartition(':')[2] for flag, after in pairs if flag in ('-p', '--param')}
        for path in (after for flag, after in pairs if flag == '--params-file'):
            try:
                values, unknown = read_parameter_file(Path(path))
            except ValueError:  # rcl reads other YAML than Python does, and took it
                continue
            names = {*values, *unknown} - single
            if names and not names & self._parameter_overrides.keys():
                self.get_logger().warning(
                    f'nothing in {path} is for {self.get_fully_qualified_name()}: the name of a section in it must be '
                    f'this one, or /** for any node')

    def destroy_node(self) -> None:
        """Destroy the node with its state machine, which would keep it in the graph until the garbage is collected."""
        super().destroy_node()
        self._state_machine.destroy_when_not_in_use()

    def _start(self) -> None:
        for trigger in (self.trigger_configure, self.trigger_activate):
            if trigger() != TransitionCallbackReturn.SUCCESS:
                self.destroy_node()
                raise ConfigurationError(self._problem)

    def _survive_invalid_transitions(self) -> None:
        """Refuse what a client asks for in the wrong state: rclpy of Jazzy (7.1) raises, which ends the spinning."""
        for service in self.services:
            if service.srv_type is ChangeState:
                service.callback = self._refusing(service.callback)

    def _refusing(self, change_state: Callable[[Any, Any], Any]) -> Callable[[Any, Any], Any]:
        def answer(request: Any, response: Any) -> Any:
            try:
                return change_state(request, response)
            except RCLError:
                asked = request.transition.label or request.transition.id
                self.get_logger().warning(f'transition {asked!r} was asked for, which is not possible in this state')
                response.success = False
                return response

        return answer

    # Life cycle

    def on_configure(self, _state: LifecycleState) -> TransitionCallbackReturn:
        """Read the mask, compile the kernels and make the publishers."""
        return self._attempt(self._configure, self._clean_up, 'configured')

    def on_activate(self, _state: LifecycleState) -> TransitionCallbackReturn:
        """Begin to process images."""
        return self._attempt(self._activate, self._deactivate, 'activated')

    def on_deactivate(self, _state: LifecycleState) -> TransitionCallbackReturn:
        """Stop processing images; parameters and publishers stay."""
        self._deactivate()
        self.get_logger().info('deactivated')
        return TransitionCallbackReturn.SUCCESS

    def on_cleanup(self, _state: LifecycleState) -> TransitionCallbackReturn:
        """Give back what configuring made."""
        self._clean_up()
        self.get_logger().info('cleaned up')
        return TransitionCallbackReturn.SUCCESS

    def on_shutdown(self, _state: LifecycleState) -> TransitionCallbackReturn:
        """Stop for good; what is left is to end the process."""
        self._deactivate()
        self._clean_up()
        return TransitionCallbackReturn.SUCCESS

    def on_error(self, _state: LifecycleState) -> TransitionCallbackReturn:
        """Begin anew after an error in a transition."""
        return self.on_shutdown(_state)

    def _attempt(self, work: Callable[[], None], undo: Callable[[], None], done: str) -> TransitionCallbackReturn:
        """Do the work of a transition; what goes wrong is a sentence in the log, and it is undone."""
        try:
            work()
        except (OSError, RuntimeError, TypeError, ValueError) as error:
            self._problem = str(error)
            self.get_logger().error(f'cannot be {done}: {error}')
            undo()
            return TransitionCallbackReturn.FAILURE
        return TransitionCallbackReturn.SUCCESS

    def _configure(self) -> None:
        options = self._settings.options
        self._mask = read_mask(Path(options.mask_file)) if options.mask_file else None
        load_kernels(self._extractor.warm_up, self.get_logger())
        for topic, kind in OUTPUTS.items():
            self._publishers_of[topic] = self.create_publisher(
                kind, topic, QoSProfile(depth=OUTPUT_DEPTH), qos_overriding_options=QoSOverridingOptions(POLICIES),
                event_callbacks=PublisherEventCallbacks(
                    matched=lambda _: self._update_subscription(),
                    incompatible_qos=self._on_incompatible_output(topic)))

    def _activate(self) -> None:
        self._active = True
        self._update_subscription()
        if self._subscription is None:
            self.get_logger().info(f'ready; waits for a subscriber of {self.resolve_topic_name("~/segments")} or its '
                                   f'other outputs before it subscribes to {self._image_topic()} (lazy)')

    def _deactivate(self) -> None:
        self._active = False
        self._update_subscription()

    def _clean_up(self) -> None:
        self._active = False
        self._update_subscription()
        for publisher in self._publishers_of.values():
            self.destroy_publisher(publisher)
        self._publishers_of.clear()
        self._mask = None

    # Parameters

    def _on_parameters(self) -> None:
        """Take up new parameters. The executor is single-threaded, so this is between two frames."""
        if self._extractor.parameters != self._settings.parameters:
            self._extractor.parameters = self._settings.parameters
            if self._active:
                self._extractor.warm_up()
        self._update_subscription()

    # Topics

    def _image_topic(self) -> str:
        compressed = self._settings.options.image_transport == 'compressed'
        return self._compressed_topic() if compressed else str(self.resolve_topic_name('image'))

    def _compressed_topic(self) -> str:
        """That beside the raw images, wherever these are remapped to, unless it is remapped itself."""
        return str(self.resolve_topic_name(f'{self.resolve_topic_name("image")}/compressed'))

    def _qos_names(self) -> list[str]:
        """Names of the parameters that override quality of service."""
        topics = [(self.resolve_topic_name(topic), 'publisher') for topic in OUTPUTS]
        topics += [(topic, 'subscription') for topic in (self.resolve_topic_name('image'), self._compressed_topic())]
        return [f'{QOS_OVERRIDES}{topic}.{end}.{policy}' for topic, end in topics for policy in QOS_POLICIES]

    def _update_subscription(self) -> None:
        """Subscribe to images when they are wanted, and only then."""
        wanted = self._active and (not self._settings.options.lazy or self._has_listeners())
        if wanted and self._subscription is None:
            self._subscribe()
        elif not wanted and self._subscription is not None:
            self.destroy_subscription(self._subscription)
            self._subscription = None
            if self._active:
                self.get_logger().info('nobody listens any more: unsubscribed from the images')

    def _has_listeners(self) -> bool:
        return any(publisher.get_subscription_count() for publisher in self._publishers_of.values())

    def _subscribe(self) -> None:
        topic = self._image_topic()
        compressed = self._settings.options.image_transport == 'compressed'
        # REP 2003: best effort for sensor data. Of frames that come faster than they are processed the newest counts.
        qos = QoSProfile(depth=1, reliability=QoSReliabilityPolicy.BEST_EFFORT)
        callback: Any = self._on_compressed_image if compressed else self._on_raw_image
        self._subscription = self.create_subscription(
            CompressedImage if compressed else Image, topic, callback, qos,
            qos_overriding_options=QoSOverridingOptions(POLICIES),
            event_callbacks=SubscriptionEventCallbacks(incompatible_qos=self._on_incompatible_input(topic)))
        self._monitor.restart()
        chosen = self._subscription.qos_profile
        self.get_logger().info(f'ready; waits for images on {topic} ({chosen.reliability.name.lower()}, '
                               f'depth {chosen.depth})')

    def _on_incompatible_input(self, topic: str) -> Callable[[Any], None]:
        def warn(event: Any) -> None:
            policy = _policy(event)
            self.get_logger().warning(
                f'no image comes from a publisher of {topic}, as it offers another {policy} than this node asks for: '
                f'start the node with -p {QOS_OVERRIDES}{topic}.subscription.{policy}:={_WEAKER.get(policy, "...")}')

        return warn

    def _on_incompatible_output(self, topic: str) -> Callable[[Any], None]:
        def warn(event: Any) -> None:
            policy, resolved = _policy(event), self.resolve_topic_name(topic)
            self.get_logger().warning(
                f'a subscriber of {resolved} gets nothing, as it asks for another {policy} than this node offers: '
                f'start the node with -p {QOS_OVERRIDES}{resolved}.publisher.{policy}:={_STRONGER.get(policy, "...")}')

        return warn

    # Frames

    def _on_raw_image(self, message: Image, info: dict[str, Any]) -> None:
        self._on_frame(message, info, image_of, lambda: f'{message.encoding}')

    def _on_compressed_image(self, message: CompressedImage, info: dict[str, Any]) -> None:
        self._on_frame(message, info, compressed_image_of, lambda: f'{message.format!r}')

    def _on_frame(
        self, message: Any, info: dict[str, Any], decode: Callable[[Any], NDArray[Any]], form: Callable[[], str],
    ) -> None:
        """Process one frame. Whatever is wrong with it costs a line in the log, and the next one is processed."""
        begin = time.time_ns()
        subscription = self._subscription
        publishers = 1 if subscription is None else subscription.get_publisher_count()
        self._monitor.receive(info.get('publication_sequence_number'), publishers)
        try:
            image = decode(message)
            segments = self._extractor.extract(image, usable_pixels(image, self._mask))
        except (cv2.error, MemoryError, TypeError, ValueError) as error:
            self._on_bad_frame(message, error)
            return
        self._publish('~/segments', lambda: MESSAGES.segments(segments, message.header))
        times = self._extractor.times
        # Where the middleware does not know when the image was published, it is taken from when it came.
        sent = info.get('source_timestamp') or begin
        self._monitor.process((time.time_ns() - sent) * 1e-9, times, len(segments))
        if self._monitor.counts.processed == 1:
            height, width = image.shape
            self.get_logger().info(f'first image: {width}×{height} {form()}, {len(segments)} segments')
        self._publish_pictures(image, segments, message.header, (time.time_ns() - begin) * 1e-6)
        if image.dtype != np.uint8 and self._monitor.counts.processed % HINT_EVERY == 1:
            self._hint(image)

    def _on_bad_frame(self, message: Any, error: Exception) -> None:
        stamp = message.header.stamp
        reason = ' '.join(str(error).split()) or type(error).__name__
        self._monitor.fail(reason)
        if self.throttle.allows('bad frame'):
            self.get_logger().warning(
                f'image on {self._image_topic()} with stamp {stamp.sec}.{stamp.nanosec:09d} is left out: {reason}')

    def _hint(self, image: NDArray[Any]) -> None:
        hint = range_hint(image, self._extractor.parameters)
        if hint and not self._hinted:
            self._hinted = True
            self.get_logger().info(f'image on {self._image_topic()}: {hint}')

    def _publish(self, topic: str, make: Callable[[], Any]) -> None:
        """Publish what is made, if anybody listens: publish() serialises even when nobody does."""
        publisher = self._publishers_of[topic]
        if publisher.get_subscription_count():
            publisher.publish(make())

    def _publish_pictures(
        self, image: NDArray[Any], segments: NDArray[np.void], header: Any, milliseconds: float,
    ) -> None:
        @cache
        def overlay() -> NDArray[np.uint8]:
            picture = displayable(image, self._extractor.parameters)
            return draw_overlay(picture, segments, f'{len(segments)} segments, {milliseconds:.1f} ms')

        def compressed() -> NDArray[np.uint8]:
            return encode_jpeg(overlay(), self._settings.options.jpeg_quality)

        try:
            self._publish('~/markers', lambda: MESSAGES.markers(segments, header))
            self._publish('~/overlay', lambda: MESSAGES.image(overlay(), header))
            self._publish('~/edges', lambda: MESSAGES.image(self._extractor.edges(), header))
            self._publish('~/overlay/compressed', lambda: MESSAGES.compressed_image(compressed(), header))
        except (cv2.error, MemoryError, ValueError) as error:
            if self.throttle.allows('picture'):
                self.get_logger().warning(f'a picture of the segments cannot be made: {" ".join(str(error).split())}')

    # Diagnostics

    def _publish_diagnostics(self) -> None:
        publishers = None
        if self._subscription is not None:
            wanted, topic = IMAGE_TYPES[self._settings.options.image_transport], self._image_topic()
            types = [known.topic_type for known in self.get_publishers_info_by_topic(topic)]
            publishers = Publishers(len(types), self._subscription.get_publisher_count(),
                                    next((kind for kind in types if kind != wanted), ''))
        waiting = 'waits for a subscriber (lazy)' if self._active else 'not active'
        health = self._monitor.health(self._settings.options, publishers=publishers, waiting=waiting)
        status = DiagnosticStatus(
            level=bytes([health.level]), name=f'{self.get_fully_qualified_name()}: line features',
            message=health.summary, hardware_id=self._image_topic(),
            values=[KeyValue(key=key, value=value) for key, value in health.values.items()])
        message = DiagnosticArray(status=[status])
        message.header.stamp = self.get_clock().now().to_msg()
        self._diagnostics.publish(message)


#: Values that are compatible with what any publisher offers, and with what any subscriber asks for.
_WEAKER = {'reliability': 'best_effort', 'durability': 'volatile'}
_STRONGER = {'reliability': 'reliable', 'durability': 'transient_local'}


def _policy(event: Any) -> str:
    return str(qos_policy_name_from_kind(event.last_policy_kind)).lower()


def spin(node: LineFeatureNode) -> None:
    """Let a node work until its context is shut down."""
    try:
        executor = SingleThreadedExecutor(context=node.context)
    except RCLError:
        if node.context.ok():
            raise
        return  # shut down already
    executor.add_node(node)
    try:
        while node.context.ok():
            _spin_while_all_is_well(node, executor)
    finally:
        executor.shutdown()


def _spin_while_all_is_well(node: LineFeatureNode, executor: SingleThreadedExecutor) -> None:
    """Spin until the context is shut down, or a callback raises something.

    That is logged, and the node goes on: a client that sends nonsense to one of rclpy's services does not end it.
    """
    try:
        executor.spin()
    except (KeyboardInterrupt, ExternalShutdownException):
        node.context.try_shutdown()
    except Exception as error:
        if node.context.ok() and node.throttle.allows('callback'):
            node.get_logger().error(f'a callback failed: {error!r}')


def run(args: list[str], ready: Callable[[], None]) -> int:
    """Run the node as a process until SIGINT or SIGTERM; return its exit status, 2 where it cannot start.

    Args:
        args: Those of the command line, with its name.
        ready: Called when these signals end the node; until then they are to be taken care of by the caller.
    """
    _keep_memory()
    try:
        node = _started(args)
    except (ConfigurationError, RCLError) as error:
        print(f'line_feature_node cannot start: {" ".join(str(error).split())}', file=sys.stderr)
        rclpy.try_shutdown()
        return 2
    # From here on rclpy shuts its context down, which ends the spinning. It calls the handlers from before, too.
    install_signal_handlers(SignalHandlerOptions.ALL)
    ready()
    try:
        spin(node)
    finally:
        node.destroy_node()
        rclpy.try_shutdown()
    return 0


def load_kernels(warm_up: Callable[[], None], logger: Any) -> None:
    """Compile the kernels, or load them."""
    logger.info('loading the kernels; the first time they are compiled, which takes up to a minute')
    begin = time.monotonic()
    warm_up()
    logger.info(f'kernels are ready after {time.monotonic() - begin:.1f} s')


def _keep_memory() -> None:
    """Let the C library keep the memory of large messages, where the user has not said otherwise.

    It would give that back, and the kernel zero it anew, for each frame: half of the time that a large image takes to
    arrive (docs/transport.md). Where the library is another one than glibc, nothing is changed.
    """
    with contextlib.suppress(AttributeError, OSError, TypeError):
        mallopt = ctypes.CDLL(None).mallopt
        for number, name, size in MALLOC_OPTIONS:
            if f'MALLOC_{name}_THRESHOLD_' not in os.environ:
                mallopt(number, size)


def _init(args: list[str]) -> None:
    """Begin with ROS 2; where its folder of logs cannot be made, without files of logs, which would end us here."""
    try:
        rclpy.init(args=args, signal_handler_options=SignalHandlerOptions.NO)
    except RCLError as error:
        if not str(error).startswith(NO_LOGGING):
            raise
        rclpy.try_shutdown()  # of what is half begun
        rclpy.init(args=[*args, '--ros-args', '--disable-external-lib-logs'],
                   signal_handler_options=SignalHandlerOptions.NO)
        reason = str(error).removeprefix(NO_LOGGING).split(', at ', 1)[0]
        get_logger('line_feature_node').warning(f'there is no file of the log, set ROS_LOG_DIR to have one: {reason}')


def _started(args: list[str]) -> LineFeatureNode:
    try:
        _init(args)
    except UnknownROSArgsError as error:
        raise ConfigurationError(f'unknown arguments behind --ros-args: {error}') from None
    unknown = remove_ros_args(args)[1:]
    if unknown:
        raise ConfigurationError(f'unknown argument {unknown[0]!r}: parameters stand behind --ros-args')
    # Before there is a node: a signal may end the process at once meanwhile, and nobody waits for an answer. And all of
    # them: a change of parameters would hold the node up for long if it had any to compile.
    load_kernels(warm_up_all, get_logger('line_feature_node'))
    return LineFeatureNode()
