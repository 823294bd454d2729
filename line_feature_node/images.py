"""Images of the outside world as arrays: messages, of topics and recordings alike, and compressed files."""

import math
import re
import struct
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from line_feature_node import MOST_PIXELS
from line_feature_node.core import Parameters
from line_feature_node.core.edges import intensity_map

JPEG, JPEG_SCAN, JPEG_END = b'\xff\xd8\xff', 0xDA, b'\xff\xd9'
#: As decoders find a marker: they skip what comes before it, and bytes of filling.
JPEG_MARKER = re.compile(rb'\xff+([^\x00\xff])', re.DOTALL)
#: Markers without a length: TEM, and RST0 to RST7.
JPEG_BARE = {0x01, *range(0xD0, 0xD8)}
PNG, PNG_END = b'\x89PNG', b'IEND'
#: Bytes of a chunk besides its content: length, name and checksum.
PNG_CHUNK = 12
#: Markers of a JPEG that announce its size: all of SOF0 to SOF15 but the tables DHT, JPG and DAC among them.
JPEG_SIZES = set(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
#: 8×8 pixels of a JPEG take a bit at least, and a byte of what deflate makes stands for so many at most.
JPEG_PIXELS, INFLATED = 8 * 64, 1032
#: Where the colour type of a PNG stands, behind the bits of a sample; and how many samples a pixel has, by the type.
PNG_TYPE, PNG_SAMPLES = 25, {2: 3, 4: 2, 6: 4}
#: Bytes before the picture in a compressed depth image: format, and two numbers that map inverse depth to 16 bits.
DEPTH_HEADER = struct.Struct('<iff')

#: Grey levels between the darkest and the brightest pixel of a picture that uses hardly any of its range.
FAINT = 16.0
#: A 16-bit picture whose brightest pixel is below this share of the range comes from a sensor with fewer bits.
FEW_BITS = 0.25


@dataclass(frozen=True)
class Encoding:
    """How the pixels of a message lie in its data.

    Attributes:
        dtype: Type of a number.
        channels: Numbers a pixel.
        conversion: OpenCV's code of the conversion to grey, if one is needed.
        luma: Which of the numbers is the brightness, where no conversion is needed.
        smallest: Rows and columns that the conversion needs at least.
    """

    dtype: Any
    channels: int = 1
    conversion: int | None = None
    luma: int = 0
    smallest: int = 1


#: Every encoding that is understood, by its name in a message. The Bayer patterns of ROS 2 are named by the first two
#: rows, those of OpenCV by the second and third column of the second and third row.
ENCODINGS = {
    'mono8': Encoding(np.uint8),
    '8UC1': Encoding(np.uint8),
    'mono16': Encoding(np.uint16),
    '16UC1': Encoding(np.uint16),
    '32FC1': Encoding(np.float32),
    **{name + str(bits): Encoding(dtype, channels, conversion)
       for bits, dtype in ((8, np.uint8), (16, np.uint16))
       for name, channels, conversion in (
           ('rgb', 3, cv2.COLOR_RGB2GRAY), ('bgr', 3, cv2.COLOR_BGR2GRAY),
           ('rgba', 4, cv2.COLOR_RGBA2GRAY), ('bgra', 4, cv2.COLOR_BGRA2GRAY))},
    '8UC3': Encoding(np.uint8, 3, cv2.COLOR_BGR2GRAY),
    '8UC4': Encoding(np.uint8, 4, cv2.COLOR_BGRA2GRAY),
    **{name: Encoding(np.uint8, 2, luma=1) for name in ('yuv422', 'uyvy')},
    **{name: Encoding(np.uint8, 2, luma=0) for name in ('yuv422_yuy2', 'yuyv')},
    **{f'bayer_{pattern}{bits}': Encoding(dtype, conversion=conversion, smallest=3)
       for bits, dtype in ((8, np.uint8), (16, np.uint16))
       for pattern, conversion in (
           ('rggb', cv2.COLOR_BayerBG2GRAY), ('bggr', cv2.COLOR_BayerRG2GRAY),
           ('gbrg', cv2.COLOR_BayerGR2GRAY), ('grbg', cv2.COLOR_BayerGB2GRAY))},
}


def image_of(message: Any) -> NDArray[Any]:
    """The grey picture of a sensor_msgs/Image, whichever library made the message.

    Args:
        message: With height, width, encoding, is_bigendian, step and data, a buffer of bytes.

    Returns:
        H×W uint8, uint16 or float32. Where no conversion is needed it is a view of the message's data, which the data
        cannot outgrow while the view lives.

    Raises:
        ValueError: The encoding is unknown, or the fields contradict each other.
    """
    encoding = ENCODINGS.get(message.encoding)
    if encoding is None:
        raise ValueError(f'unknown encoding {message.encoding!r}: expected one of {", ".join(ENCODINGS)}')
    pixels = _pixels_of(message, encoding)
    # OpenCV overlooks the byte order, and a step that is not a multiple of the numbers' size.
    if not pixels.dtype.isnative or message.step % pixels.itemsize:
        pixels = pixels.astype(pixels.dtype.newbyteorder('='))
    if encoding.conversion is None:
        return pixels[..., encoding.luma]
    return np.asarray(cv2.cvtColor(pixels, encoding.conversion))


def _pixels_of(message: Any, encoding: Encoding) -> NDArray[Any]:
    """The data as H×W×channels, a view of it."""
    height, width, step, size = message.height, message.width, message.step, len(message.data)
    dtype = np.dtype(encoding.dtype)
    if min(height, width) < encoding.smallest:
        raise ValueError(f'an image of {width}×{height} pixels: expected {encoding.smallest}×{encoding.smallest} or '
                         f'more of {message.encoding}')
    least = width * encoding.channels * dtype.itemsize
    if step < least:
        raise ValueError(f'step is {step}: expected {least} bytes or more for {width} pixels of {message.encoding}')
    if step * height != size:
        raise ValueError(f'{size} bytes of data: expected {height} rows of {step}, {step * height} bytes')
    if dtype.itemsize > 1 and message.is_bigendian:
        dtype = dtype.newbyteorder('>')
    return np.ndarray((height, width, encoding.channels), dtype, message.data,
                      strides=(step, encoding.channels * dtype.itemsize, dtype.itemsize))


def compressed_image_of(message: Any) -> NDArray[Any]:
    """The grey picture of a sensor_msgs/CompressedImage, whichever library made the message.

    Drivers write many things into `format`, so the data tell whether it is JPEG or PNG; only compressed depth images
    are known by their format. Nothing else is decoded, as anybody may send it: how much memory a picture of another
    kind needs is known only when it has it.

    Returns:
        H×W uint8, uint16 or float32.

    Raises:
        ValueError: The data are no such picture, or only a part of one.
    """
    data = bytes(message.data)
    if 'compressedDepth' in message.format:
        return _depth_of(data, message.format)
    if data and not data.startswith((JPEG, PNG)):
        raise ValueError(f'not an image as JPEG or PNG: {len(data)} bytes that begin with {data[:4]!r}')
    return decode(data, grey=True)


def _depth_of(data: bytes, form: str) -> NDArray[Any]:
    """A depth image, in which 32-bit depths d are kept as 16-bit numbers A / d + B; 0 stands for an unknown one."""
    if PNG not in data[:DEPTH_HEADER.size + len(PNG)]:
        raise ValueError(f'a compressed depth image without a PNG in it: {form!r} is not supported')
    image = decode(data[data.index(PNG):], grey=True)
    if not form.startswith('32FC1') or image.dtype != np.uint16 or len(data) < DEPTH_HEADER.size:
        return image
    _, a, b = DEPTH_HEADER.unpack_from(data)
    inverse = image.astype(np.float32) - np.float32(b)
    unknown = (image == 0) | (inverse == 0)
    return np.asarray(np.where(unknown, np.float32(np.nan), np.float32(a) / np.where(unknown, 1, inverse)), np.float32)


def decode(data: bytes, *, grey: bool = False) -> NDArray[Any]:
    """Decode a compressed image: whatever OpenCV reads, turned upright as its EXIF data say.

    Args:
        data: The content of an image file.
        grey: Whether a coloured picture is wanted in grey.

    Returns:
        H×W or H×W×3 (BGR), with the depth of the file.

    Raises:
        ValueError: The data are no image, or only a part of one, or of one beyond all measure.
    """
    if not data:
        raise ValueError('no data: expected a compressed image')
    if not _is_whole(data):
        raise ValueError(f'a part of an image: {len(data)} bytes without the end of the picture')
    width, height = _announced_size(data)
    if not width * height and data.startswith((JPEG, PNG)):
        kind = 'PNG' if data.startswith(PNG) else 'JPEG'
        raise ValueError(f'not an image: {len(data)} bytes of {kind} without a size')
    if width * height > MOST_PIXELS:
        raise ValueError(f'an image of {width}×{height} pixels: expected {MOST_PIXELS} at most')
    if width * height > (most := _most_pixels(data)):
        raise ValueError(f'an image of {width}×{height} pixels in {len(data)} bytes, which hold {most} pixels at most')
    channels = cv2.IMREAD_GRAYSCALE if grey else cv2.IMREAD_ANYCOLOR
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), channels | cv2.IMREAD_ANYDEPTH)
    except cv2.error as error:
        raise ValueError(f'OpenCV cannot decode the image: {error.err}') from error
    if image is None:
        raise ValueError('not an image that OpenCV can decode')
    return np.asarray(image)


def _is_whole(data: bytes) -> bool:
    """False for a JPEG or PNG whose end is missing; some versions of OpenCV fill in grey for what does.

    Cameras add padding and editors blocks of their own, so the end may lie before the last byte.
    """
    if data.startswith(JPEG):
        return JPEG_END in data[_jpeg_header(data)[0]:]
    return not data.startswith(PNG) or _has_all_chunks(data)


def _has_all_chunks(data: bytes) -> bool:
    """Whether the chunks of a PNG are there to the last: OpenCV makes room for what the length of one claims."""
    place, name = 8, b''
    while name != PNG_END and place + PNG_CHUNK <= len(data):
        length = int.from_bytes(data[place:place + 4], 'big')
        name = data[place + 4:place + 8]
        place += PNG_CHUNK + length
    return name == PNG_END and place <= len(data)


def _announced_size(data: bytes) -> tuple[int, int]:
    """Width and height in the header of a JPEG or PNG; 0, 0 where they are not found, as in other formats."""
    if data.startswith(JPEG):
        return _jpeg_header(data)[1]
    if data.startswith(PNG) and len(data) >= 24:
        width, height = struct.unpack_from('>II', data, 16)
        return width, height
    return 0, 0


def _most_pixels(data: bytes) -> int:
    """How many pixels a JPEG or PNG of so many bytes has at most, so that none is given room that it cannot fill."""
    if data.startswith(JPEG):
        return JPEG_PIXELS * len(data)
    if data.startswith(PNG) and len(data) > PNG_TYPE:
        return INFLATED * 8 * len(data) // (max(data[PNG_TYPE - 1], 1) * PNG_SAMPLES.get(data[PNG_TYPE], 1))
    return MOST_PIXELS


def _jpeg_header(data: bytes) -> tuple[int, tuple[int, int]]:
    """Where the picture itself begins in a JPEG, behind its header, which may hold a thumbnail; and its size."""
    place, size = 2, (0, 0)
    while (marker := JPEG_MARKER.search(data, place)) and marker[1][0] != JPEG_SCAN:
        place = marker.end()
        if marker[1][0] in JPEG_SIZES and place + 7 <= len(data):
            height, width = struct.unpack_from('>HH', data, place + 3)
            size = width, height
        if marker[1][0] not in JPEG_BARE:
            place += int.from_bytes(data[place:place + 2], 'big')
    return place, size


def known_pixels(image: NDArray[Any]) -> NDArray[np.bool_] | None:
    """A mask of the pixels that are finite; None where all are."""
    if image.dtype.kind != 'f' or cv2.checkRange(image)[0]:
        return None
    return np.asarray(np.isfinite(image))


def usable_pixels(image: NDArray[Any], mask: NDArray[np.uint8] | None) -> NDArray[Any] | None:
    """A mask of the pixels that are finite and not masked; None where all are.

    Raises:
        ValueError: The mask has another shape.
    """
    known = known_pixels(image)
    if mask is None:
        return known
    if mask.shape != image.shape:
        (height, width), (rows, columns) = image.shape, mask.shape
        raise ValueError(f'an image of {width}×{height} pixels: mask_file has {columns}×{rows}')
    if known is None:
        return mask
    return np.asarray(known & (mask != 0))


def range_hint(image: NDArray[Any], parameters: Parameters) -> str:
    """One sentence on how to set the range of intensities for a picture that uses little of it; '' for others."""
    scale, _ = intensity_map(image.dtype, parameters)
    finite = image[np.isfinite(image)] if image.dtype.kind == 'f' else image
    if not finite.size:
        return ''
    low, high = float(finite.min()), float(finite.max())
    few_bits = (image.dtype.newbyteorder('=') == np.uint16 and math.isnan(parameters.intensity_max)
                and high < FEW_BITS * np.iinfo(np.uint16).max)
    if low == high or not (few_bits or scale * (high - low) <= FAINT):
        return ''
    bits = f', such as intensity_max {2 ** max(8, int(high).bit_length()) - 1}' if few_bits else ''
    return (f'pixels from {low:g} to {high:g} are {scale * (high - low) / 255:.1%} of the range: '
            f'intensity_min and intensity_max say what is black and white{bits}')


def displayable(image: NDArray[Any], parameters: Parameters) -> NDArray[np.uint8]:
    """The image with its range of intensities brought to bytes; what is not finite is black."""
    scale, offset = intensity_map(image.dtype, parameters)
    if image.dtype == np.uint8 and (scale, offset) == (1, 0):
        return image
    with np.errstate(invalid='ignore', over='ignore'):  # of what is not finite, or will not be
        levels = scale * image.astype(np.float32) + offset
    levels = np.nan_to_num(levels, copy=False, nan=0, posinf=0, neginf=0)
    return np.asarray(np.clip(levels, 0, 255), np.uint8)
