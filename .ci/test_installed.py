"""What is to be tested in a colcon workspace is what colcon installed there; .ci/colcon runs this among the tests."""

import os
from pathlib import Path

import line_feature_node


def test_the_package_under_test_is_the_installed_one():
    """It lies below one of the prefixes of the workspace."""
    module = Path(line_feature_node.__file__)
    assert any(module.is_relative_to(prefix) for prefix in os.environ['AMENT_PREFIX_PATH'].split(os.pathsep))
