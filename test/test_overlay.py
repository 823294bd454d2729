import cv2
import numpy as np
import pytest

from line_feature_node.core import SEGMENT_DTYPE
from line_feature_node.overlay import BACKGROUND, COLOURS, JPEG_SIDE, draw_overlay, encode_jpeg


def segment(x1, y1, x2, y2, code):
    record = np.zeros(1, SEGMENT_DTYPE)
    for name, value in zip(('x1', 'y1', 'x2', 'y2', 'code'), (x1, y1, x2, y2, code), strict=True):
        record[name] = value
    return record


@pytest.mark.parametrize('shape', [(60, 80), (60, 80, 1), (60, 80, 3), (60, 80, 4)])
def test_background_is_the_darkened_grey_picture(shape):
    overlay = draw_overlay(np.full(shape, 100, np.uint8), np.empty(0, SEGMENT_DTYPE))
    assert overlay.shape == (60, 80, 3)
    assert np.all(overlay == round(100 * BACKGROUND))


@pytest.mark.parametrize('code', [1, 2, 3, 4])
def test_segment_has_the_colour_of_its_code_and_white_ends(code):
    overlay = draw_overlay(np.zeros((60, 80), np.uint8), segment(10, 30, 70, 30, code))
    np.testing.assert_allclose(overlay[30, 40], COLOURS[code], rtol=0.1)
    assert tuple(overlay[30, 10]) == tuple(overlay[30, 70]) == (255, 255, 255)
    assert not overlay[:25].any()


def test_half_pixels_are_drawn_between_the_pixels():
    overlay = draw_overlay(np.zeros((60, 80), np.uint8), segment(10, 30.5, 70, 30.5, 4)).astype(int)
    assert overlay[30, 40].sum() == pytest.approx(overlay[31, 40].sum(), rel=0.2)


def test_caption_stands_in_the_corner_only():
    image = np.full((480, 640), 100, np.uint8)
    bare, captioned = draw_overlay(image, np.empty(0, SEGMENT_DTYPE)), draw_overlay(
        image, np.empty(0, SEGMENT_DTYPE), '12 segments')
    changed = np.argwhere((bare != captioned).any(-1))
    assert len(changed) > 0
    assert np.all(changed.max(0) < (40, 200))


def test_the_image_is_left_as_it_was():
    image = np.full((60, 80, 3), 100, np.uint8)
    draw_overlay(image, segment(1, 1, 50, 50, 1), 'text')
    assert np.all(image == 100)


def test_jpeg_of_an_overlay():
    picture = draw_overlay(np.full((60, 80), 100, np.uint8), segment(10, 30, 70, 30, 1))
    small, large = (encode_jpeg(picture, quality) for quality in (20, 95))
    assert cv2.imdecode(large, cv2.IMREAD_COLOR).shape == picture.shape
    assert small.size < large.size


def test_a_picture_too_wide_for_a_jpeg_is_said_so():
    with pytest.raises(ValueError, match=f'65501×1 pixels are more than a JPEG can have, {JPEG_SIDE} a side'):
        encode_jpeg(np.zeros((1, JPEG_SIDE + 1, 3), np.uint8), 80)
