"""The work of the offline run: the frames of one slice of a recording, decoded, extracted and made into messages."""

import contextlib
import json
import struct
import time
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from line_feature_node.core import LineFeatureExtractor, Parameters, end_points
from line_feature_node.images import displayable, usable_pixels
from line_feature_node.messages import Messages, segments_of
from line_feature_node.overlay import draw_overlay, encode_jpeg
from line_feature_node.recordings import DECODERS, OUTPUTS, SLICE, Reader, Slice, deserialize, kept_open, typestore
from line_feature_node.truth import compare

#: Ending of the topic that may have the true segments of an image topic.
TRUTH = 'truth'
#: Name of the segments as text among the messages.
CSV = 'csv'
#: Frames that are processed of a slice, at most, as all their messages are kept in memory; the rest is given back, ...
LIMIT = 2 * SLICE
#: ... in so many parts, that several workers may share it.
PARTS = 4
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
        The frames, packed, with what is left to be done where there are more than LIMIT; only the seconds that they
        took differ from time to time.

    Raises:
        RecordingError: The recording cannot be read.
    """
    frames: list[Frame] = []
    found: list[NDArray[np.void] | None] = []
    extractor = _extractor(job.parameters)
    with kept_open(part.path) as reader:
        images = [connection for connection in reader.connections if connection.topic in part.topics]
        rest = None
        for step in _read(reader, images, part):
            if len(frames) == LIMIT:
                rest = _rest(reader, images, part, step)
                break
            frames.append(Frame(step.connection.topic, step.number, step.stamp))
            found.append(_process(frames[-1], step.connection.msgtype, step.data, part.path, job, extractor))
        if job.truth and frames:
            _compare(reader, part, frames, found)
    return pack(frames, rest)


@dataclass
class _Step:
    """A frame that is to be processed.

    Attributes:
        connection, stamp, data: Its message.
        number: Among the frames of its topic.
        before: Stamps of the messages of the slice that were read before it.
        counts: Frames of each topic before it.
    """

    connection: Any
    stamp: int
    data: bytes
    number: int
    before: list[int]
    counts: dict[str, int]


def _read(reader: Reader, images: list[Any], part: Slice) -> Iterator[_Step]:
    counts = dict(zip(part.topics, part.skipped or (0,) * len(part.topics), strict=True))
    before: list[int] = []
    for connection, stamp, data in reader.messages(images, part.start, part.stop):
        if not isinstance(stamp, int):  # tables of sqlite3 have anything anywhere
            raise ValueError(f'a message has {stamp!r} in the place of its time')
        if len(before) >= part.after:
            number = counts[connection.topic]
            if number % part.every == 0:
                yield _Step(connection, stamp, data, number, before, counts)
            counts[connection.topic] += 1
        before.append(stamp)


def _rest(reader: Reader, images: list[Any], part: Slice, step: _Step) -> Slice:
    """What is left of a slice, from a frame on.

    Readers sort by time, but for recordings in several files, which may overlap: those are read from the beginning of
    the slice again.
    """
    earlier = sum(stamp < step.stamp for stamp in step.before)
    ordered = max(step.before) <= step.stamp and (
        part.start == step.stamp or earlier == sum(1 for _ in reader.messages(images, part.start, step.stamp)))
    skipped = tuple(step.counts.values()) if part.skipped else ()
    if ordered:
        return replace(part, start=step.stamp, after=len(step.before) - earlier, skipped=skipped)
    return replace(part, after=len(step.before), skipped=skipped)


def rests(part: Slice, data: bytes) -> list[Slice]:
    """What is left to be done of a slice, in the order of time, from what was made of it."""
    rest = _table(data)['rest']
    if not rest:
        return []
    left = replace(part, start=rest['start'], after=rest['after'], skipped=tuple(rest['skipped']))
    if left.after or left.skipped or left.stop - left.start < PARTS:
        return [left]
    edges = [left.start + (left.stop - left.start) * k // PARTS for k in range(PARTS + 1)]
    return [replace(left, start=first, stop=last) for first, last in pairwise(edges)]


@cache
def _extractor(parameters: Parameters) -> LineFeatureExtractor:
    """One extractor a worker, which is one thread: its memory is kept from slice to slice."""
    return LineFeatureExtractor(parameters)


@cache
def _warm_up(parameters: Parameters, kind: np.dtype[Any]) -> None:
    """Load the kernels for a type of pixels, once a worker: that is no part of what a frame takes."""
    _extractor(parameters).warm_up(kind)


def _compare(reader: Reader, part: Slice, frames: list[Frame], found: list[NDArray[np.void] | None]) -> None:
    """Fill in how the segments of frames agree with the true ones of the same topic and stamp."""
    wanted = {f'{topic}/{TRUTH}' for topic in part.topics}
    connections = [connection for connection in reader.connections if connection.topic in wanted]
    last = max(frame.stamp for frame in frames)
    truths = {}
    for connection, stamp, data in reader.messages(connections, part.start, last + 1) if connections else ():
        with contextlib.suppress(ValueError):  # what is no truth is none to compare with
            truth = segments_of(deserialize(part.path, data, connection.msgtype))
            truths[connection.topic.removesuffix(f'/{TRUTH}'), stamp] = truth
    for frame, segments in zip(frames, found, strict=True):
        if segments is not None and (frame.topic, frame.stamp) in truths:
            frame.agreement = _agreement(segments, truths[frame.topic, frame.stamp])


def _process(
    frame: Frame, msgtype: str, data: bytes, path: Path, job: Job, extractor: LineFeatureExtractor,
) -> NDArray[np.void] | None:
    """Fill in what becomes of a frame, and return its segments; what is wrong with it is its error."""
    try:
        message = deserialize(path, data, msgtype)
        frame.header_stamp = message.header.stamp.sec * 10**9 + message.header.stamp.nanosec
        image = DECODERS[msgtype](message)
        usable = usable_pixels(image, job.mask)
        _warm_up(job.parameters, image.dtype)
        begin = time.perf_counter()
        segments = extractor.extract(image, usable)
        frame.seconds = time.perf_counter() - begin
    except (cv2.error, MemoryError, TypeError, ValueError) as error:
        frame.error = ' '.join(str(error).split()) or type(error).__name__
        return None
    frame.segments = len(segments)
    frame.orientations = _orientations(segments)
    header = _header(message.header)
    if job.csv:
        frame.messages[CSV] = segments_as_text(segments)
    try:
        for name in job.outputs:
            made = _message(name, image, segments, header, job)
            frame.messages[name] = bytes(typestore(ros1=False).serialize_cdr(made, OUTPUTS[name]))
    except (cv2.error, MemoryError, ValueError) as error:  # an overlay that cannot be
        frame.error = ' '.join(str(error).split())
    return segments


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
    bands = np.minimum((segments['theta'] * (BANDS / np.pi) + BANDS / 2).astype(np.intp), BANDS - 1)
    lengths: list[float] = np.bincount(bands, segments['length'], BANDS).round(1).tolist()
    return lengths


def _agreement(segments: NDArray[np.void], truth: NDArray[np.void]) -> list[float]:
    """Size 0 marks true segments that are too weak to be asked for."""
    ends, weak = end_points(truth), truth['size'] == 0
    found = compare(end_points(segments), ends[~weak], ends[weak])
    return [found.precision, found.recall, found.angle, found.offset]


def pack(frames: list[Frame], rest: Slice | None = None) -> bytes:
    """Frames in one piece: the length of a table of contents, the table as JSON, and the messages one by one.

    Args:
        frames: They.
        rest: What is left to be done.
    """
    entries: list[dict[str, Any]] = []
    blobs: list[bytes] = []
    for frame in frames:
        entry = dict(vars(frame))
        entry['messages'] = {name: len(data) for name, data in frame.messages.items()}
        entries.append(entry)
        blobs += frame.messages.values()
    left = rest and {'start': rest.start, 'after': rest.after, 'skipped': rest.skipped}
    table = json.dumps({'frames': entries, 'rest': left}).encode()
    return b''.join([PREFIX.pack(len(table)), table, *blobs])


def unpack(data: bytes) -> list[Frame]:
    """The frames in a piece that :func:`pack` made."""
    place = PREFIX.size + PREFIX.unpack_from(data)[0]
    frames = []
    for entry in _table(data)['frames']:
        sizes, entry['messages'] = entry['messages'], {}
        for name, size in sizes.items():
            entry['messages'][name] = data[place:place + size]
            place += size
        frames.append(Frame(**entry))
    return frames


def _table(data: bytes) -> dict[str, Any]:
    table: dict[str, Any] = json.loads(data[PREFIX.size:PREFIX.size + PREFIX.unpack_from(data)[0]])
    return table
