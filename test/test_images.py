import array
import itertools
import re
import struct
import zlib
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from line_feature_node.core import Parameters, extract
from line_feature_node.images import (
    ENCODINGS,
    compressed_image_of,
    decode,
    displayable,
    image_of,
    known_pixels,
    range_hint,
)

PICTURE = np.random.default_rng(0).integers(0, 255, (40, 51, 3), np.uint8)


@pytest.mark.parametrize('image', [PICTURE, PICTURE[..., 0], PICTURE[..., 0].astype(np.uint16) * 257])
def test_png_keeps_depth_and_channels(image):
    data = cv2.imencode('.png', image)[1].tobytes()
    np.testing.assert_array_equal(decode(data), image)


def test_jpeg_with_trailing_bytes_is_whole():
    data = cv2.imencode('.jpg', PICTURE)[1].tobytes()
    assert decode(data + b'\0' * 100).shape == PICTURE.shape


@pytest.mark.parametrize('ending', ['.jpg', '.png'])
@pytest.mark.parametrize('share', [0.02, 0.5, 0.99])
def test_truncated_is_an_error_and_not_a_grey_picture(ending, share):
    data = cv2.imencode(ending, PICTURE)[1].tobytes()
    with pytest.raises(ValueError, match=r'part of an image|not an image'):
        decode(data[:int(len(data) * share)])


@pytest.mark.parametrize('data', [b'', b'hello', bytes(1000)])
def test_what_is_no_image_is_said_to_be_none(data):
    with pytest.raises(ValueError, match=r'no data|not an image'):
        decode(data)


def test_the_end_of_a_thumbnail_is_not_the_end_of_the_picture():
    """An EXIF block holds a JPEG of its own, before the picture."""
    data = cv2.imencode('.jpg', PICTURE)[1].tobytes()
    thumbnail = b'Exif\0\0' + cv2.imencode('.jpg', PICTURE[:8, :8])[1].tobytes()
    block = b'\xff\xe1' + (len(thumbnail) + 2).to_bytes(2, 'big') + thumbnail
    whole = data[:2] + block + data[2:]
    np.testing.assert_array_equal(decode(whole), decode(data))
    with pytest.raises(ValueError, match='a part of an image'):
        decode(whole[:-100])


# Images of messages

PADDINGS, WIDTHS, HEIGHT = (0, 1, 6), (4, 7, 16), 6
LUMA = {'yuv422': 1, 'uyvy': 1, 'yuv422_yuy2': 0, 'yuyv': 0}
CHANNELS = {'rgb': 'rgb', 'bgr': 'bgr', 'rgba': 'rgba', 'bgra': 'bgra', '8UC3': 'bgr', '8UC4': 'bgra'}
PATTERNS = [name for name in ENCODINGS if name.startswith('bayer_')]


def numbers_of(encoding):
    """Type and count of the numbers of a pixel, as the names of sensor_msgs/image_encodings have them."""
    if encoding == '32FC1':
        return np.dtype('=f4'), 1
    if encoding in LUMA:
        return np.dtype('u1'), 2
    dtype = np.dtype('=u2') if '16' in encoding else np.dtype('u1')
    return dtype, len(channels_of(encoding)) or 1


def channels_of(encoding):
    return CHANNELS.get(encoding) or CHANNELS.get(encoding.rstrip('0168'), '')


def message_of(pixels, encoding, padding=0, big=False, make=bytes):
    """The fields of an Image of H×W×channels; its padding is noise, so that pixels taken from it are wrong."""
    height, width = pixels.shape[:2]
    dtype = pixels.dtype.newbyteorder('>' if big and pixels.dtype.itemsize > 1 else '=')
    rows = np.ascontiguousarray(pixels.astype(dtype)).reshape(height, -1).view(np.uint8)
    noise = np.random.default_rng(7).integers(0, 255, (height, padding), np.uint8)
    return SimpleNamespace(
        height=height, width=width, encoding=encoding, is_bigendian=int(big), step=rows.shape[1] + padding,
        data=make(np.hstack([rows, noise]).tobytes()))


def pixels_for(encoding, height, width):
    dtype, channels = numbers_of(encoding)
    rng = np.random.default_rng([height, width])
    if dtype.kind == 'f':
        return rng.normal(size=(height, width, 1)).astype(dtype)
    return rng.integers(0, np.iinfo(dtype).max, (height, width, channels), dtype, endpoint=True)


def luminance(red, green, blue):
    return 0.299 * red + 0.587 * green + 0.114 * blue


def mosaic(picture, pattern):
    """What a sensor behind a Bayer pattern sees of H×W×3 RGB, the pattern as sensor_msgs names it."""
    seen = np.empty(picture.shape[:2], picture.dtype)
    for place, colour in enumerate(pattern):
        row, column = divmod(place, 2)
        seen[row::2, column::2] = picture[row::2, column::2, 'rgb'.index(colour)]
    return seen


def demosaiced(seen, pattern):
    """Grey by bilinear interpolation of each colour; the border is wrong."""
    height, width = seen.shape
    colours = []
    for colour in 'rgb':
        known = np.zeros((height, width))
        for place, name in enumerate(pattern):
            known[place // 2::2, place % 2::2] = name == colour
        kernel = np.array([[0, 1, 0], [1, 4, 1], [0, 1, 0]] if colour == 'g' else [[1, 2, 1], [2, 4, 2], [1, 2, 1]])
        colours.append(cv2.filter2D(seen.astype(float) * known, -1, kernel / 4))
    return luminance(*colours)


def expected_grey(pixels, encoding):
    """The grey picture, and how far off roundings may be: weights have 14 bits."""
    tolerance = 4 if pixels.itemsize == 2 else 1
    if encoding in LUMA:
        return pixels[..., LUMA[encoding]], 0
    if encoding in PATTERNS:
        return demosaiced(pixels[..., 0], encoding[6:10]), tolerance
    names = channels_of(encoding)
    if not names:
        return pixels[..., 0], 0
    return luminance(*(pixels[..., names.index(name)].astype(float) for name in 'rgb')), tolerance


@pytest.mark.parametrize(('encoding', 'padding', 'width', 'big'), list(itertools.product(
    ENCODINGS, PADDINGS, WIDTHS, (False, True))))
def test_grey_picture_of_every_encoding(encoding, padding, width, big):
    pixels = pixels_for(encoding, HEIGHT, width)
    grey = image_of(message_of(pixels, encoding, padding, big))
    expected, tolerance = expected_grey(pixels, encoding)
    assert grey.shape == (HEIGHT, width)
    assert grey.dtype.newbyteorder('=') == numbers_of(encoding)[0]
    inner = slice(1, -1) if encoding in PATTERNS else slice(None)
    np.testing.assert_allclose(grey.astype(float)[inner, inner], expected[inner, inner], rtol=0, atol=tolerance)


@pytest.mark.parametrize('encoding', [
    'mono8', '8UC1', 'mono16', '16UC1', '32FC1', 'rgb8', 'bgr8', 'rgba8', 'bgra8', 'rgb16', 'bgr16', 'yuv422',
    'yuv422_yuy2', *(f'bayer_{pattern}{bits}' for pattern in ('rggb', 'bggr', 'gbrg', 'grbg') for bits in (8, 16))])
def test_encoding_that_was_promised_is_known(encoding):
    assert encoding in ENCODINGS


@pytest.mark.parametrize('encoding', ['mono8', 'bgr8', 'yuv422', 'bayer_rggb8'])
def test_is_bigendian_means_nothing_for_bytes(encoding):
    """Drivers set it at will."""
    pixels = pixels_for(encoding, HEIGHT, 8)
    np.testing.assert_array_equal(
        image_of(message_of(pixels, encoding, big=True)), image_of(message_of(pixels, encoding, big=False)))


def test_is_bigendian_matters_for_16_bits():
    message = message_of(np.full((3, 4, 1), 0x0102, np.uint16), 'mono16', big=True)
    assert np.all(image_of(message) == 0x0102)
    message.is_bigendian = 0
    assert np.all(image_of(message) == 0x0201)


@pytest.mark.parametrize(('encoding', 'level'), [('rgb8', 76), ('bgr8', 29), ('rgba8', 76), ('bgra8', 29)])
def test_red_and_blue_are_not_exchanged(encoding, level):
    """The first number is full: 0.299 of 255 where that is red, 0.114 where it is blue."""
    pixels = np.zeros((4, 5, len(channels_of(encoding))), np.uint8)
    pixels[..., 0] = 255
    assert np.all(image_of(message_of(pixels, encoding)) == level)


def test_alpha_is_left_out():
    pixels = np.zeros((4, 5, 4), np.uint8)
    pixels[..., 3] = 255
    assert not image_of(message_of(pixels, 'rgba8')).any()
    assert not image_of(message_of(pixels, 'bgra8')).any()


@pytest.mark.parametrize(('encoding', 'octets', 'levels'), [
    ('yuv422', (1, 200, 2, 100), (200, 100)), ('yuv422_yuy2', (200, 1, 100, 2), (200, 100))])
def test_brightness_of_yuv_in_both_orders(encoding, octets, levels):
    pixels = np.tile(np.array(octets, np.uint8), (3, 2)).reshape(3, 4, 2)
    assert image_of(message_of(pixels, encoding)).tolist() == [[*levels, *levels]] * 3


@pytest.mark.parametrize('encoding', PATTERNS)
def test_flat_colour_behind_a_bayer_pattern_is_as_grey_as_the_colour_itself(encoding):
    top = np.iinfo(numbers_of(encoding)[0]).max
    for colour in ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0), (0.7, 0.2, 0.5)):
        picture = np.full((8, 9, 3), np.array(colour) * top).astype(numbers_of(encoding)[0])
        grey = image_of(message_of(mosaic(picture, encoding[6:10])[..., None], encoding))
        np.testing.assert_allclose(grey, luminance(*np.array(colour) * top), atol=1.5, rtol=1e-4)


@pytest.mark.parametrize('encoding', PATTERNS)
def test_edge_behind_a_bayer_pattern_is_where_the_picture_has_it(encoding):
    top = np.iinfo(numbers_of(encoding)[0]).max
    picture = np.zeros((40, 41, 3), numbers_of(encoding)[0])
    picture[:, 20:] = top
    segments = extract(np.array(image_of(message_of(mosaic(picture, encoding[6:10])[..., None], encoding))))
    assert len(segments) == 1
    assert segments['x'][0] == pytest.approx(19.5, abs=0.6)
    assert segments['length'][0] > 30


@pytest.mark.parametrize('encoding', ['mono8', '8UC1', 'mono16', '16UC1', '32FC1', 'yuv422', 'yuv422_yuy2'])
@pytest.mark.parametrize('padding', [0, 4])
def test_no_copy_is_made_where_no_conversion_is_needed(encoding, padding):
    message = message_of(pixels_for(encoding, 4, 5), encoding, padding, make=lambda data: array.array('B', data))
    assert np.shares_memory(image_of(message), np.frombuffer(message.data, np.uint8))


def test_no_copy_is_made_of_the_data_of_a_ros_message():
    messages = pytest.importorskip('sensor_msgs.msg')
    message = messages.Image(height=3, width=4, encoding='mono16', step=10, data=array.array('B', range(30)))
    image = image_of(message)
    assert np.shares_memory(image, np.frombuffer(message.data, np.uint8))
    assert image[1, 0] == int.from_bytes(bytes([10, 11]), 'little')


@pytest.mark.parametrize('make', [
    bytes, bytearray, memoryview, lambda data: array.array('B', data), lambda data: np.frombuffer(data, np.uint8)])
def test_data_of_any_library_are_read(make):
    """That of ROS 2 gives arrays, that of bags numpy's arrays which are read-only."""
    pixels = pixels_for('mono8', 4, 5)
    np.testing.assert_array_equal(image_of(message_of(pixels, 'mono8', make=make)), pixels[..., 0])


@pytest.mark.parametrize(('changes', 'reason'), [
    ({'encoding': 'BGR8'}, "unknown encoding 'BGR8': expected one of mono8, "),
    ({'encoding': ''}, "unknown encoding ''"),
    ({'encoding': '64FC1'}, "unknown encoding '64FC1'"),
    ({'height': 0, 'data': b''}, 'an image of 5×0 pixels: expected 1×1 or more of mono8'),
    ({'width': 0}, 'an image of 0×4 pixels: expected 1×1 or more of mono8'),
    ({'width': 0, 'height': 0, 'step': 0, 'data': b''}, 'an image of 0×0 pixels'),
    ({'step': 0}, 'step is 0: expected 5 bytes or more for 5 pixels of mono8'),
    ({'step': 4}, 'step is 4: expected 5 bytes or more for 5 pixels of mono8'),
    ({'encoding': 'bgr8'}, 'step is 5: expected 15 bytes or more for 5 pixels of bgr8'),
    ({'width': 2**32 - 1}, 'step is 5: expected 4294967295 bytes or more'),
    ({'height': 2**32 - 1}, '20 bytes of data: expected 4294967295 rows of 5, 21474836475 bytes'),
    ({'step': 2**32 - 1}, '20 bytes of data: expected 4 rows of 4294967295'),
    ({'data': bytes(19)}, '19 bytes of data: expected 4 rows of 5, 20 bytes'),
    ({'data': bytes(21)}, '21 bytes of data: expected 4 rows of 5, 20 bytes'),
    ({'data': b''}, '0 bytes of data: expected 4 rows of 5, 20 bytes'),
    ({'encoding': 'bayer_rggb8', 'height': 2, 'data': bytes(10)},
     'an image of 5×2 pixels: expected 3×3 or more of bayer_rggb8'),
    ({'encoding': 'bayer_gbrg8', 'width': 2}, 'an image of 2×4 pixels: expected 3×3 or more of bayer_gbrg8'),
])
def test_fields_that_contradict_each_other_are_named(changes, reason):
    message = message_of(pixels_for('mono8', 4, 5), 'mono8')
    for name, value in changes.items():
        setattr(message, name, value)
    with pytest.raises(ValueError, match=re.escape(reason)):
        image_of(message)


NUMBERS = st.one_of(st.integers(0, 9), st.sampled_from([0, 2**31 - 1, 2**31, 2**32 - 1]), st.integers(0, 2**32 - 1))


@given(encoding=st.sampled_from([*ENCODINGS, '', 'bgr9', 'é']), height=NUMBERS, width=NUMBERS, step=NUMBERS,
       big=st.integers(0, 255), data=st.binary(max_size=500), consistent=st.booleans())
@settings(max_examples=500, deadline=None)
def test_whatever_the_fields_are_only_a_value_error_is_raised(encoding, height, width, step, big, data, consistent):
    if consistent and height * step < 2**16:
        data = bytes(height * step)
    message = SimpleNamespace(
        height=height, width=width, encoding=encoding, step=step, is_bigendian=big, data=array.array('B', data))
    reason = 'none'
    try:
        assert image_of(message).shape == (height, width)
    except ValueError as error:
        reason = str(error)
    assert reason


# Compressed images of messages

def compressed(data, form):
    return SimpleNamespace(format=form, data=array.array('B', data))


def encoded(ending, picture):
    return cv2.imencode(ending, picture)[1].tobytes()


GREY = cv2.GaussianBlur(PICTURE[..., 0], (9, 9), 3)


@pytest.mark.parametrize('form', ['jpg', 'jpeg', 'mono8; jpeg compressed ', 'rgb8; jpeg compressed bgr8', '', 'PNG?'])
def test_jpeg_is_decoded_whatever_its_format_is_called(form):
    grey = compressed_image_of(compressed(encoded('.jpg', GREY), form))
    assert (grey.dtype, grey.shape) == (np.uint8, GREY.shape)
    assert np.abs(grey.astype(int) - GREY).max() <= 8


@pytest.mark.parametrize('form', ['png', 'mono16; png compressed ', '16UC1; png compressed '])
def test_png_of_16_bits_keeps_them(form):
    depth = GREY.astype(np.uint16) * 250
    grey = compressed_image_of(compressed(encoded('.png', depth), form))
    assert grey.dtype == np.uint16
    np.testing.assert_array_equal(grey, depth)


@pytest.mark.parametrize('form', ['png', 'rgb8; png compressed bgr8'])
def test_colours_become_grey(form):
    red = np.zeros((9, 7, 3), np.uint8)
    red[..., 2] = 255
    grey = compressed_image_of(compressed(encoded('.png', red), form))
    assert grey.shape == (9, 7)
    assert np.all(np.abs(grey.astype(int) - 76) <= 1)


def test_alpha_of_a_png_is_left_out():
    picture = np.full((9, 7, 4), 255, np.uint8)
    picture[..., :3] = 0
    assert not compressed_image_of(compressed(encoded('.png', picture), 'bgra8; png compressed ')).any()


DEPTH = np.array([[0, 1, 1000], [2000, 40000, 65535]], np.uint16)


def depth_message(form, header, ending='.png', picture=DEPTH):
    return compressed(struct.pack('<iff', *header) + encoded(ending, picture), form)


@pytest.mark.parametrize('form', ['16UC1; compressedDepth', '16UC1; compressedDepth png'])
def test_depth_of_16_bits_comes_as_it_is(form):
    np.testing.assert_array_equal(compressed_image_of(depth_message(form, (0, 0.0, 0.0))), DEPTH)


@pytest.mark.parametrize('form', ['32FC1; compressedDepth', '32FC1; compressedDepth png'])
def test_depth_of_32_bits_is_the_inverse_of_what_is_kept(form):
    """As compressed_depth_image_transport writes it: A = 100 · 101, B = 1 − A / 10 for 100 at 1 m and up to 10 m."""
    a, b = 10100.0, -1009.0
    depth = compressed_image_of(depth_message(form, (0, a, b)))
    assert depth.dtype == np.float32
    assert np.isnan(depth[0, 0])
    known = DEPTH != 0
    np.testing.assert_allclose(depth[known], a / (DEPTH[known].astype(float) - b), rtol=1e-5)


def test_depth_at_infinity_is_unknown():
    depth = compressed_image_of(depth_message('32FC1; compressedDepth', (0, 100.0, 1000.0)))
    assert np.isnan(depth[0, 2])
    assert np.isfinite(depth[1]).all()


@pytest.mark.parametrize('data', [b'', bytes(12), bytes(200), bytes(12) + b'\x89PN', encoded('.jpg', GREY)])
def test_depth_without_a_png_is_not_supported(data):
    """As that of RVL compression."""
    with pytest.raises(ValueError, match=r"without a PNG in it: '32FC1; compressedDepth rvl' is not supported"):
        compressed_image_of(compressed(data, '32FC1; compressedDepth rvl'))


@pytest.mark.parametrize('share', [0.0, 0.1, 0.5, 0.9])
@pytest.mark.parametrize(('ending', 'form'), [('.jpg', 'jpeg'), ('.png', 'png'), ('.png', '16UC1; compressedDepth')])
def test_truncated_data_are_an_error(ending, form, share):
    data = (bytes(12) if 'Depth' in form else b'') + encoded(ending, PICTURE)
    with pytest.raises(ValueError, match=r'part of an image|not an image|no data|without a PNG'):
        compressed_image_of(compressed(data[:int(len(data) * share)], form))


def huge(ending):
    """A small picture whose header says that it is far larger."""
    data = bytearray(encoded(ending, GREY))
    if ending == '.png':
        data[16:24] = struct.pack('>II', 60000, 60000)
    else:
        place = data.index(b'\xff\xc0')
        data[place + 5:place + 9] = struct.pack('>HH', 60000, 60000)
    return bytes(data)


@pytest.mark.parametrize('form', ['jpeg', 'png', '16UC1; compressedDepth'])
def test_picture_beyond_all_measure_is_not_even_decoded(form, monkeypatch):
    data = huge('.jpg') if form == 'jpeg' else huge('.png')
    monkeypatch.setattr(cv2, 'imdecode', lambda *_: pytest.fail('decoded'))
    with pytest.raises(ValueError, match='an image of 60000×60000 pixels: expected 268435456 at most'):
        compressed_image_of(compressed(bytes(12) * ('Depth' in form) + data, form))


def with_bytes_before_its_size(data, more):
    place = data.index(b'\xff\xc0')
    return compressed(data[:place] + more + data[place:], 'jpeg')


@pytest.mark.parametrize('more', [b'\xff', b'\xff' * 7, b'\xff\x01', b'\xff\xd0\xff', b'\xff\0', b'\0', b'\0\xff\x01'])
def test_the_size_of_a_jpeg_is_found_behind_all_that_decoders_pass_over(more, monkeypatch):
    assert compressed_image_of(with_bytes_before_its_size(encoded('.jpg', GREY), more)).shape == GREY.shape
    monkeypatch.setattr(cv2, 'imdecode', lambda *_: pytest.fail('decoded'))
    with pytest.raises(ValueError, match='an image of 60000×60000 pixels'):
        compressed_image_of(with_bytes_before_its_size(huge('.jpg'), more))


@pytest.mark.parametrize('form', ['jpeg', 'png'])
def test_a_picture_whose_size_is_not_found_is_not_even_decoded(form, monkeypatch):
    data = encoded('.jpg', GREY).replace(b'\xff\xc0', b'\xff\xfe')
    if form == 'png':
        data = encoded('.png', GREY)
        data = data[:16] + bytes(4) + data[20:]
    monkeypatch.setattr(cv2, 'imdecode', lambda *_: pytest.fail('decoded'))
    with pytest.raises(ValueError, match=f'not an image: {len(data)} bytes of {form.upper()} without a size'):
        compressed_image_of(compressed(data, form))


@pytest.mark.parametrize('ending', ['.tiff', '.bmp', '.webp', '.pgm'])
def test_messages_with_other_pictures_are_not_even_decoded(ending, monkeypatch):
    """A TIFF of 2 MB may have 900 million pixels, which nothing says before it is decoded."""
    data = encoded(ending, GREY)
    np.testing.assert_array_equal(decode(data).shape[:2], GREY.shape)
    monkeypatch.setattr(cv2, 'imdecode', lambda *_: pytest.fail('decoded'))
    with pytest.raises(ValueError, match=f'not an image as JPEG or PNG: {len(data)} bytes that begin with b'):
        compressed_image_of(compressed(data, 'tiff'))


PICTURES = [encoded('.jpg', GREY), encoded('.png', GREY), bytes(12) + encoded('.png', DEPTH), huge('.png')]


@given(data=st.data(), form=st.sampled_from(['jpeg', '', '16UC1; compressedDepth', '32FC1; compressedDepth', 'x']))
@settings(max_examples=300, deadline=None)
def test_whatever_the_compressed_data_are_only_a_value_error_is_raised(data, form):
    octets = bytearray(data.draw(st.one_of(st.sampled_from(PICTURES), st.binary(max_size=200))))
    for _ in range(data.draw(st.integers(0, 4)) if octets else 0):
        octets[data.draw(st.integers(0, len(octets) - 1))] = data.draw(st.integers(0, 255))
    del octets[data.draw(st.integers(0, len(octets))) if data.draw(st.booleans()) else len(octets):]
    reason = 'none'
    try:
        assert compressed_image_of(compressed(bytes(octets), form)).ndim == 2
    except ValueError as error:
        reason = str(error)
    assert reason


# Unknown pixels

def test_integers_and_finite_floats_need_no_mask():
    assert known_pixels(np.zeros((3, 4), np.uint16)) is None
    assert known_pixels(np.zeros((3, 4), np.float32)) is None


@pytest.mark.parametrize('value', [np.nan, np.inf, -np.inf])
def test_pixels_that_are_not_finite_are_unknown(value):
    image = np.zeros((3, 4), np.float32)
    image[1, 2] = value
    known = known_pixels(image)
    assert known.dtype == bool
    assert np.argwhere(~known).tolist() == [[1, 2]]


@pytest.mark.parametrize('padding', [0, 1, 4])
def test_unknown_pixels_of_padded_rows_are_found(padding):
    pixels = np.zeros((4, 5, 1), np.float32)
    pixels[3, 4] = np.nan
    known = known_pixels(image_of(message_of(pixels, '32FC1', padding)))
    assert np.argwhere(~known).tolist() == [[3, 4]]


@pytest.mark.parametrize('big', [False, True])
def test_unknown_pixels_are_found_in_either_byte_order(big):
    pixels = np.ones((4, 5, 1), np.float32)
    pixels[3, 4] = np.nan
    known = known_pixels(image_of(message_of(pixels, '32FC1', big=big)))
    assert known is not None
    assert np.argwhere(~known).tolist() == [[3, 4]]


# Hints on the range

RAMP = np.linspace(0, 1, 400).reshape(20, 20)


@pytest.mark.parametrize(('bits', 'hint'), [(10, 1023), (12, 4095), (14, 16383)])
def test_hint_for_cameras_of_few_bits_names_their_largest_value(bits, hint):
    text = range_hint((RAMP * (2**bits - 1)).astype(np.uint16), Parameters())
    assert text.endswith(f'such as intensity_max {hint}')
    assert f'pixels from 0 to {2**bits - 1} are' in text
    assert f'{(2**bits - 1) / 65535:.1%}' in text


@pytest.mark.parametrize('image', [
    (RAMP * 65535).astype(np.uint16), (RAMP * 20000).astype(np.uint16), (RAMP * 255).astype(np.uint8),
    (RAMP * 255).astype(np.float32), np.full((9, 9), 100, np.uint16), np.zeros((9, 9), np.uint8),
    np.full((9, 9), np.nan, np.float32), np.zeros((0, 5), np.uint16)])
def test_no_hint_for_what_uses_its_range_or_says_nothing_of_it(image):
    assert range_hint(image, Parameters()) == ''


def test_no_hint_where_the_range_was_set():
    image = (RAMP * 1023).astype(np.uint16)
    assert range_hint(image, Parameters(intensity_max=1023.0)) == ''
    assert range_hint(image, Parameters(intensity_max=65535.0)) != ''


def test_hint_for_floats_from_0_to_1():
    text = range_hint(RAMP.astype(np.float32), Parameters())
    assert text.startswith('pixels from 0 to 1 are 0.4% of the range: intensity_min and intensity_max')
    assert 'such as' not in text


def test_hint_leaves_unknown_pixels_out():
    image = RAMP.astype(np.float32)
    image[0, 0], image[1, 1] = np.nan, np.inf
    assert 'to 1 are' in range_hint(image, Parameters())


def test_hint_is_the_same_in_either_byte_order():
    pixels = (RAMP * 16383).astype(np.uint16)[..., None]
    hints = [range_hint(image_of(message_of(pixels, 'mono16', big=big)), Parameters()) for big in (False, True)]
    assert hints[0] == hints[1] != ''


# Pictures for people

def test_bytes_are_shown_as_they_are():
    image = GREY.copy()
    assert displayable(image, Parameters()) is image


def test_range_of_intensities_is_brought_to_bytes():
    image = np.array([[500, 1000, 2000, 3000, 4000]], np.uint16)
    shown = displayable(image, Parameters(intensity_min=1000.0, intensity_max=3000.0))
    assert shown.tolist() == [[0, 0, 127, 255, 255]]
    assert displayable(np.array([[0, 32768, 65535]], np.uint16), Parameters()).tolist() == [[0, 127, 255]]
    assert displayable(np.array([[0, 1, 255]], np.uint8), Parameters(intensity_max=1.0)).tolist() == [[0, 255, 255]]


def test_what_is_not_finite_is_shown_black():
    image = np.array([[np.nan, np.inf, -np.inf, 0.5, 7]], np.float32)
    shown = displayable(image, Parameters(intensity_max=1.0))
    assert shown.dtype == np.uint8
    assert shown.tolist() == [[0, 0, 0, 127, 255]]
    assert np.isinf(image[0, 1])


def test_big_endian_pixels_are_shown_as_they_are_meant():
    pixels = (RAMP * 65535).astype(np.uint16)[..., None]
    np.testing.assert_array_equal(
        displayable(image_of(message_of(pixels, 'mono16', big=True)), Parameters()),
        displayable(image_of(message_of(pixels, 'mono16', big=False)), Parameters()))


# Headers that claim what is not there

def with_filling(data, filling):
    """With something between the first block and the second."""
    place = 4 + int.from_bytes(data[4:6], 'big')
    return data[:place] + filling + data[place:]


@pytest.mark.parametrize('filling', [b'', b'\xff', b'\xff\xff\xff', b'\0', b'abc', b'\xff\0'])
def test_the_size_of_a_jpeg_is_found_behind_filling(filling):
    """Decoders skip it, so what a header behind it claims counts."""
    data = bytearray(cv2.imencode('.jpg', PICTURE)[1].tobytes())
    np.testing.assert_array_equal(decode(with_filling(bytes(data), filling)), decode(bytes(data)))
    place = data.index(b'\xff\xc0') + 5
    data[place:place + 4] = struct.pack('>HH', 30_000, 30_000)
    with pytest.raises(ValueError, match='an image of 30000×30000 pixels: expected'):
        decode(with_filling(bytes(data), filling))


@pytest.mark.parametrize('length', [2**28, 2**31 - 13, 2**31, 2**32 - 1])
@pytest.mark.parametrize('place', [33, 8])
def test_a_png_whose_chunk_claims_more_than_there_is_is_a_part(length, place):
    """OpenCV would have, and fill, memory of that size for it."""
    data = cv2.imencode('.png', PICTURE)[1].tobytes()
    data = data[:place] + struct.pack('>I', length) + data[place + 4:]
    with pytest.raises(ValueError, match='a part of an image'):
        decode(data)


def test_what_is_not_finite_is_shown_without_a_warning():
    signalling = np.array([[0x7f800001, 0x7f7fffff, 0xff800000]], np.uint32).view(np.float32)
    shown = displayable(signalling, Parameters(intensity_min=0.0, intensity_max=1e-3))
    np.testing.assert_array_equal(shown, [[0, 0, 0]])


def with_jpeg_size(data: bytes, width: int, height: int) -> bytes:
    """A JPEG whose header says another size."""
    frame = re.search(rb'\xff[\xc0\xc2]\x00\x11\x08', data).start()
    return data[:frame + 5] + struct.pack('>HH', height, width) + data[frame + 9:]


@pytest.mark.parametrize('progressive', [0, 1])
def test_a_small_jpeg_that_claims_many_pixels_is_refused(progressive):
    """Half a gigabyte would be made room for, and filled with grey."""
    small = cv2.imencode('.jpg', np.full((64, 64, 3), 90, np.uint8), [cv2.IMWRITE_JPEG_PROGRESSIVE, progressive])[1]
    data = with_jpeg_size(small.tobytes(), 16000, 12000)
    with pytest.raises(ValueError, match=f'of 16000×12000 pixels in {len(data)} bytes, which hold {512 * len(data)}'):
        decode(data)


def test_a_small_png_that_claims_many_pixels_is_refused():
    small = cv2.imencode('.png', np.zeros((64, 64), np.uint16))[1].tobytes()
    header = struct.pack('>II', 16000, 12000) + small[24:29]
    data = small[:16] + header + struct.pack('>I', zlib.crc32(b'IHDR' + header)) + small[33:]
    with pytest.raises(ValueError, match=f'an image of 16000×12000 pixels in {len(data)} bytes, which hold'):
        decode(data)


@pytest.mark.parametrize('shape', [(3000, 4000), (3000, 4000, 3), (4001, 17)])
@pytest.mark.parametrize('level', [0, 255])
@pytest.mark.parametrize(('ending', 'options'), [
    ('.jpg', []), ('.png', [cv2.IMWRITE_PNG_COMPRESSION, 9]), ('.png', [cv2.IMWRITE_PNG_BILEVEL, 1]),
    ('.jpg', [cv2.IMWRITE_JPEG_PROGRESSIVE, 1, cv2.IMWRITE_JPEG_OPTIMIZE, 1, cv2.IMWRITE_JPEG_QUALITY, 1]),
])
def test_pictures_of_one_grey_are_as_small_as_they_get(shape, level, ending, options):
    """A camera with its cap on: none is taken for one that claims too much."""
    image = np.full(shape, level, np.uint8)
    image[-1, -1] = 255 - level
    if cv2.IMWRITE_PNG_BILEVEL in options:
        image = np.ascontiguousarray(image.reshape(*shape[:2], -1)[..., 0])
    np.testing.assert_allclose(decode(cv2.imencode(ending, image, options)[1].tobytes()).shape[:2], shape[:2])
