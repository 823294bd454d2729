import numpy as np
import pytest

from line_feature_node.core import LineFeatureExtractor, Parameters
from line_feature_node.scenes import corridor
from line_feature_node.section3 import compare_pictures, measure_errors, telling_region


@pytest.fixture(scope='module')
def errors():
    return {(row.thinning, row.orientation): row for row in measure_errors(Parameters.paper())}


def test_every_combination_is_measured(errors):
    assert len(errors) == 6
    assert all(np.isfinite([row.precision, row.recall, row.angle, row.offset]).all() for row in errors.values())


def test_what_the_paper_says_of_localisation_holds(errors):
    """Edges from suppression localise best, whatever the way of fitting, and thick ones suffer from least squares."""
    for orientation in ('principal_axis', 'least_squares'):
        best = errors['suppression', orientation]
        assert all(best.offset < errors[way, orientation].offset for way in ('none', 'morphological'))
        assert all(best.recall > errors[way, orientation].recall for way in ('none', 'morphological'))
    assert errors['none', 'least_squares'].angle > errors['none', 'principal_axis'].angle
    assert errors['none', 'least_squares'].offset > errors['none', 'principal_axis'].offset


def test_six_panels_of_one_size():
    panels = compare_pictures(corridor(width=160, height=120).image, Parameters.paper())
    assert [name[:3] for name in panels] == ['(a)', '(b)', '(c)', '(d)', '(e)', '(f)']
    assert {panel.shape for panel in panels.values()} == {(720, 960, 3)}
    assert all(panel.any() for panel in panels.values())


@pytest.mark.parametrize('shape', [(1, 1), (1, 40), (50, 70)])
def test_blank_and_tiny_images_have_panels(shape):
    panels = compare_pictures(np.full(shape, 90, np.uint8), Parameters.paper())
    assert len(panels) == 6


def test_the_enlarged_region_lies_in_the_image():
    image = corridor().image
    ways = [LineFeatureExtractor(Parameters(thinning='none', orientation=orientation)).stages(image)
            for orientation in ('principal_axis', 'least_squares')]
    x, y, width, height = telling_region(*ways)
    assert (width, height) == (96, 72)
    assert 0 <= x <= 640 - width
    assert 0 <= y <= 480 - height
