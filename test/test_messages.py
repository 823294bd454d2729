import array
import importlib
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from line_feature_node.core import SEGMENT_DTYPE, extract
from line_feature_node.core.features import UNREFINED
from line_feature_node.messages import Messages, little_endian, point_fields, segments_of
from line_feature_node.overlay import COLOURS

#: Of sensor_msgs/PointField.
SIZES = {1: 1, 2: 1, 3: 2, 4: 2, 5: 4, 6: 4, 7: 4, 8: 8}


def fake(name):
    """A class of messages that takes everything, as that of a library other than ROS 2 itself."""
    return lambda **fields: SimpleNamespace(kind=name, **fields)


def ros(name):
    package, _, message = name.split('/')
    return getattr(importlib.import_module(f'{package}.msg'), message)


def octets(data):
    return array.array('B', np.ascontiguousarray(data).tobytes())


LIBRARIES = {
    'ros': lambda: Messages(ros, octets),
    'bytes': lambda: Messages(fake, lambda data: np.ascontiguousarray(data).tobytes()),
    'ndarray': lambda: Messages(fake, lambda data: np.frombuffer(np.ascontiguousarray(data).tobytes(), np.uint8)),
}


@pytest.fixture(params=LIBRARIES)
def messages(request):
    if request.param == 'ros':
        pytest.importorskip('sensor_msgs.msg')
        pytest.importorskip('visualization_msgs.msg')
    return LIBRARIES[request.param]()


@pytest.fixture
def header(messages):
    return messages.types('std_msgs/msg/Header')(
        stamp=messages.types('builtin_interfaces/msg/Time')(sec=12, nanosec=34), frame_id='camera')


def some_segments(count=50):
    """Segments of all values, some vertical, whose intercept is NaN."""
    rng = np.random.default_rng(count)
    segments = np.zeros(count, SEGMENT_DTYPE)
    for name in SEGMENT_DTYPE.names:
        segments[name] = rng.uniform(-700, 700, count) if SEGMENT_DTYPE[name].kind == 'f' else rng.integers(1, 5, count)
    segments['z'] = 0
    segments['intercept'][::3] = np.nan
    return segments


def cloud(segments, order='<', extra=(), names=SEGMENT_DTYPE.names, padding=0, rows=1):
    """A PointCloud2 by another writer: fields in the order of `names`, behind those of `extra`, rows with padding."""
    formats = [(name, np.dtype(f'{order}{kind}')) for name, kind in extra]
    formats += [(name, SEGMENT_DTYPE[name].newbyteorder(order)) for name in names]
    layout = np.dtype(formats)
    points = np.zeros(len(segments), layout)
    for name in names:
        points[name] = segments[name]
    for name, _ in extra:
        points[name] = 77
    width = len(segments) // rows
    data = b''.join(row.tobytes() + b'\xee' * padding for row in points.reshape(rows, width))
    kinds = {'f4': 7, 'u4': 6, 'i4': 5, 'f8': 8, 'u2': 4, 'u1': 2}
    return SimpleNamespace(
        height=rows, width=width, is_bigendian=order == '>', point_step=layout.itemsize,
        row_step=layout.itemsize * width + padding, data=data, is_dense=True,
        fields=[SimpleNamespace(name=name, offset=layout.fields[name][1], count=1, datatype=kinds[kind.str[1:]])
                for name, kind in formats])


# Segments to a message

def test_fields_of_the_message_are_those_of_the_records(messages, header):
    message = messages.segments(some_segments(), header)
    assert [field.name for field in message.fields] == list(SEGMENT_DTYPE.names)
    for field in message.fields:
        kind, offset = SEGMENT_DTYPE.fields[field.name]
        assert (field.offset, field.count) == (offset, 1)
        assert field.datatype == {np.dtype('f4'): 7, np.dtype('u4'): 6, np.dtype('i4'): 5}[kind]


def test_every_field_has_four_bytes_and_none_is_between_them():
    """Viewers draw fields of four bytes only."""
    assert [offset for _, offset, _ in point_fields()] == list(range(0, SEGMENT_DTYPE.itemsize, 4))
    assert {SIZES[kind] for *_, kind in point_fields()} == {4}


def test_mid_point_comes_first_so_that_viewers_find_it():
    assert [name for name, *_ in point_fields()][:3] == ['x', 'y', 'z']


@pytest.mark.parametrize('count', [0, 1, 50])
def test_sizes_of_the_message_agree(messages, header, count):
    message = messages.segments(some_segments(count), header)
    assert (message.height, message.width) == (1, count)
    assert message.point_step == SEGMENT_DTYPE.itemsize
    assert message.row_step == SEGMENT_DTYPE.itemsize * count == len(message.data)
    assert not message.is_bigendian


def test_all_points_are_finite_and_said_to_be():
    """What may be NaN is the intercept alone, which is none of x, y and z."""
    messages = LIBRARIES['bytes']()
    message = messages.segments(some_segments(), None)
    assert message.is_dense is True


def test_numbers_of_the_message_are_little_endian(messages, header):
    segments = np.zeros(1, SEGMENT_DTYPE)
    segments['x'], segments['code'] = 1.0, 0x01020304
    data = bytes(messages.segments(segments, header).data)
    assert data[:4] == b'\0\0\x80\x3f'
    place = SEGMENT_DTYPE.fields['code'][1]
    assert data[place:place + 4] == b'\4\3\2\1'
    big = segments.astype(SEGMENT_DTYPE.newbyteorder('>'))
    assert little_endian(big).tobytes() == data


def test_header_is_kept_whole(messages, header):
    picture = np.zeros((2, 3), np.uint8)
    for message in (messages.segments(some_segments(), header), messages.markers(some_segments(), header),
                    messages.image(picture, header), messages.compressed_image(picture.reshape(-1), header)):
        assert (message.header.stamp.sec, message.header.stamp.nanosec) == (12, 34)
        assert message.header.frame_id == 'camera'


# And back

@pytest.mark.parametrize('count', [0, 1, 50])
def test_segments_come_back_byte_for_byte(messages, header, count):
    segments = some_segments(count)
    found = segments_of(messages.segments(segments, header))
    assert found.dtype == SEGMENT_DTYPE
    assert found.shape == (count,)
    assert found.tobytes() == segments.tobytes()


def test_segments_that_are_not_in_one_piece_come_back(messages, header):
    segments = some_segments()[::-3]
    assert segments_of(messages.segments(segments, header)).tobytes() == segments.tobytes()


def test_segments_of_a_picture_come_back(messages, header):
    """With a vertical line, whose intercept is NaN."""
    picture = np.zeros((60, 80), np.uint8)
    picture[20:40, 30:50] = 200
    segments = extract(picture)
    assert np.isnan(segments['intercept']).any()
    assert segments_of(messages.segments(segments, header)).tobytes() == segments.tobytes()


def test_what_comes_back_may_be_written_to_and_leaves_the_message_as_it_was(messages, header):
    message = messages.segments(some_segments(), header)
    before = bytes(message.data)
    segments_of(message)['x'] = -1
    assert bytes(message.data) == before


def test_big_endian_message_is_read():
    segments = some_segments()
    found = segments_of(cloud(segments, '>'))
    assert found.tobytes() == segments.tobytes()


def test_fields_in_another_order_are_read():
    segments = some_segments()
    assert segments_of(cloud(segments, names=SEGMENT_DTYPE.names[::-1])).tobytes() == segments.tobytes()


def test_fields_that_a_later_version_has_besides_are_left_out():
    segments = some_segments()
    message = cloud(segments, extra=[('residual', 'f4'), ('id', 'f8'), ('flag', 'u1')])
    assert message.fields[3].offset == 13
    assert segments_of(message).tobytes() == segments.tobytes()


def test_rows_with_padding_are_read():
    segments = some_segments(12)
    assert segments_of(cloud(segments, padding=5, rows=3)).tobytes() == segments.tobytes()


@pytest.mark.parametrize(('height', 'width'), [(0, 0), (0, 5), (1, 0), (4, 0)])
def test_message_without_points_gives_no_segments(height, width):
    message = cloud(some_segments(0))
    message.height, message.width, message.data = height, width, b''
    message.row_step = message.point_step * width if height == 0 else 0
    assert segments_of(message).shape == (0,)


@pytest.mark.parametrize('missing', [['sigma_theta'], ['polarity', 'log_nfa'], list(UNREFINED)])
def test_fields_of_refinement_may_be_missing(missing):
    segments = some_segments()
    found = segments_of(cloud(segments, names=[name for name in SEGMENT_DTYPE.names if name not in missing]))
    for name in SEGMENT_DTYPE.names:
        np.testing.assert_array_equal(found[name], UNREFINED[name] if name in missing else segments[name], err_msg=name)


@pytest.mark.parametrize('name', [name for name in SEGMENT_DTYPE.names if name not in UNREFINED])
def test_missing_field_is_named(name):
    message = cloud(some_segments(), names=[other for other in SEGMENT_DTYPE.names if other != name])
    with pytest.raises(ValueError, match=f"the message has no field '{name}': it has "):
        segments_of(message)


def test_message_without_any_field_says_so():
    message = cloud(some_segments())
    message.fields = []
    with pytest.raises(ValueError, match=r"the message has no field 'x': it has none$"):
        segments_of(message)


@pytest.mark.parametrize(('name', 'wrong', 'reason'), [
    ('x', {'datatype': 8}, "field 'x' has datatype 8, count 1 and offset 0 of 72 bytes: expected datatype 7 and"),
    ('code', {'datatype': 5}, "field 'code' has datatype 5, .* expected datatype 6 and count 1"),
    ('theta', {'count': 2}, "field 'theta' has datatype 7, count 2"),
    ('theta', {'count': 0}, "field 'theta' has datatype 7, count 0"),
    ('size', {'offset': 69}, "field 'size' has .* offset 69 of 72 bytes"),
    ('y', {'offset': 2**32 - 1}, "field 'y' has .* offset 4294967295 of 72 bytes"),
])
def test_field_of_another_kind_is_named(name, wrong, reason):
    message = cloud(some_segments())
    field = next(field for field in message.fields if field.name == name)
    vars(field).update(wrong)
    with pytest.raises(ValueError, match=reason):
        segments_of(message)


@pytest.mark.parametrize(('wrong', 'reason'), [
    ({'width': 51}, '3600 bytes of data: expected 1 rows of 3600, with 51 points of 72 bytes each'),
    ({'width': 2**32 - 1}, '3600 bytes of data: expected 1 rows of 3600, with 4294967295 points'),
    ({'height': 2}, '3600 bytes of data: expected 2 rows of 3600'),
    ({'height': 0}, '3600 bytes of data: expected 0 rows of 3600'),
    ({'height': 2**32 - 1}, '3600 bytes of data: expected 4294967295 rows'),
    ({'row_step': 0}, '3600 bytes of data: expected 1 rows of 0'),
    ({'point_step': 73}, '3600 bytes of data: expected 1 rows of 3600, with 50 points of 73 bytes each'),
    ({'data': bytes(3599)}, '3599 bytes of data: expected 1 rows of 3600'),
    ({'data': bytes(3672)}, '3672 bytes of data'),
    ({'data': b''}, '0 bytes of data'),
    ({'point_step': 0}, 'offset 0 of 0 bytes'),
])
def test_sizes_that_disagree_are_named(wrong, reason):
    message = cloud(some_segments())
    vars(message).update(wrong)
    with pytest.raises(ValueError, match=reason):
        segments_of(message)


NUMBERS = st.one_of(st.integers(0, 80), st.sampled_from([72, 144, 2**31 - 1, 2**31, 2**32 - 1]))


@given(changes=st.dictionaries(st.sampled_from(['height', 'width', 'point_step', 'row_step']), NUMBERS),
       field=st.sampled_from(SEGMENT_DTYPE.names), wrong=st.dictionaries(
           st.sampled_from(['offset', 'count', 'datatype']), NUMBERS), length=st.integers(0, 144))
@settings(max_examples=500, deadline=None)
def test_whatever_the_fields_are_only_a_value_error_is_raised(changes, field, wrong, length):
    message = cloud(some_segments(2))
    vars(message).update(changes, data=message.data[:length])
    vars(message.fields[SEGMENT_DTYPE.names.index(field)]).update(wrong)
    reason = 'none'
    try:
        assert len(segments_of(message)) == message.height * message.width
    except ValueError as error:
        reason = str(error)
    assert reason


# Markers

def test_each_segment_is_a_line_between_its_end_points(messages, header):
    segments = some_segments()
    message = messages.markers(segments, header)
    assert len(message.points) == 2 * len(segments)
    for k, segment in enumerate(segments):
        first, second = message.points[2 * k:2 * k + 2]
        assert (first.x, first.y, first.z) == (segment['x1'], segment['y1'], 0)
        assert (second.x, second.y, second.z) == (segment['x2'], segment['y2'], 0)


def test_constants_are_those_of_the_message():
    pytest.importorskip('visualization_msgs.msg')
    message = LIBRARIES['ros']().markers(some_segments(), ros('std_msgs/msg/Header')())
    kind = ros('visualization_msgs/msg/ImageMarker')
    assert (message.type, message.action) == (kind.LINE_LIST, kind.ADD)
    assert message.scale > 0


def test_each_line_has_the_colour_of_its_code(messages, header):
    """One colour a line, red first; those of the overlay are blue first."""
    segments = some_segments()
    message = messages.markers(segments, header)
    assert len(message.outline_colors) == len(segments)
    for colour, code in zip(message.outline_colors, segments['code'], strict=True):
        blue, green, red = COLOURS[code]
        assert (colour.r, colour.g, colour.b, colour.a) == pytest.approx((red / 255, green / 255, blue / 255, 1.0))


def test_markers_of_no_segments_are_empty_and_replace_those_before(messages, header):
    message = messages.markers(some_segments(0), header)
    assert len(message.points) == len(message.outline_colors) == 0
    some = messages.markers(some_segments(), header)
    assert (message.ns, message.id, message.action) == (some.ns, some.id, 0)


def test_markers_stay_until_they_are_replaced(messages, header):
    lifetime = messages.markers(some_segments(), header).lifetime
    assert (lifetime.sec, lifetime.nanosec) == (0, 0)


# Pictures

@pytest.mark.parametrize(('shape', 'encoding', 'step'), [((4, 5), 'mono8', 5), ((4, 5, 3), 'bgr8', 15)])
def test_picture_as_an_image(messages, header, shape, encoding, step):
    picture = np.arange(np.prod(shape), dtype=np.uint8).reshape(shape)
    message = messages.image(picture, header)
    assert (message.height, message.width, message.encoding, message.step) == (4, 5, encoding, step)
    assert bytes(message.data) == picture.tobytes()
    assert message.is_bigendian == 0


def test_picture_that_is_not_in_one_piece_as_an_image(messages, header):
    picture = np.arange(200, dtype=np.uint8).reshape(10, 20)[::2, ::2]
    message = messages.image(picture, header)
    assert (message.height, message.width, message.step) == (5, 10, 10)
    assert bytes(message.data) == picture.tobytes()


def test_compressed_picture_says_that_it_is_jpeg(messages, header):
    message = messages.compressed_image(np.array([1, 2, 3], np.uint8), header)
    assert bytes(message.data) == b'\1\2\3'
    assert 'jpeg' in message.format
