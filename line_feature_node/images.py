"""Image data of the outside world as arrays."""

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

#: How a complete file of a format ends, by how it begins; OpenCV fills in what is missing of others with grey.
ENDINGS = {b'\xff\xd8': b'\xff\xd9', b'\x89PNG': b'IEND\xaeB`\x82'}


def decode(data: bytes) -> NDArray[Any]:
    """Decode a compressed image: whatever OpenCV reads, turned upright as its EXIF data say.

    Returns:
        H×W or H×W×3 (BGR), with the depth of the file.

    Raises:
        ValueError: The data are no image, or only a part of one.
    """
    if not data:
        raise ValueError('no data: expected a compressed image')
    for beginning, ending in ENDINGS.items():
        # Some cameras add bytes of padding, editors whole blocks of their own: the end may lie before the last byte.
        if data.startswith(beginning) and ending not in data:
            raise ValueError(f'a part of an image: {len(data)} bytes without the end of the picture')
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_ANYCOLOR | cv2.IMREAD_ANYDEPTH)
    except cv2.error as error:
        raise ValueError(f'OpenCV cannot decode the image: {error.err}') from error
    if image is None:
        raise ValueError('not an image that OpenCV can decode')
    return np.asarray(image)
