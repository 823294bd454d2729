import cv2
import numpy as np
import pytest

from line_feature_node.images import decode

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
