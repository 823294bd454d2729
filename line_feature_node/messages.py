"""Segments and pictures as messages and back, for whichever library makes the messages: ROS 2 itself, or rosbags."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from line_feature_node.core import SEGMENT_DTYPE, end_points
from line_feature_node.core.features import UNREFINED
from line_feature_node.overlay import COLOURS

#: Types of numbers as sensor_msgs/PointField has them.
POINT_TYPES = {np.dtype(np.int32): 5, np.dtype(np.uint32): 6, np.dtype(np.float32): 7}
#: visualization_msgs/ImageMarker: pairs of points are lines; add, which replaces what was drawn before.
LINE_LIST, ADD = 2, 0
#: Pixels a drawn line is wide.
LINE_WIDTH = 2.0


@dataclass(frozen=True)
class Messages:
    """Makes the messages of one library.

    Attributes:
        types: The class of a message by its name, 'sensor_msgs/msg/Image'; it takes all fields as keywords.
        octets: Makes what the library wants in a field uint8[] of a contiguous array.
    """

    types: Callable[[str], Any]
    octets: Callable[[NDArray[Any]], Any]

    def segments(self, segments: NDArray[np.void], header: Any) -> Any:
        """A sensor_msgs/PointCloud2 with one point a segment, its fields those of SEGMENT_DTYPE.

        Args:
            segments: SEGMENT_DTYPE.
            header: std_msgs/Header of the image they were found in.
        """
        return self.types('sensor_msgs/msg/PointCloud2')(
            header=header, height=1, width=len(segments),
            fields=self._fields,
            is_bigendian=False, point_step=SEGMENT_DTYPE.itemsize, row_step=SEGMENT_DTYPE.itemsize * len(segments),
            data=self.octets(little_endian(segments)), is_dense=True)

    @cached_property
    def _fields(self) -> list[Any]:
        """The fields of a segment; all messages share them, as they take longer to make than the rest of a message."""
        field = self.types('sensor_msgs/msg/PointField')
        return [field(name=name, offset=offset, datatype=kind, count=1) for name, offset, kind in point_fields()]

    def markers(self, segments: NDArray[np.void], header: Any) -> Any:
        """A visualization_msgs/ImageMarker with a line for each segment, in the colour of its direction code.

        Args:
            segments: SEGMENT_DTYPE.
            header: std_msgs/Header of the image they were found in.
        """
        point, colour = self.types('geometry_msgs/msg/Point'), self.types('std_msgs/msg/ColorRGBA')
        white = colour(r=1.0, g=1.0, b=1.0, a=1.0)
        colours = {code: colour(r=r / 255, g=g / 255, b=b / 255, a=1.0) for code, (b, g, r) in COLOURS.items()}
        return self.types('visualization_msgs/msg/ImageMarker')(
            header=header, ns='line_features', id=0, type=LINE_LIST, action=ADD, position=point(x=0.0, y=0.0, z=0.0),
            scale=LINE_WIDTH, outline_color=white, filled=0, fill_color=white,
            lifetime=self.types('builtin_interfaces/msg/Duration')(sec=0, nanosec=0),
            points=[point(x=x, y=y, z=0.0) for x, y in end_points(segments).reshape(-1, 2).tolist()],
            outline_colors=[colours[code] for code in segments['code'].tolist()])

    def image(self, picture: NDArray[np.uint8], header: Any) -> Any:
        """A sensor_msgs/Image, mono8 of H×W or bgr8 of H×W×3 uint8."""
        height, width = picture.shape[:2]
        return self.types('sensor_msgs/msg/Image')(
            header=header, height=height, width=width, encoding='mono8' if picture.ndim == 2 else 'bgr8',
            is_bigendian=0, step=picture[0].nbytes, data=self.octets(np.ascontiguousarray(picture)))

    def compressed_image(self, data: NDArray[np.uint8], header: Any) -> Any:
        """A sensor_msgs/CompressedImage of the bytes of a JPEG."""
        return self.types('sensor_msgs/msg/CompressedImage')(
            header=header, format='bgr8; jpeg compressed bgr8', data=self.octets(data))


@cache
def point_fields() -> tuple[tuple[str, int, int], ...]:
    """Name, offset and datatype (PointField) of each field of SEGMENT_DTYPE."""
    fields: Any = SEGMENT_DTYPE.fields
    return tuple((name, fields[name][1], POINT_TYPES[fields[name][0]]) for name in SEGMENT_DTYPE.names or ())


def little_endian(segments: NDArray[np.void]) -> NDArray[np.void]:
    """The segments in the byte order of the message, in one piece."""
    return np.ascontiguousarray(segments, SEGMENT_DTYPE.newbyteorder('<'))


def segments_of(message: Any) -> NDArray[np.void]:
    """The segments in a sensor_msgs/PointCloud2 as the node publishes them, whichever library made the message.

    Fields are found by their names, so a message of another version will do: fields that it has besides are left out,
    and those of refinement may be missing.

    Returns:
        SEGMENT_DTYPE; a new array.

    Raises:
        ValueError: The message lacks a field, has one of another type, or its size disagrees with its data.
    """
    order: Any = '>' if message.is_bigendian else '<'
    found = {field.name: field for field in message.fields}
    names, offsets = [], []
    for name, _, kind in point_fields():
        field = found.get(name)
        if field is None and name in UNREFINED:
            continue
        if field is None:
            raise ValueError(f'the message has no field {name!r}: it has {", ".join(found) or "none"}')
        if field.datatype != kind or field.count != 1 or field.offset + 4 > message.point_step:
            raise ValueError(f'field {name!r} has datatype {field.datatype}, count {field.count} and offset '
                             f'{field.offset} of {message.point_step} bytes: expected datatype {kind} and count 1')
        names.append(name)
        offsets.append(field.offset)
    size, rows = message.point_step * message.width, message.height
    if len(message.data) != message.row_step * rows or (rows and message.row_step < size):
        raise ValueError(f'{len(message.data)} bytes of data: expected {rows} rows of {message.row_step}, with '
                         f'{message.width} points of {message.point_step} bytes each')
    formats: list[Any] = [np.dtype(SEGMENT_DTYPE[name]).newbyteorder(order) for name in names]
    layout = np.dtype({'names': names, 'formats': formats, 'offsets': offsets, 'itemsize': message.point_step})
    points = np.ndarray((rows, message.width), layout, np.frombuffer(message.data, np.uint8),
                        strides=(message.row_step, message.point_step))
    segments = np.empty(points.size, SEGMENT_DTYPE)
    for name in SEGMENT_DTYPE.names or ():
        segments[name] = points[name].reshape(-1) if name in names else UNREFINED[name]
    return segments
