"""Inputs of the image decoders, of the extractor and of what reads segments, and what must come of them."""

import array
import contextlib
import ctypes
import dataclasses
import math
import mmap
import struct
import zlib
from random import Random
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
from mutations import edge, mutated

from line_feature_node.core import PROFILES, SEGMENT_DTYPE, LineFeatureExtractor, Parameters, pipeline
from line_feature_node.core.pipeline import PIXEL_TYPES
from line_feature_node.images import (
    ENCODINGS,
    JPEG,
    PNG,
    compressed_image_of,
    decode,
    displayable,
    image_of,
    range_hint,
    usable_pixels,
)
from line_feature_node.messages import point_fields, segments_of

#: Buffers of bytes as the libraries have them in a message.
BUFFERS = (bytes, bytearray, memoryview, lambda data: array.array('B', data),
           lambda data: np.frombuffer(data, np.uint8))
#: Numbers that floats go wrong with.
ODD = (math.nan, math.inf, -math.inf, 0.0, -0.0, 5e-324, 1e-45, 1e-38, 3.4e38, -3.4e38, 1e308, 255.0, 2.0**24)
WORKING = LineFeatureExtractor()
#: Small pictures are shared among threads, too: large ones would take too long.
pipeline.LEAST_SHARED = 0
#: How many threads; each other number makes as many anew.
THREADS = (1, 1, 1, 2, 2, 3, 7)

Input = dict[str, Any]


# Images of messages

def image_message(draw: Random) -> Input:
    """The fields of a sensor_msgs/Image; most are nearly right, or little but the first check would be reached."""
    encoding = draw.choice([*ENCODINGS])
    known = ENCODINGS[encoding]
    height, width = draw.randint(0, 20), draw.randint(0, 20)
    row = width * known.channels * np.dtype(known.dtype).itemsize
    step = row + draw.choice((0, 0, 0, 1, 2, 3, 17, -1))
    size = max(0, height * step)
    if draw.random() < 0.2:
        size = max(0, size + draw.choice((-1, 1, -step, step, 1000)))
    fields: Input = {'height': height, 'width': width, 'step': max(0, step), 'encoding': encoding,
                     'is_bigendian': draw.choice((0, 1, 1, 2, 255))}
    if draw.random() < 0.3:
        fields[draw.choice(('height', 'width', 'step'))] = edge(draw)
    if draw.random() < 0.05:
        fields['encoding'] = draw.choice(('', 'rgb', '32FC2', '64FC1', 'mono8 ', 'x' * 300, 'MONO8', '\0', 'ü\n'))
    data = draw.randbytes(size)
    if encoding == '32FC1' and size >= 4 and draw.random() < 0.5:
        data = (struct.pack('<f', np.float32(draw.choice(ODD[:10]))) + data)[:size]
    return {**fields, 'buffer': draw.randrange(len(BUFFERS)), 'further': draw.random() < 0.1, 'data': data}


def check_image(fields: Input) -> int:
    """What becomes of an image message; the bytes of the picture are returned."""
    message = SimpleNamespace(**{**fields, 'data': BUFFERS[fields['buffer']](fields['data'])})
    picture = image_of(message)
    assert picture.shape == (fields['height'], fields['width'])
    return _check_picture(picture, further=fields['further'])


def _check_picture(picture: Any, *, further: bool) -> int:
    assert picture.dtype.newbyteorder('=') in PIXEL_TYPES
    assert picture.ndim == 2
    assert picture.size
    if further and picture.size < 10_000:
        usable = usable_pixels(picture, None)
        assert usable is None or usable.shape == picture.shape
        assert '\n' not in range_hint(picture, Parameters())
        assert displayable(picture, Parameters()).dtype == np.uint8
    return int(picture.nbytes)


# Compressed images

def _chunk(name: bytes, content: bytes) -> bytes:
    return struct.pack('>I', len(content)) + name + content + struct.pack('>I', zlib.crc32(name + content))


def _seeds() -> list[bytes]:
    """Good pictures in every format that OpenCV writes, and some that are put together here."""
    rng = np.random.default_rng(0)
    grey = rng.integers(0, 256, (12, 17), np.uint8)
    colour = rng.integers(0, 256, (9, 14, 3), np.uint8)
    deep = rng.integers(0, 2**16, (11, 8), np.uint16)
    jpeg = {'progressive': cv2.IMWRITE_JPEG_PROGRESSIVE, 'restart': cv2.IMWRITE_JPEG_RST_INTERVAL}
    found = [cv2.imencode('.jpg', picture, [option, 1])[1].tobytes()
             for picture in (grey, colour) for option in jpeg.values()]
    found += [cv2.imencode('.png', picture)[1].tobytes() for picture in (grey, colour, deep)]
    oriented = b'Exif\0\0MM\0*\0\0\0\x08\0\x01\x01\x12\0\x03\0\0\0\x01\0\x06\0\0\0\0\0\0'
    found.append(found[0][:2] + b'\xff\xe1' + struct.pack('>H', len(oriented) + 2) + oriented + found[0][2:])
    header = _chunk(b'IHDR', struct.pack('>IIBBBBB', 4, 4, 1, 3, 0, 0, 0))
    found.append(PNG + b'\r\n\x1a\n' + header + _chunk(b'PLTE', bytes(range(6)))
                 + _chunk(b'IDAT', zlib.compress(b'\0\xa0' * 4)) + _chunk(b'IEND', b''))
    square = rng.integers(0, 256, (40, 40), np.uint8)
    for ending, picture in (('.webp', colour), ('.tiff', deep), ('.bmp', grey), ('.pgm', grey), ('.ppm', colour),
                            ('.jp2', square), ('.hdr', colour), ('.ras', grey), ('.pam', grey), ('.avif', colour)):
        with contextlib.suppress(cv2.error):  # this OpenCV was built without the format
            written, data = cv2.imencode(ending, picture)
            found += [data.tobytes()] if written else []
    return found


SEEDS = _seeds()
#: JPEG and PNG, which cameras send.
COMMON = [data for data in SEEDS if data.startswith((JPEG, PNG))]
FORMATS = ('jpeg', 'png', '', 'bgr8; jpeg compressed bgr8', 'compressedDepth', '16UC1; compressedDepth png',
           '32FC1; compressedDepth', '32FC1; compressedDepth rvl', 'tiff', '\0' * 9)


def compressed_message(draw: Random) -> Input:
    """The fields of a sensor_msgs/CompressedImage."""
    form = draw.choice(FORMATS)
    data = draw.choice(COMMON if draw.random() < 0.7 else SEEDS)
    if draw.random() < 0.05:
        data = draw.choice((b'', JPEG, PNG, b'BM', b'II*\0', b'RIFF', b'P5')) + draw.randbytes(draw.randint(0, 200))
    elif draw.random() < 0.1:
        data = _with_size(data, draw)
    elif draw.random() < 0.97:
        data = mutated(data, draw)
    if 'compressedDepth' in form and draw.random() < 0.9:
        numbers = (np.float32(np.clip(draw.choice(ODD), -3.4e38, 3.4e38)) for _ in range(2))
        data = struct.pack('<iff', draw.choice((0, 1, -1)), *numbers) + data
    return {'format': form, 'buffer': draw.randrange(len(BUFFERS)), 'grey': draw.random() < 0.8, 'data': data}


def _with_size(data: bytes, draw: Random) -> bytes:
    """A JPEG or PNG, otherwise whole, that claims another size; few are so large that they take seconds."""
    sizes = [draw.choice((1, 5, 400, 3000)), draw.choice((1, 7, 500, 4000))]
    if draw.random() < 0.02:
        sizes = [draw.choice((20_000, 30_000, 65_500, 2**31 - 1)) for _ in sizes]
    if data.startswith(PNG):
        head = data[12:16] + struct.pack('>II', *sizes) + data[24:29]
        return data[:12] + head + struct.pack('>I', zlib.crc32(head)) + data[33:]
    place = next((place for place in range(len(data) - 9) if data[place:place + 2] in (b'\xff\xc0', b'\xff\xc2')), None)
    if place is None or not data.startswith(JPEG):
        return mutated(data, draw)
    filling = draw.choice((b'', b'', b'\xff', b'\xff\xff\xff', b'\0', b'abc'))
    return (data[:2] + filling + data[2:place + 5] + struct.pack('>HH', *(min(size, 65_500) for size in sizes))
            + data[place + 9:])


def check_compressed(fields: Input) -> int:
    """What becomes of a compressed image, as a message or as a file; the bytes of the picture are returned."""
    if fields['grey']:
        data = BUFFERS[fields['buffer']](fields['data'])
        return _check_picture(compressed_image_of(SimpleNamespace(format=fields['format'], data=data)), further=True)
    picture = decode(fields['data'])
    assert picture.ndim in (2, 3)
    return int(picture.nbytes)


# Segments of messages

def segments_message(draw: Random) -> Input:
    """The fields of a sensor_msgs/PointCloud2."""
    fields = [[name, offset, kind, 1] for name, offset, kind in point_fields()]
    step = SEGMENT_DTYPE.itemsize + draw.choice((0, 0, 0, 1, 4, 60))
    width, height = draw.randint(0, 6), draw.choice((0, 1, 1, 1, 2, 3))
    row = step * width + draw.choice((0, 0, 0, 3, -1))
    for _ in range(draw.choice((0, 0, 0, 1, 1, 2, 5))):
        field = draw.choice(fields)
        place = draw.randrange(5)
        if place == 4:
            fields.remove(field) if draw.random() < 0.5 else fields.insert(draw.randrange(9), list(field))
        else:
            field[place] = (draw.choice(('', 'x', 'y', 'rgb', 'ü')), edge(draw), draw.randrange(10), edge(draw))[place]
    size = max(0, row * height)
    if draw.random() < 0.1:
        size = draw.choice((0, 1, size + 1, size + step))
    message: Input = {'height': height, 'width': width, 'point_step': step, 'row_step': max(0, row)}
    if draw.random() < 0.3:
        message[draw.choice([*message])] = edge(draw)
    return {**message, 'is_bigendian': draw.random() < 0.3, 'fields': [tuple(field) for field in fields],
            'buffer': draw.randrange(len(BUFFERS)), 'data': draw.randbytes(size)}


def check_segments(fields: Input) -> int:
    """What becomes of a message with segments; their bytes are returned."""
    message = SimpleNamespace(**{
        **fields, 'data': BUFFERS[fields['buffer']](fields['data']),
        'fields': [SimpleNamespace(name=name, offset=offset, datatype=kind, count=count)
                   for name, offset, kind, count in fields['fields']]})
    segments = segments_of(message)
    assert segments.dtype == SEGMENT_DTYPE
    assert segments.shape == (fields['height'] * fields['width'],)
    return int(segments.nbytes)


# The extractor

TYPES = ('u1', 'u1', 'u1', 'u2', 'u2', 'f4', 'f4', 'f4', '>u2', '>f4')
WRONG_TYPES = ('f8', 'i1', 'i2', 'i4', '?', 'f2', 'c8', 'S3', 'O', 'M8[s]')


def extractor_input(draw: Random) -> Input:
    """An image, its mask and parameters."""
    with np.errstate(all='ignore'):  # numbers that a type cannot have are wanted
        image = _image(draw)
    return {'image': image, 'mask': _mask(draw, image), 'profile': draw.choice([*PROFILES, 'default', 'default']),
            'parameters': parameters(draw), 'fresh': draw.random() < 0.05}


def _image(draw: Random) -> Any:
    if draw.random() < 0.005:
        return draw.choice((None, 5, 'image', b'\0' * 9, [[1, 2], [3, 4]], np.float32(3)))
    dtype = np.dtype(draw.choice(TYPES if draw.random() < 0.98 else WRONG_TYPES))
    shape = [draw.choice((1, 2, 3, 5, 8, 16, 31, 33, 40, 64, 65)) + draw.randint(0, 3) for _ in range(2)]
    shape += draw.choice(((),) * 6 + ((1,), (3,), (3,), (4,)))
    if draw.random() < 0.02:
        shape = draw.choice(([], [5], [0, 5], [5, 0], [0, 0], [9, 9, 2], [9, 9, 5], [9, 9, 0], [2, 2, 2, 2]))
    image = _content(draw, shape).astype(dtype) if dtype.kind not in 'SOM' else np.zeros(shape, dtype)
    if dtype.kind == 'f' and image.size and draw.random() < 0.3:
        places = image.reshape(-1)
        for _ in range(draw.choice((1, 2, 20))):
            places[draw.randrange(places.size)] = np.array(draw.choice(ODD)).astype(dtype)
    return _laid_out(draw, image)


def _content(draw: Random, shape: list[int]) -> Any:
    """Noise, lines, bars, ramps and their like, in the range of bytes or far from it."""
    rng = np.random.default_rng(draw.getrandbits(32))
    kind = draw.randrange(7)
    pixels = np.zeros(shape)
    rows, columns = np.indices(shape)[:2] if len(shape) > 1 else (pixels, pixels)
    if kind == 0:
        pixels = rng.integers(0, 256, shape).astype(float)
    elif kind == 1:
        pixels = 200.0 * (columns * rng.normal() + rows * rng.normal() > rng.normal() * 20)
    elif kind == 2:
        pixels = 255.0 * ((columns // rng.integers(1, 9) + rows // rng.integers(1, 9)) % 2)
    elif kind == 3:
        pixels = rng.normal() * columns + rng.normal() * rows
    elif kind == 4 and len(shape) > 1 and min(shape[:2]) > 0:
        flat = np.zeros(shape[:2], np.uint8)
        for _ in range(4):
            ends = rng.integers(0, max(shape[:2]), 4)
            cv2.line(flat, ends[:2].tolist(), ends[2:].tolist(), int(rng.integers(1, 256)), int(rng.integers(1, 4)))
        pixels = pixels + flat.reshape(shape[:2] + [1] * (len(shape) - 2))
    elif kind == 5:
        pixels = np.hypot(columns - 20, rows - 20) % rng.integers(2, 20) * 12
    pixels = pixels + rng.normal(0, draw.choice((0, 0, 1, 20)), shape)
    if draw.random() < 0.2:
        return pixels * draw.choice((1e-40, 1e-20, 1e3, 1e10, 1e30, 1.3e36, -1.0, 257.0))
    return pixels.clip(0, 255)


def _laid_out(draw: Random, image: Any) -> Any:
    """The same image with other strides, or right before memory that must not be read."""
    way = draw.randrange(8)
    if image.ndim < 2 or not image.size or image.dtype.kind == 'O' or way > 5:
        return image
    if way == 0:
        return image[::-1, ::-1]
    if way == 1:
        return np.asfortranarray(image)
    if way == 2:
        return np.repeat(np.repeat(image, 2, 0), 3, 1)[::2, ::3]
    if way == 3:
        return np.broadcast_to(image[:1], image.shape)
    if way == 4:
        bytes_ = np.zeros(image.nbytes + 1, np.uint8)
        odd = bytes_[1:].view(image.dtype).reshape(image.shape)  # an odd address
        odd[...] = image
        return odd
    return before_a_wall(image)


_LIBC = ctypes.CDLL(None, use_errno=True)


def before_a_wall(image: Any) -> Any:
    """A copy whose last byte is the last of its page, with a page behind it that cannot be read."""
    room = -(-image.nbytes // mmap.PAGESIZE) * mmap.PAGESIZE
    pages = mmap.mmap(-1, room + mmap.PAGESIZE)
    start = ctypes.addressof(ctypes.c_char.from_buffer(pages))
    if _LIBC.mprotect(ctypes.c_void_p(start + room), ctypes.c_size_t(mmap.PAGESIZE), 0):
        raise OSError(ctypes.get_errno(), 'mprotect')
    copied = np.frombuffer(pages, image.dtype, image.size, room - image.nbytes).reshape(image.shape)
    copied[...] = image
    return copied


def _mask(draw: Random, image: Any) -> Any:
    if draw.random() < 0.6 or not isinstance(image, np.ndarray):
        return None
    if draw.random() < 0.05:
        return draw.choice((5, 'mask', np.zeros(3, bool), np.zeros((3, 3), np.float32), np.ones((2, 2, 2), np.uint8)))
    rng = np.random.default_rng(draw.getrandbits(32))
    mask = rng.random(image.shape[:2]) < draw.choice((0.0, 0.02, 0.5, 0.98, 1.0))
    if draw.random() < 0.4 and image.dtype.kind == 'f':  # what is not finite may be there when it is masked
        mask = np.isfinite(image).all(tuple(range(2, image.ndim)))
    return mask if draw.random() < 0.5 else mask.astype(np.uint8) * draw.choice((1, 255))


def parameters(draw: Random) -> Input:
    """Values for some parameters, few of them beyond their ranges or of another type."""
    specs = Parameters.specs()
    names = draw.sample([*specs], draw.choice((0, 0, 1, 2, 4, 8, len(specs))))
    values = {name: _value(draw, name) for name in names}
    if draw.random() < 0.02:
        values[draw.choice([*specs])] = draw.choice((
            None, 'x', True, -1, 10**400, -10**400, math.nan, math.inf, 1e9, [], (1, 2), np.float64(3), np.int8(3),
            np.array([1.0]), b'deriche', 1j, [math.nan] * 4, [10**400] * 4, 'deriche', np.float16(0.5)))
    return values


def _value(draw: Random, name: str) -> Any:
    """A value within its range, at its ends now and then."""
    spec, default = Parameters.specs()[name], getattr(Parameters(), name)
    if name == 'threads':
        return draw.choice(THREADS)
    if isinstance(default, tuple):
        share = [draw.choice((0.0, 0.3, 0.5, draw.random())) for _ in range(2)]
        if draw.random() < 0.3:
            return [float(draw.choice((0, 1, 5, 30, 1e6))) for _ in range(4)]
        return [*share, draw.choice((1.0, draw.random())), draw.choice((1.0, draw.random()))]
    if spec.choices:
        return draw.choice(spec.choices)
    if isinstance(default, bool):
        return draw.random() < 0.5
    low, high = spec.low, spec.high
    value = draw.choice((low, high, low + (high - low) * draw.random(), low + (high - low) * draw.random()**8, default))
    return value if math.isnan(value) or isinstance(default, float) else round(value)


def check_extractor(fields: Input) -> int:
    """What the extractor makes of an image, with memory that earlier images left; its bytes are returned."""
    image, mask = fields['image'], fields['mask']
    WORKING.parameters = Parameters.profile(fields['profile'], **fields['parameters'])
    before = image.copy() if isinstance(image, np.ndarray) else None
    segments = WORKING.extract(image, mask)
    assert segments.dtype == SEGMENT_DTYPE
    height, width = image.shape[:2]
    for name, size in (('x', width), ('x1', width), ('x2', width), ('y', height), ('y1', height), ('y2', height)):
        assert np.isfinite(segments[name]).all(), name
        assert ((segments[name] >= -0.501) & (segments[name] <= size - 0.499)).all(), name
    for name in ('length', 'theta', 'rho'):
        assert np.isfinite(segments[name]).all(), name
    assert (np.abs(segments['theta']) <= np.float32(np.pi / 2)).all()
    assert np.isin(segments['code'], (1, 2, 3, 4)).all()
    assert WORKING.edges().shape == (height, width)
    assert before is not None
    assert before.tobytes() == image.tobytes(), 'the image was changed'
    if fields['fresh']:
        alone = dataclasses.replace(WORKING.parameters, threads=1)
        fresh = LineFeatureExtractor(alone).extract(image, mask)
        assert fresh.tobytes() == segments.tobytes(), 'what came before, or the threads, tell on the result'
    return int(image.nbytes)
