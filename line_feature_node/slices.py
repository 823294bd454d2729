"""The work of the offline run: the frames of one slice of a recording, decoded, extracted and made into messages."""

import contextlib
import json
import struct
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from line_feature_node.core import LineFeatureExtractor, Parameters, end_points
from line_feature_node.images import displayable, usable_pixels
from line_feature_node.messages import Messages, segments_of
from line_feature_node.overlay import draw_overlay, encode_jpeg
from line_feature_node.recordings import DECODERS, Slice, deserialize, opened, typestore
from line_feature_node.truth import compare

#: What is made of a frame, by the ending of its topic, with the type of the message.
OUTPUTS = {
    'segments': 'sensor_msgs/msg/PointCloud2', 'markers': 'visualization_msgs/msg/ImageMarker',
    'overlay': 'sensor_msgs/msg/CompressedImage',
}
#: Ending of the topic that may have the true segments of an image topic.
TRUTH = 'truth'
#: Name of the segments as text among the messages.
CSV = 'csv'
#: Bands of orientation that lengths are summed up in.
BANDS = 18
#: Before a packed slice: the length of its table of contents.
PREFIX = struct.Struct('<Q')

MESSAGES = Messages(lambda name: typestore(ros1=False).types[name], lambda data: data.reshape(-1).view(np.uint8))


@dataclass(frozen=True)
class Job:
    """What is to be done with every slice of a recording.

    Attributes:
        parameters: Of the extraction.
        mask: H×W uint8, 0 where no edges are wanted; None for none.
        outputs: Which of OUTPUTS are made.
        truth: Whether segments are held against the true ones on the topic beside that of the images.
        csv: Whether segments are written as text, too.
        jpeg_quality: Of the overlays.
    """

    parameters: Parameters
    mask: NDArray[np.uint8] | None = None
    outputs: tuple[str, ...] = tuple(OUTPUTS)
    truth: bool = False
    csv: bool = False
    jpeg_quality: int = 80


@dataclass
class Frame:
    """What became of one frame.

    Attributes:
        topic: Of the image.
        number: Among the frames of its topic in the slice or, once numbered, in the recording.
        stamp: Nanoseconds, when the recording has it.
        error: What was wrong with it, one sentence; '' where nothing was.
        segments: How many there are.
        seconds: What the extraction took.
        orientations: Length of segments, pixels, in 18 bands of 10 degrees from -90.
        agreement: Precision, recall, angle (radians) and offset (pixels) where there is a truth.
        header_stamp: Nanoseconds, what the header of the image says; 0 where it says nothing.
        messages: Serialised, by the ending of their topic; under CSV the segments as lines of text.
    """

    topic: str
    number: int
    stamp: int
    error: str = ''
    segments: int = 0
    seconds: float = 0.0
    orientations: list[float] = field(default_factory=list)
    agreement: list[float] = field(default_factory=list)
    header_stamp: int = 0
    messages: dict[str, bytes] = field(default_factory=dict)


def process_slice(part: Slice, job: Job) -> bytes:
    """Process the frames of a slice, in their order; the same messages whoever does it.

    Returns:
        The frames, packed; only the seconds that they took differ from time to time.

    Raises:
        RecordingError: The recording cannot be read.
    """
    return pack(list(_frames(part, job)))


def _frames(part: Slice, job: Job) -> Iterator[Frame]:
    extractor = _extractor(job.parameters)
    numbers = dict(zip(part.topics, part.skipped or (0,) * len(part.topics), strict=True))
    with opened(part.path) as reader:
        wanted = {*part.topics, *(f'{topic}/{TRUTH}' for topic in part.topics if job.truth)}
        connections = [connection for connection in reader.connections if connection.topic in wanted]
        truths = _truths(reader, connections, part) if job.truth else {}
        images = [connection for connection in connections if connection.topic in part.topics]
        for connection, stamp, data in reader.messages(images, part.start, part.stop):
            number = numbers[connection.topic]
            numbers[connection.topic] += 1
            if number % part.every == 0:
                frame = Frame(connection.topic, number, stamp)
                _process(frame, connection.msgtype, data, part.path, job, extractor, truths)
                yield frame


@cache
def _extractor(parameters: Parameters) -> LineFeatureExtractor:
    """One extractor a worker, which is one thread: its memory is kept from slice to slice."""
    return LineFeatureExtractor(parameters)


def _truths(reader: Any, connections: list[Any], part: Slice) -> dict[tuple[str, int], NDArray[np.void]]:
    """The true segments of the slice, by topic of the images and stamp of the recording."""
    truths = {}
    others = [connection for connection in connections if connection.topic not in part.topics]
    for connection, stamp, data in reader.messages(others, part.start, part.stop) if others else ():
        with contextlib.suppress(ValueError):  # what is no truth is none to compare with
            segments = segments_of(deserialize(part.path, data, connection.msgtype))
            truths[connection.topic.removesuffix(f'/{TRUTH}'), stamp] = segments
    return truths


def _process(
    frame: Frame, msgtype: str, data: bytes, path: Path, job: Job, extractor: LineFeatureExtractor, truths: Any,
) -> None:
    """Fill in what becomes of a frame; what is wrong with it is its error."""
    try:
        message = deserialize(path, data, msgtype)
        frame.header_stamp = message.header.stamp.sec * 10**9 + message.header.stamp.nanosec
        image = DECODERS[msgtype](message)
        begin = time.perf_counter()
        segments = extractor.extract(image, usable_pixels(image, job.mask))
        frame.seconds = time.perf_counter() - begin
    except (cv2.error, MemoryError, TypeError, ValueError) as error:
        frame.error = ' '.join(str(error).split()) or type(error).__name__
        return
    frame.segments = len(segments)
    frame.orientations = _orientations(segments)
    if (frame.topic, frame.stamp) in truths:
        frame.agreement = _agreement(segments, truths[frame.topic, frame.stamp])
    header = _header(message.header)
    if job.csv:
        frame.messages[CSV] = segments_as_text(segments)
    try:
        for name in job.outputs:
            made = _message(name, image, segments, header, job)
            frame.messages[name] = bytes(typestore(ros1=False).serialize_cdr(made, OUTPUTS[name]))
    except (cv2.error, MemoryError, ValueError) as error:  # an overlay that cannot be
        frame.error = ' '.join(str(error).split())


def _message(name: str, image: NDArray[Any], segments: NDArray[np.void], header: Any, job: Job) -> Any:
    if name == 'segments':
        return MESSAGES.segments(segments, header)
    if name == 'markers':
        return MESSAGES.markers(segments, header)
    overlay = draw_overlay(displayable(image, job.parameters), segments, f'{len(segments)} segments')
    return MESSAGES.compressed_image(encode_jpeg(overlay, job.jpeg_quality), header)


def segments_as_text(segments: NDArray[np.void]) -> bytes:
    """A line for each segment, its fields separated by commas; nine digits give every float32 back exactly."""
    return '\n'.join(','.join(f'{value:.9g}' for value in segment) for segment in segments.tolist()).encode()


def _header(header: Any) -> Any:
    """A header of ROS 2 that says what the image's says; that of ROS 1 has a number besides."""
    types = typestore(ros1=False).types
    stamp = types['builtin_interfaces/msg/Time'](sec=header.stamp.sec, nanosec=header.stamp.nanosec)
    return types['std_msgs/msg/Header'](stamp=stamp, frame_id=header.frame_id)


def _orientations(segments: NDArray[np.void]) -> list[float]:
    degrees = np.degrees(segments['theta'].astype(float))
    edges = np.linspace(-90, 90, BANDS + 1)
    lengths, _ = np.histogram(np.clip(degrees, -90, 90), edges, weights=segments['length'].astype(float))
    return [round(float(length), 1) for length in lengths]


def _agreement(segments: NDArray[np.void], truth: NDArray[np.void]) -> list[float]:
    """Size 0 marks true segments that are too weak to be asked for."""
    ends, weak = end_points(truth), truth['size'] == 0
    found = compare(end_points(segments), ends[~weak], ends[weak])
    return [found.precision, found.recall, found.angle, found.offset]


def pack(frames: list[Frame]) -> bytes:
    """Frames in one piece: the length of a table of contents, the table as JSON, and the messages one by one."""
    entries: list[dict[str, Any]] = []
    blobs: list[bytes] = []
    for frame in frames:
        entry = asdict(frame)
        entry['messages'] = {name: len(data) for name, data in frame.messages.items()}
        entries.append(entry)
        blobs += frame.messages.values()
    table = json.dumps(entries).encode()
    return b''.join([PREFIX.pack(len(table)), table, *blobs])


def unpack(data: bytes) -> list[Frame]:
    """The frames in a piece that :func:`pack` made."""
    place = PREFIX.size + PREFIX.unpack_from(data)[0]
    frames = []
    for entry in json.loads(data[PREFIX.size:place]):
        sizes, entry['messages'] = entry['messages'], {}
        for name, size in sizes.items():
            entry['messages'][name] = data[place:place + size]
            place += size
        frames.append(Frame(**entry))
    return frames
