import numpy as np
import pytest

from line_feature_node.core import LineFeatureExtractor
from line_feature_node.core.buffers import Buffers


def test_an_array_stays_until_a_larger_one_is_needed():
    buffers = Buffers()
    array = buffers.array('a', 100, np.int32)
    assert array.size >= 100
    assert buffers.array('a', 50, np.int32) is array
    assert buffers.array('a', array.size + 1, np.int32) is not array


def test_zeros_are_zero_also_after_growing():
    buffers = Buffers()
    assert not buffers.array('a', 10, np.int32, zeros=True).any()
    assert not buffers.array('a', 100000, np.int32, zeros=True).any()


def test_an_image_has_exactly_its_size():
    buffers = Buffers()
    image = buffers.image('a', 4, 5, np.uint8)
    assert image.shape == (4, 5)
    assert buffers.image('a', 4, 5, np.uint8) is image
    assert buffers.image('a', 5, 4, np.uint8).shape == (5, 4)


def test_images_of_several_sizes_share_memory_and_begin_as_zeros():
    """A camera that is switched to and fro takes no more than with its largest picture alone."""
    buffers = Buffers()
    largest = buffers.image('a', 40, 50, np.float32)
    for height, width, dtype in [(30, 20, np.float32), (40, 50, np.int16), (40, 50, np.float32)]:
        image = buffers.image('a', height, width, dtype)
        assert (image.shape, image.dtype, image.flags.c_contiguous) == ((height, width), dtype, True)
        assert not image.any()
        assert np.shares_memory(image, largest)
        image[:] = 7
    assert buffers.last_image('a') is image


def test_the_hot_path_allocates_nothing():
    """After the first frames of a video every array is one that was there before."""
    extractor = LineFeatureExtractor()
    noise = np.random.default_rng(0).integers(0, 255, (3, 120, 160), np.uint8)
    for frame in noise:
        extractor.extract(frame)
    before = {name: id(array) for name, array in extractor._buffers._arrays.items()}
    for frame in noise:
        extractor.extract(frame)
    assert {name: id(array) for name, array in extractor._buffers._arrays.items()} == before


def test_two_things_of_one_name_are_told():
    """One would be written over by the other, and kernels compiled for the wrong type."""
    buffers = Buffers()
    buffers.array('rows', 10, np.float32)
    with pytest.raises(TypeError, match=r'rows was an array of float32, and is asked for as one of int32'):
        buffers.array('rows', 5, np.int32)
    assert buffers.array('rows', 5, np.float32).size >= 10
