"""The node as a process of its own, as `ros2 run` starts it."""

import os
import signal
import subprocess
import sys
import time

import pytest
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.parameter import parameter_value_to_python
from rclpy.qos import QoSProfile
from sensor_msgs.msg import CompressedImage, Image
from test_node import DEADLINE, expected, image, picture

from line_feature_node.messages import segments_of

#: Seconds until a process has its kernels, which may have to be compiled, and until it ends.
START = 150.0


class Process:
    """A node that runs beside the test; what it says goes into a file.

    It is run by a command, if there is one, which stands before it.
    """

    def __init__(self, folder, *arguments, command=(), **environment):
        self.path = folder / f'log{len(list(folder.glob("log*")))}'
        with self.path.open('wb') as log:
            self.process = subprocess.Popen(
                [*command, sys.executable, '-m', 'line_feature_node', *arguments], stdout=log, stderr=log, cwd=folder,
                env={**os.environ, 'ROS_LOG_DIR': str(folder / 'ros'), **environment})

    @property
    def log(self):
        return self.path.read_text()

    def end(self, number=signal.SIGTERM):
        self.process.send_signal(number)
        return self.process.wait(DEADLINE)


def refused(folder, *arguments):
    """Standard error of a node that does not start; its exit status is 2."""
    done = subprocess.run(
        [sys.executable, '-m', 'line_feature_node', *arguments], capture_output=True, text=True, timeout=START,
        check=False, cwd=folder, env={**os.environ, 'ROS_LOG_DIR': str(folder / 'ros')})
    assert done.returncode == 2, done.stderr
    assert done.stdout == ''
    assert 'Traceback' not in done.stderr
    return done.stderr


IDLE = 'is for /line_feature_node: the name of a section in it must be this one'


@pytest.mark.parametrize(('section', 'arguments', 'warned'), [
    ('lines', [], True), ('lines', ['-p', 'T2:=2.5'], True), ('/front/line_feature_node', [], True),
    ('line_feature_node', [], False), ('/**', [], False), ('/**', ['-p', 'T1:=9.5'], False)])
def test_parameter_file_without_anything_for_the_node_is_warned_of(start, tmp_path, section, arguments, warned):
    path = tmp_path / 'some.yaml'
    path.write_text(f'{section}: {{ros__parameters: {{T1: 9.0}}}}')
    process = start('--ros-args', '--params-file', str(path), *arguments, '-p', 'lazy:=false')
    assert (IDLE in process.log) == warned


@pytest.mark.parametrize('text', [
    '', '# nothing', '/**: {ros__parameters: {camera: {fps: 30}}}', 'a: {ros__parameters: {day: 2024-13-45}}',
    '/**: {ros__parameters: {qos_overrides: {/image: {subscription: {depth: 20}}}}}'])
def test_parameter_file_of_any_kind_that_ros_accepts_lets_the_node_start(start, tmp_path, text):
    path = tmp_path / 'some.yaml'
    path.write_text(text)
    process = start('--ros-args', '--params-file', str(path), '-p', 'lazy:=false')
    assert IDLE not in process.log
    assert ('depth 20' in process.log) == ('depth' in text)


def over_dds(bench, topic, segments_topic, pixels):
    """The segments that a process makes of a picture that is published here, until one of them arrives."""
    messages = bench.listen(segments_topic)
    camera = bench.peer.create_publisher(Image, topic, QoSProfile(depth=1))
    bench.until(camera.get_subscription_count, 'subscription of the process')

    def answered():
        if not messages:
            camera.publish(image(pixels))  # best effort: an image may be lost
        return messages

    bench.until(answered, 'segments')
    return messages[0]


@pytest.mark.parametrize('number', [signal.SIGINT, signal.SIGTERM])
def test_signal_ends_the_node_with_status_0(start, number):
    process = start('--ros-args', '-p', 'lazy:=false')
    assert process.end(number) == 0
    assert 'Traceback' not in process.log
    assert 'rror' not in process.log.replace('[ERROR]', 'error')


def test_signal_while_the_node_becomes_ready_ends_it_with_status_0(start):
    process = start(word='kernels are ready')
    assert process.end() == 0
    assert 'Traceback' not in process.log


@pytest.mark.parametrize('number', [signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize('autostart', ['true', 'false'])
def test_signal_while_kernels_are_compiled_ends_the_node_at_once(tmp_path, number, autostart):
    """Where nothing is compiled yet; the compiler calls Python back, and exceptions are lost there."""
    cache = tmp_path / 'cache'
    process = Process(tmp_path, '--ros-args', '-p', f'autostart:={autostart}', NUMBA_CACHE_DIR=str(cache))
    end = time.monotonic() + START
    while not list(cache.rglob('*.nbc')) and time.monotonic() < end:
        time.sleep(0.01)
    assert list(cache.rglob('*.nbc')), process.log
    time.sleep(0.7)  # into the next kernel
    process.process.send_signal(number)
    assert process.process.wait(5) == 0
    assert 'ready; waits' not in process.log
    assert 'Traceback' not in process.log


def test_picture_of_one_process_becomes_segments_of_another(bench, start):
    process = start()
    message = over_dds(bench, '/image', '/line_feature_node/segments', picture())
    assert (message.header.stamp.sec, message.header.stamp.nanosec, message.header.frame_id) == (12, 345, 'camera')
    assert segments_of(message).tobytes() == expected(picture()).tobytes()
    assert process.end() == 0
    assert 'Traceback' not in process.log


def test_node_namespace_and_image_can_be_remapped(bench, start):
    process = start('--ros-args', '-r', 'image:=/front/image_raw', '-r', '__node:=lines', '-r', '__ns:=/robot')
    assert '/front/image_raw (lazy)' in process.log
    message = over_dds(bench, '/front/image_raw', '/robot/lines/segments', picture())
    assert segments_of(message).tobytes() == expected(picture()).tobytes()
    assert ('lines', '/robot') in bench.peer.get_node_names_and_namespaces()
    assert process.end(signal.SIGINT) == 0


def test_parameters_file_with_whole_numbers_and_a_misspelt_name(bench, start, tmp_path):
    """Both are common: 50 for 50.0, and a name that is nobody's."""
    path = tmp_path / 'params.yaml'
    path.write_text('/**:\n  ros__parameters:\n    T1: 50\n    T2: 20\n    n: 6.0\n    min_lenght: 30\n'
                    '    roi: [0, 0, 70, 60]\n    qos_overrides:\n      /image:\n        subscription:\n'
                    '          reliability: reliable\n')
    process = start('--ros-args', '--params-file', str(path))
    warnings = [line for line in process.log.splitlines() if '[WARN]' in line]
    assert len(warnings) == 1
    assert "'min_lenght'" in warnings[0]
    assert "did you mean 'min_length'?" in warnings[0]
    answer = bench.wait(bench.parameters().get_parameters(['T1', 'T2', 'n', 'roi']))
    found = [parameter_value_to_python(value) for value in answer.values]
    assert found[:3] == [50.0, 20.0, 6]
    assert list(found[3]) == [0.0, 0.0, 70.0, 60.0]
    message = over_dds(bench, '/image', '/line_feature_node/segments', picture())
    assert segments_of(message).tobytes() == expected(picture(), T1=50, T2=20, n=6, roi=(0, 0, 70, 60)).tobytes()
    assert 'images on /image (reliable, depth 1)' in process.log


@pytest.mark.parametrize(('arguments', 'reason'), [
    (['--ros-args', '-p', 'T1:=5000'], 'T1 must be 0 to 1000 grey levels/pixel, got 5000'),
    (['--ros-args', '-p', 'T1:=1'], 'T2 must be less than T1, got T2 = 2 and T1 = 1'),
    (['--ros-args', '-p', 'mask_file:=/none.png'], 'mask_file /none.png: No such file or directory'),
    (['--params-file', 'x.yaml'], "unknown argument '--params-file': parameters stand behind --ros-args"),
    (['--ros-args', '--nonsense'], 'unknown arguments behind --ros-args'),
])
def test_wrong_arguments_are_answered_by_one_line_and_status_2(tmp_path, arguments, reason):
    lines = refused(tmp_path, *arguments).splitlines()
    told = [line for line in lines if not line.startswith(('[INFO]', '[ERROR]'))]
    assert len(told) == 1, lines
    assert told[0].startswith('line_feature_node cannot start: ')
    assert reason in told[0]


@pytest.mark.parametrize(('content', 'reason'), [
    (None, 'params.yaml'), ('/**:\n  ros__parameters:\n    T1: [5\n', 'params.yaml'),
    ('/**:\n  ros__parameters:\n    roi: [0, 0.5, 1, 0.5]\n', 'params.yaml')])
def test_parameters_file_that_cannot_be_read_is_named(tmp_path, content, reason):
    path = tmp_path / 'params.yaml'
    if content is not None:
        path.write_text(content)
    told = [line for line in refused(tmp_path, '--ros-args', '--params-file', str(path)).splitlines()
            if line.startswith('line_feature_node cannot start: ')]
    assert len(told) == 1
    assert reason in told[0]


def test_usage_is_shown_when_asked_for(tmp_path):
    done = subprocess.run([sys.executable, '-m', 'line_feature_node', '--help'], capture_output=True, text=True,
                          timeout=START, check=False, cwd=tmp_path)
    assert (done.returncode, done.stderr) == (0, '')
    assert done.stdout.startswith('usage: line_feature_node ')


def test_images_of_another_type_are_named_in_the_diagnostics(bench, start):
    """Not in one process: there a topic has one type."""
    bench.camera(kind=CompressedImage)
    start('--ros-args', '-p', 'lazy:=false', '-p', 'image_timeout:=0.5')
    health = bench.listen('/diagnostics', DiagnosticArray)
    bench.until(lambda: any('sends sensor_msgs/msg/CompressedImage, see the parameter image_transport'
                            in status.message for message in health for status in message.status), 'the reason', START)
