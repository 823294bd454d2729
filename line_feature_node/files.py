"""The offline run over image files: each gives an overlay picture and its segments as a table."""

import csv
import os
import threading
from collections.abc import Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from line_feature_node.core import SEGMENT_DTYPE, LineFeatureExtractor, Parameters
from line_feature_node.figures import sheet, stage_pictures
from line_feature_node.images import decode, displayable, range_hint
from line_feature_node.overlay import draw_overlay

#: Files that are taken for images by their name, so that broken ones are reported.
SUFFIXES = {'.avif', '.bmp', '.exr', '.gif', '.hdr', '.jp2', '.jpeg', '.jpg', '.pbm', '.pgm', '.png', '.pnm', '.ppm',
            '.tif', '.tiff', '.webp'}
#: The variable of the environment with the folders, as in PATH, that files which parameters name must be in; where it
#: is not set, or empty, they may be anywhere.
FOLDERS = 'LINE_FEATURE_FOLDERS'
#: No image file is larger.
MOST_BYTES = 2**30
#: How the name of an overlay ends.
OVERLAY = '-overlay.png'


@dataclass(frozen=True)
class Outcome:
    """What became of one file.

    Attributes:
        path: The file.
        error: One sentence on what went wrong; '' when nothing did.
        width, height: Size of the picture.
        segments: SEGMENT_DTYPE.
        unlinked: Number of segments before linking or refinement.
        times: Seconds of each step.
        overlay, table: The files that were written.
        hint: One sentence on why there may be no segments; '' where there are.
    """

    path: Path
    error: str = ''
    width: int = 0
    height: int = 0
    segments: NDArray[np.void] | None = None
    unlinked: int = 0
    times: dict[str, float] = field(default_factory=dict)
    overlay: Path | None = None
    table: Path | None = None
    hint: str = ''


def find_images(paths: Iterable[Path]) -> list[Path]:
    """The files themselves, and of folders those files in it that are images by name or content.

    What an earlier run wrote is left out; a folder without images stands for itself, to be reported as such.
    """
    found = []
    for path in paths:
        inside = []
        if os.path.isdir(path):
            inside = sorted(file for file in path.iterdir() if _is_image(file) and not file.name.endswith(OVERLAY))
        found += inside or [path]
    return found


def _is_image(file: Path) -> bool:
    return file.is_file() and (file.suffix.lower() in SUFFIXES or cv2.haveImageReader(str(file)))


def process(
    paths: list[Path], out: Path, parameters: Parameters, *, stages: bool = False, workers: int | None = None,
) -> Iterator[Outcome]:
    """Extract the segments of files, as many at a time as there are processors; outcomes come in the files' order.

    Args:
        paths: The files.
        out: Folder for the results, made if need be.
        parameters: Of the extraction.
        stages: Whether to write a picture of each step, and all of them on one sheet.
        workers: Files at a time; None for the number of processors.

    Raises:
        OSError: The folder cannot be made.
    """
    out.mkdir(parents=True, exist_ok=True)
    of_thread = threading.local()

    def work(path: Path, name: str) -> Outcome:
        if not hasattr(of_thread, 'extractor'):
            of_thread.extractor = LineFeatureExtractor(parameters)
        return _process(path, out / name, of_thread.extractor, stages=stages)

    with ThreadPoolExecutor(workers or os.cpu_count()) as executor:
        yield from executor.map(work, paths, unique_names(path.stem for path in paths))


def unique_names(names: Iterable[str]) -> list[str]:
    """A name for the results of each; its own, numbered where that is taken."""
    unique: list[str] = []
    taken: set[str] = set()
    for own in names:
        name, number = own, 1
        while name in taken:
            number += 1
            name = f'{own}-{number}'
        taken.add(name)
        unique.append(name)
    return unique


def _process(path: Path, target: Path, extractor: LineFeatureExtractor, *, stages: bool) -> Outcome:
    """Extract and write; the first frame twice, or its time would be that of compiling and of new memory."""
    try:
        image = _read(path)
        if not any(extractor.times.values()):
            extractor.extract(image)
        segments = extractor.extract(image)
    except OSError as error:
        return Outcome(path, error=error.strerror or str(error))
    except (TypeError, ValueError) as error:
        return Outcome(path, error=str(error))
    outcome = Outcome(
        path, width=image.shape[1], height=image.shape[0], segments=segments, unlinked=extractor.unlinked,
        times=dict(extractor.times), overlay=target.with_name(target.name + OVERLAY),
        table=target.with_name(f'{target.name}-segments.csv'),
        hint='' if len(segments) else range_hint(image, extractor.parameters))
    try:
        _write(outcome, image, extractor)
        if stages:
            _write_stages(image, target, extractor)
    except OSError as error:
        return Outcome(path, error=f'cannot write {error.filename}: {error.strerror}')
    return outcome


def _read(path: Path) -> NDArray[Any]:
    """An image file as an array; OSError or ValueError where that cannot be."""
    if os.path.isdir(path):
        raise ValueError('no image files in this folder')
    return decode(_content(path))


def _content(path: Path) -> bytes:
    """The bytes of a file; OSError or ValueError where that cannot be, as of a device, which may have no end."""
    if os.path.exists(path) and not os.path.isfile(path):
        raise ValueError('not a regular file')
    size = path.stat().st_size
    if size > MOST_BYTES:
        raise ValueError(f'{size} bytes: expected {MOST_BYTES} at most')
    return path.read_bytes()


def _write(outcome: Outcome, image: NDArray[Any], extractor: LineFeatureExtractor) -> None:
    assert outcome.overlay is not None
    assert outcome.table is not None
    assert outcome.segments is not None
    picture = displayable(image, extractor.parameters)
    write_picture(outcome.overlay, draw_overlay(picture, outcome.segments, f'{len(outcome.segments)} segments'))
    _write_table(outcome.table, outcome.segments)


def _write_stages(image: NDArray[Any], target: Path, extractor: LineFeatureExtractor) -> None:
    stages = extractor.stages(image)
    pictures = stage_pictures(displayable(stages.grey, extractor.parameters), stages)
    for number, (name, picture) in enumerate(pictures.items()):
        write_picture(target.with_name(f'{target.name}-{number}-{name}.png'), picture)
    write_picture(target.with_name(f'{target.name}-stages.png'), sheet(pictures, columns=4))


def read_mask(path: Path) -> NDArray[np.uint8]:
    """A mask for images, H×W: 0 where the picture in a file is black.

    Raises:
        ValueError: It cannot be read, is no picture, or is where the operator allows none.
    """
    try:
        mask = decode(_content(_allowed(path)), grey=True)
    except OSError as error:
        raise ValueError(f'mask_file {path}: {error.strerror}') from None
    except ValueError as error:
        raise ValueError(f'mask_file {path}: {error}') from None
    return np.where(mask != 0, np.uint8(255), np.uint8(0))


def _allowed(path: Path) -> Path:
    """The place that a path leads to, links followed.

    Raises:
        ValueError: It is in none of FOLDERS.
    """
    place = Path(os.path.realpath(path))
    folders = [folder for folder in os.environ.get(FOLDERS, '').split(os.pathsep) if folder]
    if folders and not any(place.is_relative_to(os.path.realpath(folder)) for folder in folders):
        raise ValueError(f'is {place}, and {FOLDERS} allows files in {", ".join(folders)} only')
    return place


def write_picture(path: Path, picture: NDArray[np.uint8]) -> None:
    """Write a BGR picture as a PNG; OSError where that cannot be."""
    path.write_bytes(cv2.imencode('.png', picture)[1].tobytes())


def _write_table(path: Path, segments: NDArray[np.void]) -> None:
    """One row a segment, a column for each field; nine digits give every float32 back exactly."""
    with path.open('w', newline='') as file:
        writer = csv.writer(file)
        writer.writerow(SEGMENT_DTYPE.names or ())
        writer.writerows([f'{value:.9g}' for value in segment] for segment in segments.tolist())
