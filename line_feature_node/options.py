"""The table of the node's own parameters, beside those of the extraction."""

from dataclasses import dataclass

from line_feature_node.core import PROFILES
from line_feature_node.core.parameters import ParameterSet, parameter

#: How the names of rclpy's parameters for quality of service begin.
QOS_OVERRIDES = 'qos_overrides.'


@dataclass(frozen=True, kw_only=True, eq=False)
class Options(ParameterSet):
    """How the node gets its images and what it says of itself; checked when made and never changed after.

    Raises:
        TypeError: A name is unknown or a value has the wrong type.
        ValueError: A value is outside its range.
    """

    profile: str = parameter(
        'default', 'Named set that the parameters of the extraction start from; set while running, it sets them all.',
        choices=tuple(PROFILES))
    image_transport: str = parameter(
        'raw', 'How images come: as they are, or as JPEG and the like on the topic with /compressed behind its name.',
        choices=('raw', 'compressed'), constant=True)
    mask_file: str = parameter(
        '', 'Image file of the size of the pictures, black where no edges are wanted; empty for none.', constant=True)
    lazy: bool = parameter(True, 'Images are subscribed to only while somebody listens to a result.')
    autostart: bool = parameter(
        True, 'The node configures and activates itself when it starts; otherwise a life-cycle manager does.',
        constant=True)
    jpeg_quality: int = parameter(80, 'Quality of the compressed overlay.', low=1, high=100)
    image_timeout: float = parameter(
        2.0, 'Diagnostics report an error when no image came for so long.', low=0.1, high=3600.0, unit='seconds')
    max_latency: float = parameter(
        0.1, 'Diagnostics warn when 5 % of the segments come later than this after their image was published.',
        low=0.0, high=60.0, unit='seconds')
    max_dropped: float = parameter(
        0.1, 'Diagnostics warn when a larger share of the images of the last second was dropped.', low=0.0, high=1.0)
