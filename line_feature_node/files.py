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
from line_feature_node.core.edges import intensity_map
from line_feature_node.figures import sheet, stage_pictures
from line_feature_node.images import decode
from line_feature_node.overlay import draw_overlay


@dataclass(frozen=True)
class Outcome:
    """What became of one file.

    Attributes:
        path: The file.
        error: One sentence on what went wrong; '' when nothing did.
        width, height: Size of the picture.
        segments: SEGMENT_DTYPE.
        unlinked: Number of segments before linking.
        times: Seconds of each step.
        overlay, table: The files that were written.
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


def find_images(paths: Iterable[Path]) -> list[Path]:
    """The files themselves, and of folders those files in it that OpenCV can read."""
    found = []
    for path in paths:
        if path.is_dir():
            found += sorted(file for file in path.iterdir() if file.is_file() and cv2.haveImageReader(str(file)))
        else:
            found.append(path)
    return found


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
            # The first frame is the first to touch the extractor's memory: that is not the time to report.
            _process(path, out / name, of_thread.extractor)
        outcome = _process(path, out / name, of_thread.extractor)
        if stages and not outcome.error:
            _write_stages(path, out / name, of_thread.extractor)
        return outcome

    # Compiled once, before threads compete for it.
    LineFeatureExtractor(parameters).warm_up()
    with ThreadPoolExecutor(workers or os.cpu_count()) as executor:
        yield from executor.map(work, paths, _names(paths))


def _names(paths: list[Path]) -> list[str]:
    """A name for the results of each file: its own without ending, numbered where that is taken."""
    names: list[str] = []
    taken: set[str] = set()
    for path in paths:
        name, number = path.stem, 1
        while name in taken:
            number += 1
            name = f'{path.stem}-{number}'
        taken.add(name)
        names.append(name)
    return names


def _process(path: Path, target: Path, extractor: LineFeatureExtractor) -> Outcome:
    try:
        image = decode(path.read_bytes())
        segments = extractor.extract(image)
        times = dict(extractor.times)
        caption = f'{len(segments)} segments, {sum(times.values()) * 1e3:.1f} ms'
        overlay, table = target.with_name(f'{target.name}-overlay.png'), target.with_name(f'{target.name}-segments.csv')
        write_picture(overlay, draw_overlay(displayable(image, extractor.parameters), segments, caption))
        _write_table(table, segments)
    except OSError as error:
        return Outcome(path, error=error.strerror or str(error))
    except (TypeError, ValueError) as error:
        return Outcome(path, error=str(error))
    return Outcome(path, width=image.shape[1], height=image.shape[0], segments=segments, unlinked=extractor.unlinked,
                   times=times, overlay=overlay, table=table)


def _write_stages(path: Path, target: Path, extractor: LineFeatureExtractor) -> None:
    image = decode(path.read_bytes())
    pictures = stage_pictures(displayable(image, extractor.parameters), extractor.stages(image))
    for number, (name, picture) in enumerate(pictures.items()):
        write_picture(target.with_name(f'{target.name}-{number}-{name}.png'), picture)
    write_picture(target.with_name(f'{target.name}-stages.png'), sheet(pictures, columns=4))


def displayable(image: NDArray[Any], parameters: Parameters) -> NDArray[np.uint8]:
    """The image with its range of intensities brought to bytes."""
    if image.dtype == np.uint8:
        return image
    scale, offset = intensity_map(image.dtype, parameters)
    return np.clip(scale * image + offset, 0, 255).astype(np.uint8)


def write_picture(path: Path, picture: NDArray[np.uint8]) -> None:
    """Write a BGR picture as a PNG; OSError where that cannot be."""
    path.write_bytes(cv2.imencode('.png', picture)[1].tobytes())


def _write_table(path: Path, segments: NDArray[np.void]) -> None:
    """One row a segment, a column for each field; nine digits give every float32 back exactly."""
    with path.open('w', newline='') as file:
        writer = csv.writer(file)
        writer.writerow(SEGMENT_DTYPE.names or ())
        writer.writerows([f'{value:.9g}' for value in segment] for segment in segments.tolist())
