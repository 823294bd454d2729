import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from line_feature_node.core import STEPS
from line_feature_node.monitor import LARGEST_JUMP, WINDOW, Level, Monitor, Publishers, Throttle
from line_feature_node.options import Options

TIMES = dict(zip(STEPS, (0.001, 0.002, 0.003, 0.004, 0.005, 0.006, 0.007, 0.008), strict=True))


class Clock:
    """A time that stands still until it is told to go on."""

    def __init__(self):
        self.now = 1000.0

    def __call__(self):
        return self.now


@pytest.fixture
def clock():
    return Clock()


@pytest.fixture
def monitor(clock):
    return Monitor(clock=clock)


def frames(monitor, sequence, latency=0.01, segments=7):
    """Frames that are processed, by their sequence numbers."""
    for number in sequence:
        monitor.receive(number)
        monitor.process(latency, TIMES, segments)


#: The usual state of the image topic.
ONE = Publishers(1, 1)


def health(monitor, publishers=ONE, waiting='waits', **options):
    return monitor.health(Options(**options), publishers=publishers, waiting=waiting)


def test_levels_are_those_of_the_message():
    messages = pytest.importorskip('diagnostic_msgs.msg')
    status = messages.DiagnosticStatus
    assert [bytes([level]) for level in Level] == [status.OK, status.WARN, status.ERROR]


# Frames that were missed

def test_frames_without_a_gap_drop_none(monitor):
    frames(monitor, [41, 42, 43])
    assert vars(monitor.counts) == {'received': 3, 'processed': 3, 'dropped': 0, 'failed': 0}


def test_gaps_of_the_sequence_are_dropped_frames(monitor):
    frames(monitor, [1, 2, 5, 6, 8])
    assert monitor.counts.dropped == 3


def test_first_frame_may_have_any_number(monitor):
    frames(monitor, [5000])
    assert monitor.counts.dropped == 0


@pytest.mark.parametrize('numbers', [[7, 8, 1, 2], [7, 7], [500, 3, 4]])
def test_publisher_that_begins_anew_drops_nothing(monitor, numbers):
    frames(monitor, numbers)
    assert monitor.counts.dropped == 0


def test_gaps_are_counted_on_after_a_publisher_began_anew(monitor):
    frames(monitor, [500, 1, 2, 5])
    assert monitor.counts.dropped == 2


def test_absurd_jump_is_no_loss(monitor):
    frames(monitor, [1, LARGEST_JUMP + 1])
    assert monitor.counts.dropped == LARGEST_JUMP - 1
    frames(monitor, [2 * LARGEST_JUMP + 2])
    assert monitor.counts.dropped == LARGEST_JUMP - 1


def test_unknown_numbers_drop_nothing(monitor):
    frames(monitor, [None, None, 50, None, 51])
    assert monitor.counts.dropped == 0
    assert monitor.counts.received == 5


@pytest.mark.parametrize(('numbers', 'publishers', 'dropped'), [
    ([500, 501, 1, 2, 5, 6, 9], 2, 4),  # the first was killed, and is known of until its lease ends
    ([3, 4, 1, 2, 3, 4, 5, 6, 7], 2, 0), ([3, 4, 1, 2, 3, 4, 5, 8], 2, 2),  # the second overtakes what the first sent
    ([100, 5000, 101, 5001, 5002, 102], 2, 0), ([100, 5000, 103, 5001, 5004, 104], 2, 4),
    ([7, 7, 8, 8, 9, 9, 10, 11], 2, 0), ([7, 7, 8, 8, 9, 10, 10, 12, 12], 2, 3),
    ([1, 30, 60, 2, 31, 61, 5, 32, 62], 3, 2),
])
def test_gaps_of_several_publishers_are_dropped_frames(monitor, numbers, publishers, dropped):
    """Whose number is whose does not matter to the sum, not even where they are the same."""
    for number in numbers:
        monitor.receive(number, publishers)
    assert monitor.counts.dropped == dropped


@pytest.mark.parametrize('lost', [{399, 400, 401}, {399, 400}, {400, 401, 402}, {401}, {400}, {399}, {350, 450}])
def test_gaps_where_a_publisher_overtakes_one_that_was_killed(monitor, lost):
    """Until its lease ends, 20 s later, that is known of; but it sends nothing."""
    for number in range(300, 401):
        monitor.receive(number)
    for number in sorted(set(range(1, 500)) - lost):
        monitor.receive(number, 2)
    monitor.receive(500, 1)
    assert monitor.counts.dropped == len(lost)


@pytest.mark.parametrize('every', [1, 2, 20, 40])
@pytest.mark.parametrize('ahead', [0, 1, 10, 30, 90, 150, 5000])
@pytest.mark.parametrize('lost', [0, 1])
def test_publisher_that_seldom_sends_is_not_taken_for_a_dead_one(monitor, every, ahead, lost):
    """Another sends more often, and overtakes it, or may be near it."""
    for k in range(400):
        monitor.receive(100 + k, 2)
        if k % every == 0:
            monitor.receive(100 + ahead + k // every * (1 + lost), 2)
    assert monitor.counts.dropped == lost * ((400 - 1) // every)


def test_gap_that_may_be_another_publisher_is_no_loss(monitor):
    for number in (10, 11, 400):
        monitor.receive(number, 2)
    assert monitor.counts.dropped == 0


def test_publisher_that_is_gone_is_forgotten(monitor):
    """What comes later is not held against where it was."""
    for number, publishers in ((100, 2), (7, 2), (8, 1), (9, 1), (102, 2)):
        monitor.receive(number, publishers)
    assert monitor.counts.dropped == 0
    monitor.receive(104, 2)
    assert monitor.counts.dropped == 1


@settings(max_examples=300)
@given(
    starts=st.lists(st.integers(1, 40), min_size=1, max_size=4), whose=st.lists(st.integers(0, 3), max_size=60),
    lost=st.sets(st.integers(0, 59)))
def test_never_more_is_dropped_than_was_sent_and_did_not_come(starts, whose, lost):
    """Nearby numbers of several publishers, mixed in any order, of which any may be lost.

    The first of each come from the highest down: one that is next to another might be what that one sent next.
    """
    monitor, latest = Monitor(), list(starts)
    for number in sorted(starts, reverse=True):
        monitor.receive(number, len(starts))
    missing = 0
    for k, publisher in enumerate(whose):
        publisher %= len(starts)
        latest[publisher] += 1
        if k in lost:
            missing += 1
        else:
            monitor.receive(latest[publisher], len(starts))
    assert monitor.counts.dropped <= missing
    if not missing:
        assert monitor.counts.dropped == 0


def test_new_subscription_begins_anew(monitor):
    frames(monitor, [1])
    monitor.restart()
    frames(monitor, [100])
    assert monitor.counts.dropped == 0


def test_dropped_frames_are_not_received(monitor):
    frames(monitor, [1, 11])
    assert vars(monitor.counts) == {'received': 2, 'processed': 2, 'dropped': 9, 'failed': 0}


# Verdicts

@pytest.mark.parametrize('waiting', ['waits for a subscriber (lazy)', 'not active'])
def test_without_a_subscription_all_is_well_however_long(monitor, clock, waiting):
    clock.now += 3600
    state = health(monitor, publishers=None, waiting=waiting)
    assert (state.level, state.summary) == (Level.OK, waiting)


def test_silence_is_an_error_only_after_the_timeout(monitor, clock):
    frames(monitor, [1])
    clock.now += 2.0
    assert health(monitor, image_timeout=2.0).level == Level.OK
    clock.now += 0.1
    state = health(monitor, image_timeout=2.0)
    assert state.level == Level.ERROR
    assert state.summary.startswith('no image for 2 s')


def test_silence_without_a_publisher_says_so(monitor, clock):
    clock.now += 5
    assert health(monitor, publishers=Publishers(0, 0)).summary == 'no image for 5 s: the topic has no publisher'


@pytest.mark.parametrize(('publishers', 'reason'), [
    (Publishers(2, 0), 'does not fit, see the log for the quality of service'),
    (Publishers(2, 0, 'std_msgs/msg/String'), 'sends std_msgs/msg/String, see the parameter image_transport'),
    (Publishers(2, 1), 'sends nothing, or its images are lost'),
    (Publishers(2, 1, 'std_msgs/msg/String'), 'sends nothing, or its images are lost')])
def test_silence_with_a_publisher_is_told_from_one_that_does_not_fit(monitor, clock, publishers, reason):
    clock.now += 5
    state = health(monitor, publishers=publishers)
    assert state.level == Level.ERROR
    assert reason in state.summary


def test_new_subscription_gets_time_for_its_first_image(monitor, clock):
    clock.now += 60
    monitor.restart()
    clock.now += 1
    assert health(monitor, image_timeout=2.0).level == Level.OK


def test_bad_frames_are_not_silence(monitor, clock):
    clock.now += 60
    monitor.receive(1)
    monitor.fail('no data')
    assert health(monitor).summary == 'no image can be processed: no data'


def test_only_bad_frames_are_an_error(monitor):
    monitor.receive(1)
    monitor.fail('unknown encoding')
    state = health(monitor)
    assert (state.level, state.summary) == (Level.ERROR, 'no image can be processed: unknown encoding')


def test_bad_frames_among_good_ones_are_a_warning(monitor):
    frames(monitor, [1, 2])
    monitor.receive(3)
    monitor.fail('unknown encoding')
    state = health(monitor)
    assert (state.level, state.summary) == (Level.WARN, '1 of 3 images failed: unknown encoding')


def test_verdict_is_on_the_time_since_the_last_one(monitor, clock):
    monitor.receive(1)
    monitor.fail('unknown encoding')
    assert health(monitor).level == Level.ERROR
    clock.now += 1
    frames(monitor, [2])
    state = health(monitor)
    assert state.level == Level.OK
    assert state.values['last error'] == 'unknown encoding'
    assert state.values['frames failed'] == '1'


def test_dropped_frames_are_a_warning_from_the_threshold(monitor):
    frames(monitor, [*range(1, 9), 10])  # 1 of 10
    assert health(monitor, max_dropped=0.1).level == Level.OK
    frames(monitor, [*range(11, 18), 20])  # 2 of 10
    state = health(monitor, max_dropped=0.1)
    assert (state.level, state.summary) == (Level.WARN, '2 of 10 images were dropped')


def test_every_dropped_frame_can_be_made_a_warning_and_none(monitor):
    frames(monitor, [1, 3])
    assert health(monitor, max_dropped=0.0).level == Level.WARN
    frames(monitor, [100])
    assert health(monitor, max_dropped=1.0).level == Level.OK


def test_late_segments_are_a_warning(monitor):
    frames(monitor, range(90), latency=0.01)
    assert health(monitor, max_latency=0.1).level == Level.OK
    frames(monitor, range(90, 100), latency=0.25)
    state = health(monitor, max_latency=0.1)
    assert (state.level, state.summary) == (Level.WARN, '5 % of the segments come 250 ms or later after their images')


def test_old_latencies_are_forgotten(monitor):
    frames(monitor, range(50), latency=9.0)
    frames(monitor, range(50, 50 + WINDOW), latency=0.01)
    assert health(monitor).level == Level.OK


def test_what_is_worse_is_said_first(monitor):
    """Errors before warnings, and of warnings failures before drops before latency."""
    frames(monitor, [1, 100], latency=9.0)
    assert 'dropped' in health(monitor).summary
    frames(monitor, [101, 200], latency=9.0)
    monitor.receive(201)
    monitor.fail('no data')
    assert 'failed' in health(monitor).summary


def test_when_all_is_well_the_segments_are_told(monitor):
    frames(monitor, [1, 2], segments=42)
    assert (health(monitor).level, health(monitor).summary) == (Level.OK, '42 segments in the last image')


# Figures

def test_every_figure_has_its_name(monitor):
    assert list(health(monitor).values) == [
        'frames received', 'frames processed', 'frames dropped', 'frames failed', 'rate (Hz)', 'latency p50 (ms)',
        'latency p95 (ms)', 'latency p99 (ms)', *(f'{step} (ms)' for step in STEPS), 'extraction (ms)', 'segments',
        'last error']


def test_figures_before_the_first_frame_are_zero(monitor):
    values = health(monitor).values
    assert values.pop('last error') == ''
    assert {float(value) for value in values.values()} == {0.0}


def test_frames_are_counted_from_the_start(monitor, clock):
    for sequence in ([1, 2], [4, 6]):
        clock.now += 1
        frames(monitor, sequence)
        monitor.receive(sequence[-1] + 1)
        monitor.fail('x')
        values = health(monitor).values
    assert [values[f'frames {name}'] for name in ('received', 'processed', 'dropped', 'failed')] == ['6', '4', '1', '2']


def test_rate_is_of_processed_frames_since_the_last_verdict(monitor, clock):
    clock.now += 1
    frames(monitor, range(30))
    assert health(monitor).values['rate (Hz)'] == '30.0'
    clock.now += 2
    frames(monitor, range(30, 45))
    assert health(monitor).values['rate (Hz)'] == '7.5'


def test_two_verdicts_at_one_moment_do_not_divide_by_zero(monitor):
    assert health(monitor).values['rate (Hz)'] == health(monitor).values['rate (Hz)'] == '0.0'


def test_percentiles_of_the_latency(monitor):
    for k in range(101):
        frames(monitor, [k], latency=k * 1e-3)
    values = health(monitor).values
    assert [values[f'latency p{p} (ms)'] for p in (50, 95, 99)] == ['50.00', '95.00', '99.00']


def test_time_of_each_step_is_the_median_and_their_sum_the_extraction(monitor):
    frames(monitor, range(3))
    monitor.receive(3)
    monitor.process(0.01, dict.fromkeys(STEPS, 5.0), 1)  # one that was interrupted
    values = health(monitor).values
    assert [float(values[f'{step} (ms)']) for step in STEPS] == pytest.approx([1, 2, 3, 4, 5, 6, 7, 8])
    assert float(values['extraction (ms)']) == pytest.approx(36)


def test_segments_are_those_of_the_last_frame(monitor):
    frames(monitor, [1], segments=9)
    frames(monitor, [2], segments=0)
    assert health(monitor).values['segments'] == '0'


def test_reasons_are_counted_without_their_figures(monitor):
    for size in (10, 11, 12):
        monitor.fail(f'wrong size: {size} bytes')
    monitor.fail('no data')
    values = health(monitor).values
    assert values['failed: wrong size'] == '3'
    assert values['failed: no data'] == '1'
    assert values['last error'] == 'no data'


def test_five_most_common_reasons_are_told(monitor):
    for k in range(8):
        for _ in range(k + 1):
            monitor.fail(f'reason {k}')
    told = [name for name in health(monitor).values if name.startswith('failed: ')]
    assert told == [f'failed: reason {k}' for k in (7, 6, 5, 4, 3)]


def test_noise_in_the_reasons_does_not_fill_the_memory(monitor):
    for _ in range(3):
        monitor.fail('common')
    for k in range(10 * WINDOW):
        monitor.fail(f'noise {k}')
    assert len(monitor.reasons) <= WINDOW
    assert monitor.reasons['common'] == 3
    assert monitor.counts.failed == 10 * WINDOW + 3


def test_the_clock_runs_by_itself_where_none_is_given():
    before = Monitor()
    assert health(before).level == Level.OK
    assert before.clock() <= before.clock()


def test_throttle_lets_each_kind_through_once_a_period():
    times = iter([0.0, 1.0, 1.0, 4.9, 5.0, 5.1, 6.0])
    throttle = Throttle(5.0, lambda: next(times))
    kinds = ['frame', 'frame', 'callback', 'frame', 'frame', 'frame', 'callback']
    assert [throttle.allows(kind) for kind in kinds] == [True, False, True, False, True, False, True]
