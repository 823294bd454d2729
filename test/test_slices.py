import csv
import dataclasses
import importlib
import io
import pickle
from collections import Counter, deque
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rosbags.rosbag2 import Reader
from test_recordings import (
    BEGIN,
    COMPRESSED,
    IMAGE,
    ROS1,
    ROS2,
    STEP,
    film,
    header,
    image,
    lone,
    picture,
    shared,
    stamp_of,
    write,
    write_ros1,
    write_split,
)

from line_feature_node.bag import Run, process_recording
from line_feature_node.core import SEGMENT_DTYPE, LineFeatureExtractor, Parameters
from line_feature_node.messages import segments_of
from line_feature_node.overlay import COLOURS
from line_feature_node.recordings import (
    DECODERS,
    OUTPUTS,
    RecordingError,
    Slice,
    deserialize,
    find_recordings,
    opened,
    plan,
)
from line_feature_node.slices import (
    CSV,
    LIMIT,
    MESSAGES,
    Frame,
    Job,
    _read,
    pack,
    process_slice,
    rests,
    segments_as_text,
    unpack,
)
from line_feature_node.workers import inline

JOB = Job(Parameters())
SAMPLES = Path(__file__).resolve().parents[1] / 'bags'


def frames_of(path, job=JOB, topics=(), **options):
    """All frames of a recording, slice by slice."""
    return [frame for part in plan(path, topics=list(topics), **options)
            for frame in unpack(process_slice(part, job))]


def cloud_of(frame):
    return ROS2.deserialize_cdr(frame.messages['segments'], OUTPUTS['segments'])


def found(pixels, mask=None, **parameters):
    return LineFeatureExtractor(Parameters(**parameters)).extract(pixels, mask)


def one(folder, *entries):
    """The frames of a new recording."""
    return frames_of(write(folder / 'one', list(entries)))


# Packing

@st.composite
def frames(draw):
    floats = st.floats(allow_nan=False, width=64)
    return Frame(
        topic=draw(st.text(max_size=20)), number=draw(st.integers(0, 2**63)), stamp=draw(st.integers(0, 2**63 - 1)),
        error=draw(st.text(max_size=30)), segments=draw(st.integers(0, 10**6)), seconds=draw(floats),
        orientations=draw(st.lists(floats, max_size=18)), agreement=draw(st.lists(floats, max_size=4)),
        messages=draw(st.dictionaries(st.sampled_from(['segments', 'markers', 'overlay', 'csv']),
                                      st.binary(max_size=200))))


@settings(max_examples=50, deadline=None)
@given(st.lists(frames(), max_size=6))
def test_what_is_packed_comes_out_again(some):
    assert unpack(pack(some)) == some


def test_floats_that_are_no_numbers_come_out_again():
    [frame] = unpack(pack([Frame('/a', 0, 0, agreement=[float('nan'), float('inf')])]))
    assert np.isnan(frame.agreement[0])
    assert frame.agreement[1] == float('inf')


def test_nothing_is_packed_too():
    assert unpack(pack([])) == []


def test_what_is_packed_is_whole_in_one_piece_and_the_frames_stay_as_they_are():
    frame = Frame('/a', 1, 2, messages={'segments': b'abc', 'csv': b''})
    before = dataclasses.replace(frame, messages=dict(frame.messages))
    assert isinstance(pack([frame]), bytes)
    assert frame == before


def test_a_job_can_be_sent_to_another_process():
    job = Job(Parameters(T1=9.0), np.ones((3, 4), np.uint8), ('segments',), truth=True, csv=True)
    copy = pickle.loads(pickle.dumps(job))
    assert copy.parameters == job.parameters
    np.testing.assert_array_equal(copy.mask, job.mask)
    assert (copy.outputs, copy.truth, copy.csv) == (job.outputs, True, True)


# Results

ENCODINGS = {
    'mono8': picture(), 'mono16': picture().astype(np.uint16) * 200, '32FC1': picture().astype(np.float32),
    'bgr8': np.stack([picture(1), picture(2), picture(3)], -1),
    'rgb8': np.stack([picture(1), picture(2), picture()], -1),
    'bayer_rggb8': picture(4), 'yuyv': np.stack([picture(5), picture(6)], -1)}


@pytest.mark.parametrize('encoding', ENCODINGS)
def test_equal_pixels_give_equal_segments_to_the_bit(tmp_path, encoding):
    message = image(ENCODINGS[encoding], encoding=encoding)
    [frame] = one(tmp_path, ('/camera', IMAGE, BEGIN, message))
    expected = found(DECODERS[IMAGE](message))
    assert frame.error == ''
    assert frame.segments == len(expected) > 0
    assert segments_of(cloud_of(frame)).tobytes() == expected.tobytes()


@pytest.mark.parametrize('form', ['.png', '.jpg'])
def test_compressed_images_give_the_segments_of_what_is_decoded(tmp_path, form):
    data = cv2.imencode(form, picture())[1]
    message = ROS2.types[COMPRESSED](header=header(), format=form, data=data.reshape(-1))
    [frame] = one(tmp_path, ('/camera', COMPRESSED, BEGIN, message))
    expected = found(cv2.imdecode(data, cv2.IMREAD_GRAYSCALE))
    assert segments_of(cloud_of(frame)).tobytes() == expected.tobytes()


def test_segments_do_not_depend_on_what_was_extracted_before(tmp_path):
    path = write(tmp_path / 'rec', film(80))
    for number, frame in enumerate(frames_of(path)):
        assert segments_of(cloud_of(frame)).tobytes() == found(picture(number)).tobytes()


def test_ros1_and_every_storage_give_the_same_bytes(tmp_path):
    paths = [write(tmp_path / 'a', film(40)), write(tmp_path / 'b', film(40), 'sqlite3'),
             write_ros1(tmp_path / 'c.bag', film(40, types=ROS1), 'lz4'),
             lone(write(tmp_path / 'd', film(40)), tmp_path / 'd.mcap')]
    results = [[(frame.topic, frame.stamp, frame.messages) for frame in frames_of(path)] for path in paths]
    assert len(results[0]) == 40
    assert all(result == results[0] for result in results)


def test_the_parameters_are_used(tmp_path):
    path = write(tmp_path / 'rec', film(3))
    for frame in frames_of(path, Job(Parameters.profile('paper', min_length=12.0))):
        expected = LineFeatureExtractor(Parameters.profile('paper', min_length=12.0)).extract(picture(frame.number))
        assert segments_of(cloud_of(frame)).tobytes() == expected.tobytes()


def test_the_mask_hides_edges(tmp_path):
    path = write(tmp_path / 'rec', film(2))
    mask = np.full((48, 64), 255, np.uint8)
    mask[:, :32] = 0
    for frame in frames_of(path, dataclasses.replace(JOB, mask=mask)):
        expected = found(picture(frame.number), mask)
        assert segments_of(cloud_of(frame)).tobytes() == expected.tobytes()
        assert expected.tobytes() != found(picture(frame.number)).tobytes()
    for frame in frames_of(path, dataclasses.replace(JOB, mask=np.zeros((48, 64), np.uint8))):
        assert (frame.error, frame.segments) == ('', 0)


def test_pixels_that_are_no_numbers_are_masked(tmp_path):
    pixels = picture().astype(np.float32)
    pixels[20:30, 20:30] = np.nan
    [frame] = one(tmp_path, ('/camera', IMAGE, BEGIN, image(pixels, encoding='32FC1')))
    expected = found(pixels, np.isfinite(pixels))
    assert segments_of(cloud_of(frame)).tobytes() == expected.tobytes()


def test_a_mask_of_another_size_is_an_error_of_each_frame(tmp_path):
    some = frames_of(write(tmp_path / 'rec', film(3)), dataclasses.replace(JOB, mask=np.ones((5, 5), np.uint8)))
    assert len({frame.error for frame in some}) == 1
    assert 'mask' in some[0].error


# Messages

@pytest.mark.parametrize('stamp', [(0, 0), (12, 345), (2**31 - 1, 999_999_999), (-5, 7)])
@pytest.mark.parametrize('frame_id', ['', 'front/camera_optical', 'Kamera links: ä'])
def test_every_output_has_the_whole_header_and_the_frame_the_stamp_of_the_recording(tmp_path, stamp, frame_id):
    [frame] = one(tmp_path, ('/camera', IMAGE, BEGIN, image(picture(), stamp=stamp, frame_id=frame_id)))
    assert (frame.stamp, frame.header_stamp) == (BEGIN, stamp[0] * 10**9 + stamp[1])
    assert set(frame.messages) == set(OUTPUTS)
    for name, kind in OUTPUTS.items():
        made = ROS2.deserialize_cdr(frame.messages[name], kind).header
        assert (made.stamp.sec, made.stamp.nanosec, made.frame_id) == (*stamp, frame_id)


def test_the_header_of_ros1_is_kept_without_its_number(tmp_path):
    path = write_ros1(tmp_path / 'rec.bag', film(3, types=ROS1))
    for frame in frames_of(path):
        made, before = cloud_of(frame).header, header(frame.number, types=ROS1)
        assert (made.stamp.sec, made.stamp.nanosec) == (before.stamp.sec, before.stamp.nanosec)
        assert made.frame_id == 'camera'


def test_markers_are_the_lines_of_the_segments(tmp_path):
    [frame] = one(tmp_path, *film(1))
    markers = ROS2.deserialize_cdr(frame.messages['markers'], OUTPUTS['markers'])
    segments = found(picture())
    ends = np.array([(point.x, point.y) for point in markers.points])
    np.testing.assert_array_equal(ends[::2], np.stack([segments['x1'], segments['y1']], -1))
    np.testing.assert_array_equal(ends[1::2], np.stack([segments['x2'], segments['y2']], -1))
    blue, green, red = COLOURS[int(segments['code'][0])]
    colour = markers.outline_colors[0]
    np.testing.assert_allclose([colour.r, colour.g, colour.b], np.array([red, green, blue]) / 255, atol=1e-6)


@pytest.mark.parametrize('encoding', ENCODINGS)
def test_the_overlay_is_a_jpeg_of_the_size_of_the_picture(tmp_path, encoding):
    [frame] = one(tmp_path, ('/camera', IMAGE, BEGIN, image(ENCODINGS[encoding], encoding=encoding)))
    overlay = ROS2.deserialize_cdr(frame.messages['overlay'], OUTPUTS['overlay'])
    assert bytes(overlay.data[:3]) == b'\xff\xd8\xff'
    assert 'jpeg' in overlay.format
    assert cv2.imdecode(overlay.data, cv2.IMREAD_COLOR).shape == (48, 64, 3)


def test_only_what_is_wanted_is_made(tmp_path):
    path = write(tmp_path / 'rec', film(1))
    assert set(frames_of(path, dataclasses.replace(JOB, outputs=('segments',)))[0].messages) == {'segments'}
    assert frames_of(path, dataclasses.replace(JOB, outputs=()))[0].messages == {}
    [frame] = frames_of(path, dataclasses.replace(JOB, outputs=('overlay',), csv=True))
    assert set(frame.messages) == {'overlay', CSV}
    assert frame.segments == len(found(picture()))


def test_the_quality_of_overlays_can_be_chosen(tmp_path):
    path = write(tmp_path / 'rec', film(1))
    small, large = (frames_of(path, dataclasses.replace(JOB, jpeg_quality=quality))[0].messages['overlay']
                    for quality in (10, 95))
    assert len(small) < len(large) / 2


def test_a_picture_without_segments_is_answered_by_none(tmp_path):
    [frame] = one(tmp_path, ('/camera', IMAGE, BEGIN, image(np.full((48, 64), 90, np.uint8))))
    assert (frame.error, frame.segments, cloud_of(frame).width) == ('', 0, 0)
    assert sum(frame.orientations) == 0


def test_orientations_share_out_the_length_of_all_segments(tmp_path):
    [frame] = one(tmp_path, *film(1))
    segments = found(picture())
    assert len(frame.orientations) == 18
    assert sum(frame.orientations) == pytest.approx(segments['length'].sum(), abs=1)
    steep = segments['length'][np.abs(np.degrees(segments['theta'])) > 80].sum()
    assert frame.orientations[0] + frame.orientations[-1] == pytest.approx(steep, abs=0.2)
    assert frame.seconds > 0


# Bad frames

BAD = {
    'encoding': image(picture(), encoding='mono12'), 'step': image(picture(), step=3),
    'rows': image(picture(), height=1000), 'nothing': image(picture(), data=np.zeros(0, np.uint8), height=0),
    'much': image(picture(), height=2**32 - 1, width=2**32 - 1, step=2**32 - 1)}


@pytest.mark.parametrize('bad', BAD)
def test_a_bad_frame_is_an_error_and_the_next_goes_on(tmp_path, bad):
    entries = film(5)
    entries[2] = (*entries[2][:3], BAD[bad])
    some = one(tmp_path, *entries)
    assert [bool(frame.error) for frame in some] == [False, False, True, False, False]
    assert [frame.number for frame in some] == [0, 1, 2, 3, 4]
    assert '\n' not in some[2].error
    assert (some[2].segments, some[2].messages, some[2].stamp) == (0, {}, stamp_of(2))
    assert segments_of(cloud_of(some[3])).tobytes() == found(picture(3)).tobytes()


@pytest.mark.parametrize('data', [b'', b'no picture', cv2.imencode('.jpg', picture())[1].tobytes()[:-200],
                                  cv2.imencode('.png', picture())[1].tobytes()[:400]])
def test_a_bad_compressed_frame_is_an_error_and_the_next_goes_on(tmp_path, data):
    good = cv2.imencode('.jpg', picture())[1].reshape(-1)
    some = one(tmp_path, *(
        ('/camera', COMPRESSED, stamp_of(number), ROS2.types[COMPRESSED](
            header=header(), format='jpeg', data=np.frombuffer(data, np.uint8) if number == 1 else good))
        for number in range(3)))
    assert [bool(frame.error) for frame in some] == [False, True, False]
    assert '\n' not in some[1].error


@pytest.mark.parametrize('share', [0, 0.001, 0.01, 0.5, 0.9])
def test_a_message_that_is_cut_is_an_error_and_the_next_goes_on(tmp_path, share):
    entries = film(3)
    entries[1] = (*entries[1][:3], bytes(ROS2.serialize_cdr(image(picture()), IMAGE)[:int(share * 3136)]))
    some = one(tmp_path, *entries)
    assert [bool(frame.error) for frame in some] == [False, True, False]


def test_a_name_that_is_no_text_is_an_error_and_the_next_goes_on(tmp_path):
    entries = film(3)
    data = bytes(ROS2.serialize_cdr(image(picture()), IMAGE)).replace(b'camera', b'\xff\xfe\xfd\xff\xff\xff')
    entries[1] = (*entries[1][:3], data)
    some = one(tmp_path, *entries)
    assert [bool(frame.error) for frame in some] == [False, True, False]


def test_a_stamp_that_ros2_does_not_have_costs_no_more_than_its_frame(tmp_path):
    entries = film(3, types=ROS1)
    data = bytearray(ROS1.serialize_ros1(entries[1][3], IMAGE))
    data[4:8] = b'\xff' * 4  # seconds, of 32 bits without a sign
    entries[1] = (*entries[1][:3], bytes(data))
    some = frames_of(write_ros1(tmp_path / 'rec.bag', entries))
    assert [bool(frame.error) for frame in some][::2] == [False, False]


def test_a_bad_recording_of_the_world_has_errors_for_frames():
    some = frames_of(shared('bad') / 'image_size_mismatch_sqlite3')
    assert some
    assert any(frame.error for frame in some)
    assert all('\n' not in frame.error for frame in some)


def test_a_recording_that_is_gone_is_a_sentence(tmp_path):
    path = write(tmp_path / 'rec', film(3))
    [part] = plan(path, topics=[])
    path.rename(tmp_path / 'elsewhere')
    with pytest.raises(RecordingError):
        process_slice(part, JOB)


# Numbers

def test_numbers_begin_anew_in_each_slice_and_for_each_topic(tmp_path):
    entries = sorted([*film(50, '/left'), *film(20, '/right', offset=77)], key=lambda entry: entry[2])
    path = write(tmp_path / 'rec', entries)
    for part in plan(path, topics=[]):
        some = unpack(process_slice(part, JOB))
        assert [frame.stamp for frame in some] == sorted(frame.stamp for frame in some)
        for topic in ('/left', '/right'):
            numbers = [frame.number for frame in some if frame.topic == topic]
            assert numbers == list(range(len(numbers)))


@pytest.mark.parametrize('every', [2, 3, 40, 1000])
def test_every_takes_one_of_so_many_frames_of_each_topic_across_slices(tmp_path, every):
    entries = sorted([*film(80, '/left'), *film(33, '/right', offset=77)], key=lambda entry: entry[2])
    some = frames_of(write(tmp_path / 'rec', entries), every=every)
    for topic, offset, count in (('/left', 0, 80), ('/right', 77, 33)):
        numbers = list(range(0, count, every))
        mine = [frame for frame in some if frame.topic == topic]
        assert [frame.number for frame in mine] == numbers
        assert [frame.stamp for frame in mine] == [stamp_of(number) + offset for number in numbers]


def test_a_topic_that_is_named_twice_is_processed_once(tmp_path):
    some = frames_of(write(tmp_path / 'rec', film(4)), topics=['/camera', '/camera'], every=2)
    assert [frame.number for frame in some] == [0, 2]


def test_the_bytes_of_a_slice_are_the_same_but_for_the_time_it_took(tmp_path):
    [part] = plan(write(tmp_path / 'rec', film(5)), topics=[])
    first, second = (unpack(process_slice(part, dataclasses.replace(JOB, csv=True))) for _ in range(2))
    for frame in (*first, *second):
        frame.seconds = 0.0
    assert first == second


# Bursts

def pieces_of(path, job=JOB, **options):
    """The frames of each piece of work that a recording makes."""
    left = deque(plan(path, topics=[], **options))
    pieces = []
    while left:
        part = left.popleft()
        data = process_slice(part, job)
        left.extendleft(reversed(rests(part, data)))
        pieces.append(unpack(data))
    return pieces


def small_film(stamps, topic='/camera'):
    """As many frames as stamps; the number of a frame is in the stamp of its header."""
    return [(topic, IMAGE, stamp, image(picture(number % 7), number)) for number, stamp in enumerate(stamps)]


def whole(pieces, count):
    """Whether each frame is there once, in order, and no piece is large."""
    some = [frame for piece in pieces for frame in piece]
    assert max(map(len, pieces)) <= LIMIT
    assert [frame.header_stamp for frame in some] == [stamp_of(number) - 1_000_001 for number in range(count)]
    return some


BURSTS = {
    'at once': [BEGIN] * 200,
    'nearly at once': [BEGIN + number for number in range(400)],
    'in whole seconds': [BEGIN + number // 70 * 10**9 for number in range(300)],
    'at the end of a long time': [BEGIN, *(BEGIN + 10**12 + number * 1000 for number in range(300))],
    'at the beginning of a long time': [*(BEGIN + number * 1000 for number in range(300)), BEGIN + 10**12],
    'now and then': [BEGIN + number // 150 * 10**11 + number * 1000 for number in range(600)],
    'evenly': [stamp_of(number) for number in range(300)],
}


def test_kernels_are_loaded_before_the_first_frame_of_a_type_and_parameters_is_timed(tmp_path, monkeypatch):
    calls = []
    warm_up = LineFeatureExtractor.warm_up

    def called(extractor, *types):
        calls.append((extractor.parameters, types))
        warm_up(extractor, *types)

    monkeypatch.setattr(LineFeatureExtractor, 'warm_up', called)
    deep = image((picture().astype(np.uint16) << 8), encoding='16UC1')
    path = write(tmp_path / 'rec', [*film(3), ('/camera', IMAGE, stamp_of(3), deep), *film(9)[4:]])
    [part] = plan(path, topics=[])
    first, second = (Parameters(min_length=length) for length in (12.125, 12.25))  # no other test has these
    for parameters in (first, first, second):
        frames = unpack(process_slice(part, Job(parameters, outputs=('segments',))))
        assert [frame.error for frame in frames] == 9 * ['']
    assert calls == [(parameters, (np.dtype(kind),)) for parameters in (first, second) for kind in ('uint8', 'uint16')]


@pytest.mark.parametrize('storage', ['mcap', 'sqlite3'])
@pytest.mark.parametrize('burst', BURSTS)
def test_frames_that_come_in_a_burst_are_done_piece_by_piece(tmp_path, burst, storage):
    stamps = BURSTS[burst]
    some = whole(pieces_of(write(tmp_path / 'rec', small_film(stamps), storage)), len(stamps))
    assert [frame.stamp for frame in some] == stamps


@pytest.mark.parametrize('burst', ['at once', 'now and then'])
def test_bursts_of_ros1_are_done_piece_by_piece(tmp_path, burst):
    entries = [(topic, kind, stamp, image(picture(number % 7), number, types=ROS1))
               for number, (topic, kind, stamp, _) in enumerate(small_film(BURSTS[burst]))]
    whole(pieces_of(write_ros1(tmp_path / 'rec.bag', entries)), len(entries))


def test_an_even_recording_is_read_once(tmp_path, monkeypatch):
    path = write(tmp_path / 'rec', small_film(BURSTS['evenly']))
    readings = []
    messages = Reader.messages
    monkeypatch.setattr(Reader, 'messages', lambda *arguments: readings.append(arguments) or messages(*arguments))
    pieces = pieces_of(path)
    assert len(readings) == len(pieces) == len(plan(path, topics=[]))


@pytest.mark.parametrize('every', [2, 3, 100])
@pytest.mark.parametrize('burst', BURSTS)
def test_every_takes_one_of_so_many_frames_of_a_burst(tmp_path, burst, every):
    stamps = BURSTS[burst]
    path = write(tmp_path / 'rec', [
        *small_film(stamps), *((topic, kind, stamp + 1, message) for topic, kind, stamp, message
                               in small_film(stamps, '/other'))])
    pieces = pieces_of(path, every=every)
    assert max(map(len, pieces)) <= LIMIT
    for topic, offset in (('/camera', 0), ('/other', 1)):
        mine = [frame for piece in pieces for frame in piece if frame.topic == topic]
        assert [frame.number for frame in mine] == list(range(0, len(stamps), every))
        assert [frame.stamp for frame in mine] == [stamp + offset for stamp in stamps[::every]]


@pytest.mark.parametrize('cut', [10, 64, 100, 190])
@pytest.mark.parametrize('back', [0, 5, 150])
def test_files_of_a_recording_that_overlap_in_a_burst_lose_and_double_nothing(tmp_path, cut, back):
    """The second file begins before the first has ended."""
    stamps = [BEGIN + number // 2 for number in range(200)]
    second = [BEGIN + max(0, cut - back + number) // 2 for number in range(200)]
    path = write_split(tmp_path / 'rec', [
        small_film(stamps), [(topic, kind, stamp, image(picture(), 1000 + number)) for number, (topic, kind, stamp, _)
                             in enumerate(small_film(second))]])
    pieces = pieces_of(path)
    assert max(map(len, pieces)) <= LIMIT
    done = Counter((frame.stamp, frame.header_stamp) for piece in pieces for frame in piece)
    assert done == Counter(
        [*((stamp, stamp_of(number) - 1_000_001) for number, stamp in enumerate(stamps)),
         *((stamp, stamp_of(1000 + number) - 1_000_001) for number, stamp in enumerate(second))])


@pytest.mark.parametrize('burst', ['nearly at once', 'now and then'])
def test_a_burst_is_compared_with_its_truth(tmp_path, burst):
    entries = []
    for number, entry in enumerate(small_film(BURSTS[burst])):
        entries += [entry, ('/camera/truth', CLOUD, entry[2], cloud(found(picture(number % 7))))]
    some = whole(pieces_of(write(tmp_path / 'rec', entries), TRUTH), len(BURSTS[burst]))
    assert all(frame.agreement[:2] == pytest.approx([1, 1], abs=1e-3) for frame in some)


# Truth

def cloud(segments, number=0):
    return MESSAGES.segments(segments, header(number))


CLOUD = OUTPUTS['segments']
TRUTH = dataclasses.replace(JOB, truth=True)


def with_truth(folder, truth, count=3):
    """A recording whose frames have the true segments beside them that a function of their pixels gives."""
    entries = []
    for topic, kind, stamp, message in film(count):
        number = (stamp - BEGIN) // STEP
        entries += [(topic, kind, stamp, message), (f'{topic}/truth', CLOUD, stamp, cloud(truth(picture(number))))]
    return write(folder / 'rec', entries)


def test_segments_that_are_the_truth_agree_with_it(tmp_path):
    for frame in frames_of(with_truth(tmp_path, found), TRUTH):
        precision, recall, angle, offset = frame.agreement
        assert precision == pytest.approx(1, abs=1e-3)
        assert recall == pytest.approx(1, abs=1e-3)
        assert angle == pytest.approx(0, abs=1e-3)
        assert offset == pytest.approx(0, abs=1e-3)


def test_other_segments_do_not(tmp_path):
    def elsewhere(pixels):
        segments = found(pixels)
        for name in ('x', 'x1', 'x2', 'y', 'y1', 'y2'):
            segments[name] += 300
        return segments

    for frame in frames_of(with_truth(tmp_path, elsewhere), TRUTH):
        assert frame.agreement[:2] == [0, 0]


def test_what_is_weak_is_not_asked_for(tmp_path):
    def weak(pixels):
        segments = found(pixels)
        segments['size'][1:] = 0
        return segments[:max(1, len(segments) - 1)]

    plain = [frame.agreement for frame in frames_of(with_truth(tmp_path, weak), TRUTH)]
    for precision, recall, *_ in plain:
        assert recall == pytest.approx(1, abs=1e-3)
        assert 0 < precision <= 1 + 1e-6


def test_without_the_wish_or_without_a_truth_there_is_no_agreement(tmp_path):
    path = with_truth(tmp_path, found)
    assert all(frame.agreement == [] for frame in frames_of(path))
    assert all(frame.agreement == [] for frame in frames_of(write(tmp_path / 'none', film(3)), TRUTH))


def test_the_truth_is_that_of_the_same_stamp_and_topic(tmp_path):
    entries = [*film(2, '/a'), *film(2, '/b'), ('/a/truth', CLOUD, stamp_of(0), cloud(found(picture(0)))),
               ('/b/truth', CLOUD, stamp_of(1), cloud(found(picture(1))))]
    path = write(tmp_path / 'rec', sorted(entries, key=lambda entry: entry[2]))
    some = frames_of(path, TRUTH)
    assert {(frame.topic, frame.number) for frame in some if frame.agreement} == {('/a', 0), ('/b', 1)}


def test_a_bad_truth_costs_no_more_than_the_agreement(tmp_path):
    message = cloud(found(picture()))
    message.fields = message.fields[1:]
    [frame] = frames_of(write(tmp_path / 'rec', [*film(1), ('/camera/truth', CLOUD, BEGIN, message)]), TRUTH)
    assert frame.segments == len(found(picture()))


# Text

def lines_of(data):
    """Segments from lines of text, as a reader of CSV has them."""
    rows = list(csv.reader(io.StringIO(data.decode())))
    segments = np.zeros(len(rows), SEGMENT_DTYPE)
    for segment, row in zip(segments, rows, strict=True):
        for name, value in zip(SEGMENT_DTYPE.names, row, strict=True):
            segment[name] = float(value)
    return segments


@settings(max_examples=60, deadline=None)
@given(st.lists(st.tuples(*(
    st.floats(width=32, allow_subnormal=True) if SEGMENT_DTYPE[name].kind == 'f' else st.integers(0, 2**20)
    for name in SEGMENT_DTYPE.names)), min_size=1, max_size=5))
def test_lines_of_text_give_every_number_back(rows):
    segments = np.array(rows, SEGMENT_DTYPE)
    back = lines_of(segments_as_text(segments))
    for name in SEGMENT_DTYPE.names:
        np.testing.assert_array_equal(back[name], segments[name])


def test_the_text_of_a_frame_is_that_of_its_segments(tmp_path):
    [frame] = frames_of(write(tmp_path / 'rec', film(1)), dataclasses.replace(JOB, csv=True))
    assert frame.messages[CSV] == segments_as_text(found(picture()))
    np.testing.assert_array_equal(lines_of(frame.messages[CSV]), segments_of(cloud_of(frame)))


def test_no_segments_are_no_text():
    assert segments_as_text(np.zeros(0, SEGMENT_DTYPE)) == b''


# The node

@pytest.fixture
def bench(capfd):
    pytest.importorskip('rclpy')
    bench = importlib.import_module('test_node').Bench(capfd)
    yield bench
    bench.close()


def ros_type(kind):
    """The class of a message of ROS 2 itself."""
    package, _, name = kind.split('/')
    return getattr(importlib.import_module(f'{package}.msg'), name)


def ros_message(message, kind):
    """The same message, made by ROS 2 itself from the bytes of a recording."""
    serialization = importlib.import_module('rclpy.serialization')
    return serialization.deserialize_message(bytes(ROS2.serialize_cdr(message, kind)), ros_type(kind))


def same(one, other):
    """Whether two messages say the same, whichever library made them."""
    if hasattr(one, 'get_fields_and_field_types'):
        return all(same(getattr(one, name), getattr(other, name)) for name in one.get_fields_and_field_types())
    if isinstance(one, (str, int, float, bool)):
        return one == other
    if isinstance(one, bytes):
        return one == bytes(other)
    return len(one) == len(other) and all(map(same, one, other))


def played(bench, path, topic, kind, **parameters):
    """Frames of a recording beside the segments and markers that the node makes of the same messages."""
    small = kind == COMPRESSED
    camera = bench.camera('/image/compressed' if small else '/image', ros_type(kind))
    node = bench.node(image_transport='compressed' if small else 'raw', **parameters)
    segments, markers = (bench.listen(f'/line_feature_node/{name}', ros_type(OUTPUTS[name]), depth=100)
                         for name in ('segments', 'markers'))
    with opened(path) as reader:
        connections = [connection for connection in reader.connections if connection.topic == topic]
        messages = [deserialize(path, data, kind) for connection, _, data in reader.messages(connections)]
    for message in messages:
        if hasattr(message.header, 'seq'):
            message.header = ROS2.types['std_msgs/msg/Header'](
                stamp=message.header.stamp, frame_id=message.header.frame_id)
    bench.show(camera, node, *(ros_message(message, kind) for message in messages))
    frames = frames_of(path, Job(Parameters(**parameters)), [topic])
    good = [frame for frame in frames if not frame.error]
    bench.until(lambda: len(segments) == len(markers) == len(good), 'all results')
    bench.work_off()
    assert len(segments) == len(markers) == len(good)
    return good, segments, markers


def equal_to_the_bit(good, segments, markers):
    for frame, cloud, lines in zip(good, segments, markers, strict=True):
        assert same(cloud, cloud_of(frame))
        assert segments_of(cloud).tobytes() == segments_of(cloud_of(frame)).tobytes()
        assert same(lines, ROS2.deserialize_cdr(frame.messages['markers'], OUTPUTS['markers']))


def test_the_node_makes_the_same_messages_of_the_same_recording(bench, tmp_path):
    entries = film(12)
    entries[5] = (*entries[5][:3], BAD['encoding'])
    good, *results = played(bench, write(tmp_path / 'rec', entries), '/camera', IMAGE, T1=6.0)
    assert len(good) == 11
    assert sum(frame.segments for frame in good) > 20
    equal_to_the_bit(good, *results)


@pytest.mark.parametrize(('name', 'parameters'), [
    ('spot_compressed.bag', {'intensity_max': 5000.0, 'max_sigma_theta': 10.0}),
    ('spot_raw_mcap', {'intensity_max': 5000.0, 'max_sigma_theta': 10.0}),
    ('raspicam_aruco_images_db3', {})])
def test_the_node_makes_the_same_messages_of_recordings_of_the_world(bench, name, parameters):
    [path] = find_recordings([shared('good') / name])
    with opened(path) as reader:
        topic, kind = next((connection.topic, connection.msgtype) for connection in reader.connections
                           if connection.msgtype in DECODERS)
    good, *results = played(bench, path, topic, kind, **parameters)
    assert sum(frame.segments for frame in good) > 20
    equal_to_the_bit(good, *results)


@pytest.mark.parametrize('name', ['corridor', 'road'])
def test_the_node_and_the_offline_run_give_the_same_bytes(bench, tmp_path, name):
    """From the bytes of a sample recording to those of its new bag, with nothing of ours between them and ROS."""
    source, target = SAMPLES / name, tmp_path / 'out'
    process_recording(source, target, Run(Job(Parameters(), outputs=('segments',)), end=2.0), inline(), lambda *_: None)
    camera = bench.camera('/image/compressed', ros_type(COMPRESSED))
    node = bench.node(image_transport='compressed',
                      **{'qos_overrides./image/compressed.subscription.reliability': 'reliable'})
    live = bench.listen('/line_feature_node/segments', ros_type(CLOUD), depth=100)
    frames = read_by_ros(source, COMPRESSED)[:20]
    bench.show(camera, node, *frames)
    bench.until(lambda: len(live) == len(frames), 'all segments')
    offline = read_by_ros(target, CLOUD)
    assert len(live) == len(offline) == len(frames) == 20
    for frame, one, other in zip(frames, live, offline, strict=True):
        assert one.width > 50
        assert bytes(one.data) == bytes(other.data)
        assert one.header == other.header == frame.header
        assert one == other


def read_by_ros(path, kind):
    """The messages of a type in a recording, made by ROS 2 itself of their bytes."""
    serialization = importlib.import_module('rclpy.serialization')
    with opened(path) as reader:
        connections = [connection for connection in reader.connections if connection.msgtype == kind]
        return [serialization.deserialize_message(bytes(data), ros_type(kind))
                for _, _, data in reader.messages(connections)]


def test_a_message_without_a_time_is_an_error():
    """A wrong byte in an index of sqlite3 makes None of it; there is no place to put such a frame."""
    class Index:
        def messages(self, *_):
            yield SimpleNamespace(topic='/camera'), 5, b''
            yield SimpleNamespace(topic='/camera'), None, b''

    steps = _read(Index(), [], Slice(Path('rec'), ('/camera',), 0, 10))
    assert next(steps).stamp == 5
    with pytest.raises(ValueError, match='a message has None in the place of its time'):
        next(steps)
