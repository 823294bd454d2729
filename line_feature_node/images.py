"""Image data of the outside world as arrays."""

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

JPEG, JPEG_SCAN, JPEG_END = b'\xff\xd8\xff', 0xDA, b'\xff\xd9'
PNG, PNG_END = b'\x89PNG', b'IEND\xaeB`\x82'


def decode(data: bytes) -> NDArray[Any]:
    """Decode a compressed image: whatever OpenCV reads, turned upright as its EXIF data say.

    Returns:
        H×W or H×W×3 (BGR), with the depth of the file.

    Raises:
        ValueError: The data are no image, or only a part of one.
    """
    if not data:
        raise ValueError('no data: expected a compressed image')
    if not _is_whole(data):
        raise ValueError(f'a part of an image: {len(data)} bytes without the end of the picture')
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_ANYCOLOR | cv2.IMREAD_ANYDEPTH)
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
        return JPEG_END in data[_first_scan(data):]
    return not data.startswith(PNG) or PNG_END in data


def _first_scan(data: bytes) -> int:
    """Where the picture itself begins in a JPEG: behind its header, which may hold a thumbnail, an image of its own."""
    place = 2
    while place + 4 <= len(data) and data[place] == 0xFF and data[place + 1] != JPEG_SCAN:
        place += 2 + int.from_bytes(data[place + 2:place + 4], 'big')
    return place
