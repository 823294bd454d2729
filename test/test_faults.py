"""What is done to the node from outside: it is stopped, ended, starved, doubled and left alone. docs/reliability.md."""

import itertools
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import cv2
import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.parameter_client import AsyncParameterClient
from sensor_msgs.msg import CompressedImage
from test_node import NAME, RELIABLE, SEGMENTS, expected, image, picture
from test_node_process import START, over_dds

from line_feature_node.messages import segments_of

#: Nodes on one machine; the campaign has more.
NODES = int(os.environ.get('LINE_FEATURE_TEST_NODES', '6'))
#: In a namespace of its own the shared memory can be made small; others than root need one of users, too.
UNSHARE = ['unshare', '-m' if os.getuid() == 0 else '-Urm', 'sh', '-c']
SMALL = 'mount -t tmpfs -o size=$0 tmpfs /dev/shm && exec "$@"'
#: Set where the shared memory is the test's own.
PRIVATE = 'LINE_FEATURE_TEST_PRIVATE_SHM'

CAMERA = """
import array, rclpy
from sensor_msgs.msg import Image
rclpy.init()
camera = rclpy.create_node('camera').create_publisher(Image, 'image', 5)
image = Image(height=3000, width=4000, encoding='mono8', step=4000, data=array.array('B', bytes(12000000)))
while True:
    print(camera.get_subscription_count() and 'sending', flush=True)
    camera.publish(image)
    print('sent', flush=True)
"""

IDLER = """
import sys, time, rclpy
from rclpy.qos import HistoryPolicy, QoSProfile
from sensor_msgs.msg import CompressedImage, Image, PointCloud2
rclpy.init()
node = rclpy.create_node('idler')
qos = QoSProfile(depth=1, history=HistoryPolicy.KEEP_ALL)
topics = {'segments': PointCloud2, 'overlay': Image, 'edges': Image, 'overlay/compressed': CompressedImage}
kept = [node.create_subscription(kind, f'line_feature_node/{topic}', print, qos) for topic, kind in topics.items()]
while not all(one.get_publisher_count() for one in kept):
    time.sleep(0.01)
print('idle', flush=True)
time.sleep(1000)
"""


@pytest.fixture
def run():
    """Runs other processes of ROS 2; what they print can be read."""
    processes = []

    def run(program):
        processes.append(subprocess.Popen([sys.executable, '-c', program], stdout=subprocess.PIPE, text=True))
        return processes[-1]

    yield run
    for process in processes:
        process.kill()
        process.wait()
        process.stdout.close()


def until_said(process, word):
    """Wait until a process prints a word, and nothing after it yet."""
    for line in process.stdout:
        if line.strip() == word:
            return
    pytest.fail(f'it ended without saying {word!r}')


def figures(health, name=NAME):
    """What a node said of its frames last."""
    found = [status for message in health for status in message.status if status.name.startswith(f'{name}:')]
    return {value.key.removeprefix('frames '): int(value.value) for value in found[-1].values
            if value.key.startswith('frames ')} if found else {}


def numbered(pixels, number):
    return image(pixels, stamp=(number, 0))


def ask(bench, camera, messages, numbers):
    """Publish pictures until one of them is answered; its number."""
    bench.until(camera.get_subscription_count, 'subscription of the process')
    known, asked = len(messages), []

    def answered():
        fresh = [message.header.stamp.sec for message in messages[known:]]
        if not set(fresh) & set(asked):
            asked.append(next(numbers))
            camera.publish(numbered(picture(), asked[-1]))
        return set(fresh) & set(asked)

    bench.until(answered, 'segments')
    return min(answered())


def state(pid):
    """Of a process: R, S, D, T and so on; and the seconds that it had a processor."""
    fields = Path(f'/proc/{pid}/stat').read_text().rsplit(')', 1)[1].split()
    return fields[0], (int(fields[11]) + int(fields[12])) / os.sysconf('SC_CLK_TCK')


def ends_well(process, number=signal.SIGTERM):
    assert process.end(number) == 0
    assert 'Traceback' not in process.log


# Signals

def test_node_that_was_stopped_goes_on_and_counts_what_it_missed(bench, start):
    process = start()
    segments, health = bench.listen(), bench.listen('/diagnostics', DiagnosticArray)
    camera, numbers = bench.camera(), itertools.count(1)
    first = ask(bench, camera, segments, numbers)
    process.process.send_signal(signal.SIGSTOP)
    bench.until(lambda: state(process.process.pid)[0] == 'T', 'the stop')
    for number in itertools.islice(numbers, 60):
        camera.publish(numbered(picture(), number))
        bench.work_off()
    process.process.send_signal(signal.SIGCONT)
    ask(bench, camera, segments, numbers)
    sent = next(numbers) - first

    def all_counted():
        found = figures(health)
        return found and found['received'] + found['dropped'] == sent

    bench.until(all_counted, f'{sent} frames in the diagnostics')
    found = figures(health)
    assert found['dropped'] > 0
    assert found['processed'] == found['received'] == len(segments)
    ends_well(process)


@pytest.mark.parametrize('number', [signal.SIGINT, signal.SIGTERM])
def test_signal_while_a_frame_is_processed_ends_the_node_with_status_0(bench, start, number):
    process = start('--ros-args', '-p', 'image_transport:=compressed',
                    '-p', 'qos_overrides./image/compressed.subscription.reliability:=reliable')
    segments, camera = bench.listen(), bench.camera('/image/compressed', CompressedImage)
    bench.until(camera.get_subscription_count, 'subscription of the process')
    board = np.kron(np.indices((400, 500)).sum(axis=0) % 2, np.ones((10, 10))).astype(np.uint8) * 200
    before = state(process.process.pid)[1]
    camera.publish(CompressedImage(format='png', data=cv2.imencode('.png', board)[1].tobytes()))
    bench.until(lambda: state(process.process.pid)[1] > before + 0.15, 'work on the frame')
    assert not segments
    ends_well(process, number)


# Peers

def test_camera_that_is_killed_in_the_middle_of_a_message_does_no_harm(bench, start, run):
    """No more than its last pictures are lost, and the next camera is served."""
    process = start()
    segments, numbers = bench.listen(), itertools.count(1)
    for _ in range(10):  # where other processes hold this one up, it comes too late
        killed = run(CAMERA)
        for _ in range(3):
            until_said(killed, 'sending')
        time.sleep(0.002)  # into publish(), which takes longer
        killed.kill()
        if 'sent' not in killed.stdout.read():
            break
    else:
        pytest.fail('no camera was killed in the middle of a message')
    camera = bench.camera()
    for _ in range(5):
        number = ask(bench, camera, segments, numbers)
        [message] = [message for message in segments if message.header.stamp.sec == number]
        assert segments_of(message).tobytes() == expected(picture()).tobytes()
    ends_well(process)


@pytest.mark.parametrize('stopped', [False, True], ids=['idle', 'stopped'])
def test_subscriber_that_never_takes_its_messages_holds_nobody_up(bench, start, run, stopped):
    """It asks for all of them, reliably. As a process that is stopped it does not even say what it has."""
    process = start()
    idler = run(IDLER)
    until_said(idler, 'idle')
    if stopped:
        idler.send_signal(signal.SIGSTOP)
    segments, camera, numbers = bench.listen(), bench.camera(), itertools.count(1)
    for _ in range(100):
        ask(bench, camera, segments, numbers)
    assert state(idler.pid)[0] == ('T' if stopped else 'S')
    ends_well(process)


def test_two_nodes_of_one_name_both_answer(bench, start):
    """ROS 2 lets them; each says the same of the same picture, and what one is asked the other may answer."""
    first, second = start(), start()
    segments, camera = bench.listen(), bench.camera(reliability=RELIABLE)
    bench.until(lambda: camera.get_subscription_count() == 2, 'subscriptions of both')
    bench.until(lambda: segments.subscription.get_publisher_count() == 2, 'publishers of both')

    def both():
        if not {1, 2} & {[message.header.stamp.sec for message in segments].count(number) for number in range(50)}:
            camera.publish(image(picture()))
        return len(segments) >= 2

    bench.until(both, 'two answers')
    assert {segments_of(message).tobytes() for message in segments} == {expected(picture()).tobytes()}
    parameters = AsyncParameterClient(bench.peer, NAME)
    bench.until(parameters.services_are_ready, 'parameters')
    assert bench.wait(parameters.get_parameters(['T1'])).values[0].double_value == 4.0
    ends_well(first)
    bench.until(lambda: segments.subscription.get_publisher_count() == 1, 'the end of one')
    ask(bench, camera, segments, itertools.count(1000))
    ends_well(second)


def test_many_nodes_on_one_machine_all_answer(bench, start):
    names = [f'/robot{number}{NAME}' for number in range(NODES)]
    processes = [start('--ros-args', '-r', f'__ns:=/robot{number}', '-r', 'image:=/image') for number in range(NODES)]
    segments, camera = [bench.listen(f'{name}/segments') for name in names], bench.camera()
    bench.until(lambda: camera.get_subscription_count() == NODES, 'subscriptions of all')
    for messages in segments:
        ask(bench, camera, messages, itertools.count(1))
    for process in processes:
        process.process.terminate()
    for process in processes:
        assert process.process.wait(START) == 0  # all at once take their time
        assert 'Traceback' not in process.log


# Places

def in_small_memory(size, test):
    """Run another test with shared memory of so many bytes."""
    if subprocess.run([*UNSHARE, SMALL, '1m', 'true'], capture_output=True, check=False).returncode:
        pytest.skip('no file system can be mounted here')
    pytest_alone = [sys.executable, '-m', 'pytest', '-q', '-p', 'no:cacheprovider', test]
    done = subprocess.run(
        [*UNSHARE, SMALL, size, *pytest_alone], timeout=3 * START, capture_output=True, text=True, check=False,
        cwd=Path(__file__).parent, env={**os.environ, PRIVATE: '1'})
    assert done.returncode == 0, done.stdout
    assert '1 passed' in done.stdout


@pytest.mark.parametrize('size', ['64k', '700k'])
def test_full_shared_memory_at_the_start_is_done_without(size):
    """The first has no room for any process, the second for one."""
    in_small_memory(size, 'test_node_process.py::test_picture_of_one_process_becomes_segments_of_another')


def test_shared_memory_that_fills_while_the_node_runs_is_done_without():
    in_small_memory('8m', f'{Path(__file__).name}::test_shared_memory_is_filled')


@pytest.mark.skipif(PRIVATE not in os.environ, reason='only where the shared memory is the own one of the test')
def test_shared_memory_is_filled(bench, start, run):
    process = start()
    segments, camera, numbers = bench.listen(), bench.camera(), itertools.count(1)
    ask(bench, camera, segments, numbers)
    with pytest.raises(OSError, match='No space'):
        Path('/dev/shm/filling').write_bytes(bytes(8 * 2**20))
    for _ in range(20):
        ask(bench, camera, segments, numbers)
    idler = run(IDLER)  # it comes when all is full
    until_said(idler, 'idle')
    again = start('--ros-args', '-r', '__ns:=/late', '-r', 'image:=/image')
    late = bench.listen(f'/late{SEGMENTS}')
    ask(bench, camera, late, numbers)
    ask(bench, camera, segments, numbers)
    ends_well(again)
    ends_well(process)


def test_home_that_cannot_be_written_is_done_without(bench, start):
    process = start(ROS_LOG_DIR='', HOME='/proc/none', XDG_CACHE_HOME='/proc/none')
    [warning] = [line for line in process.log.splitlines() if '[WARN]' in line]
    assert "no file of the log, set ROS_LOG_DIR to have one: Failed to create log directory '/proc/none/" in warning
    over_dds(bench, '/image', SEGMENTS, picture())
    ends_well(process)
