"""Measure what is found in pictures with noise, beside OpenCV's detectors: drawn polygons and labelled photographs.

    python bench/accuracy.py [--seed 0] [--scenes 20] [--york FOLDER] [--results FOLDER]

The scenes are polygons and bars of random greys on a ground that is lit unevenly, drawn eight times as large, made
smaller and blurred, with Gaussian noise of each sigma; another seed gives others. --york is a folder with images/*.jpg
and gt_csv/*.csv: x1,y1,x2,y2 a line, 0.7 pixels more than pixel centres are. Precision is the share of the length of
segments that lies on true ones, recall the share of the true length that is covered, F their harmonic mean; angle and
offset are medians over the segments that match (line_feature_node/truth.py has the tolerances). Each scene counts the
same. With a folder for results the table goes there as JSON, with plots of F by noise and of precision against recall:
of each detector the segments are kept from one length on after the other, as any of them could be asked to.
"""

import argparse
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from line_feature_node.core import LineFeatureExtractor, Parameters, end_points
from line_feature_node.truth import compare

Lines = NDArray[np.float64]
Detector = Callable[[NDArray[np.uint8]], Lines]
#: What is known of a picture: itself without noise, true segments, and those that are too weak to be asked for.
Scene = tuple[NDArray[np.float32], Lines, Lines]

WIDTH, HEIGHT = 640, 480
SIGMAS = (0, 5, 10, 20, 30)
#: Precision is drawn against recall for this noise, and for segments from these lengths on, in pixels.
CURVE_SIGMA, LENGTHS = 20, (0, 10, 15, 20, 30, 40, 60, 80, 120)
#: Edges are drawn so many times as large.
SUPERSAMPLING = 8
#: Steps of fewer grey levels are too weak to be asked for.
FAINT = 12.0
#: York Urban's labels are so many pixels more than pixel centres.
YORK_SHIFT = 0.7


def scene(seed: int) -> Scene:
    """Polygons and bars that do not touch, each of another grey."""
    rng = np.random.default_rng(seed)
    big = np.zeros((HEIGHT * SUPERSAMPLING, WIDTH * SUPERSAMPLING), np.float32)
    taken: list[tuple[float, float, float]] = []
    true: list[list[float]] = []
    weak: list[list[float]] = []
    for _ in range(400):
        radius = float(rng.uniform(15, 110))
        x, y = float(rng.uniform(radius, WIDTH - radius)), float(rng.uniform(radius, HEIGHT - radius))
        if any(np.hypot(x - other[0], y - other[1]) < radius + other[2] + 6 for other in taken):
            continue
        taken.append((x, y, radius))
        corners = np.array([x, y]) + shape(rng, radius)
        contrast = float(rng.uniform(8, 100) * rng.choice([-1, 1]))
        paint(big, (corners + 0.5) * SUPERSAMPLING - 0.5, contrast)
        for a, b in zip(corners, np.roll(corners, -1, 0), strict=True):
            (true if abs(contrast) >= FAINT and np.hypot(*(b - a)) >= 12 else weak).append([*a, *b])
    image = cv2.resize(big, (WIDTH, HEIGHT), interpolation=cv2.INTER_AREA)
    rows, columns = np.mgrid[:HEIGHT, :WIDTH].astype(np.float32)
    image = image + 128 + rng.uniform(-10, 10) * (columns / WIDTH - 0.5) + rng.uniform(-10, 10) * (rows / HEIGHT - 0.5)
    blurred = cv2.GaussianBlur(image, (0, 0), float(rng.uniform(0.4, 1.0)))
    return np.asarray(blurred, np.float32), np.array(true).reshape(-1, 4), np.array(weak).reshape(-1, 4)


def paint(big: NDArray[np.float32], corners: Lines, contrast: float) -> None:
    """Add a convex polygon, whose corners go round clockwise in the picture, to the pixels whose centres are in it."""
    (left, top), (right, bottom) = np.floor(corners.min(0)).astype(int), np.ceil(corners.max(0)).astype(int) + 1
    rows, columns = np.mgrid[top:bottom, left:right]
    inside = np.ones(rows.shape, bool)
    for a, b in zip(corners, np.roll(corners, -1, 0), strict=True):
        inside &= (b[0] - a[0]) * (rows - a[1]) - (b[1] - a[1]) * (columns - a[0]) >= 0
    big[top:bottom, left:right][inside] += contrast


def shape(rng: np.random.Generator, radius: float) -> Lines:
    """A bar or a convex polygon within a circle around the origin."""
    turn = rng.uniform(0, 2 * np.pi)
    if rng.random() < 0.5:
        half = np.arctan2(rng.uniform(3, 8), radius)
        angles = turn + np.array([half, np.pi - half, np.pi + half, -half])
    else:
        count = int(rng.integers(3, 7))
        angles = turn + (np.arange(count) + rng.uniform(-0.3, 0.3, count)) * 2 * np.pi / count
    return np.asarray(radius * np.stack([np.cos(angles), np.sin(angles)], -1))


def with_noise(image: NDArray[np.float32], sigma: float, seed: int) -> NDArray[np.uint8]:
    noise = np.random.default_rng([seed, int(sigma)]).normal(0, sigma, image.shape) if sigma else 0
    return np.clip(np.round(image + noise), 0, 255).astype(np.uint8)


def detectors() -> dict[str, Detector]:
    """Two profiles of this package, and what is installed of OpenCV's."""
    found: dict[str, Detector] = {}
    for name in ('default', 'paper'):
        extractor = LineFeatureExtractor(Parameters.profile(name))
        found[f'line_feature_node, {name}'] = lambda grey, extractor=extractor: end_points(extractor.extract(grey))
    lsd = cv2.createLineSegmentDetector(cv2.LSD_REFINE_STD)
    found['OpenCV LSD'] = lambda grey: as_lines(lsd.detect(grey)[0])
    if hasattr(cv2, 'ximgproc'):
        drawing = cv2.ximgproc.createEdgeDrawing()

        def edge_drawing(grey: NDArray[np.uint8]) -> Lines:
            drawing.detectEdges(grey)
            return as_lines(drawing.detectLines())

        found['OpenCV EdgeDrawing'] = edge_drawing
    return found


def as_lines(result: Any) -> Lines:
    return np.zeros((0, 4)) if result is None else np.asarray(result, float).reshape(-1, 4)


def york(folder: Path) -> list[Scene]:
    """Photographs with their labels; those shorter than 5 pixels are not asked for."""
    scenes = []
    for labels in sorted((folder / 'gt_csv').glob('*.csv')):
        grey = cv2.imread(str(folder / 'images' / f'{labels.stem}.jpg'), cv2.IMREAD_GRAYSCALE)
        lines = np.loadtxt(labels, delimiter=',', skiprows=1, ndmin=2) - YORK_SHIFT
        length = np.hypot(lines[:, 2] - lines[:, 0], lines[:, 3] - lines[:, 1])
        scenes.append((np.asarray(grey, np.float32), lines[length >= 5], lines[length < 5]))
    return scenes


def measure(detect: Detector, scenes: list[Scene], sigma: float) -> dict[str, float]:
    """F, precision, recall, angle (degrees) and offset (pixels) of a detector, means over the scenes."""
    agreements = [compare(detect(with_noise(image, sigma, number)), true, weak)
                  for number, (image, true, weak) in enumerate(scenes)]
    # Where nothing is found, nothing of it is false or true, and nothing is covered.
    figures = np.nan_to_num([[a.precision, a.recall] for a in agreements]).mean(0)
    angle, offset = np.nanmean([[a.angle, a.offset] for a in agreements], axis=0)
    return {'F': float(2 * figures.prod() / max(figures.sum(), 1e-9)), 'precision': float(figures[0]),
            'recall': float(figures[1]), 'angle': float(np.degrees(angle)), 'offset': float(offset)}


def false_segments(detect: Detector, count: int) -> float:
    """Segments a picture in pictures of noise alone."""
    ground = np.full((HEIGHT, WIDTH), 128, np.float32)
    found = [len(detect(with_noise(ground, sigma, 1000 + number)))
             for sigma in (10, 30, 50) for number in range(count)]
    return float(np.mean(found))


def curve(detect: Detector, scenes: list[Scene], sigma: float) -> list[tuple[float, float]]:
    """Recall and precision of the segments from each of LENGTHS on, means over the scenes; none where none has any."""
    pairs: list[list[tuple[float, float]]] = [[] for _ in LENGTHS]
    for number, (image, true, weak) in enumerate(scenes):
        found = detect(with_noise(image, sigma, number))
        length = np.hypot(found[:, 2] - found[:, 0], found[:, 3] - found[:, 1])
        for least, some in zip(LENGTHS, pairs, strict=True):
            agreement = compare(found[length >= least], true, weak)
            some.append((agreement.recall, agreement.precision))
    points = []
    for recalls, precisions in (np.transpose(some) for some in pairs):
        if not np.isnan(precisions).all():  # where nothing is found, nothing of it is true or false
            points.append((float(recalls.mean()), float(np.nanmean(precisions))))
    return points


def draw(table: dict[str, dict[str, dict[str, float]]], curves: dict[str, dict[str, Any]], path: Path) -> None:
    """F by noise, and precision against recall for each set of scenes."""
    figure = Figure((5.5 * (1 + len(curves)), 4.4), layout='constrained')
    first, *others = np.ravel(figure.subplots(1, 1 + len(curves)))
    for name, row in table.items():
        first.plot(SIGMAS, [row[str(sigma)]['F'] for sigma in SIGMAS], 'o-', label=name)
    first.set(xlabel='sigma of the noise, grey levels', ylabel='F', ylim=(0, 1), title='drawn scenes of 640×480')
    first.legend()
    for axes, (title, of_detectors) in zip(others, curves.items(), strict=True):
        for name, points in of_detectors.items():
            axes.plot(*np.transpose(points), 'o-', label=name)
        axes.set(xlabel='recall', ylabel='precision', xlim=(0, 1), ylim=(0, 1), title=title)
    figure.savefig(path, dpi=110)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--seed', type=int, default=0)
    parser.add_argument('--scenes', type=int, default=20)
    parser.add_argument('--york', type=Path, metavar='FOLDER')
    parser.add_argument('--results', type=Path, metavar='FOLDER')
    options = parser.parse_args()
    cv2.setNumThreads(1)
    drawn = [scene(options.seed * 1000 + number) for number in range(options.scenes)]
    labelled = york(options.york) if options.york else []
    columns = [*map(str, SIGMAS), *(['York Urban'] if labelled else []), 'false in noise']
    print(f'F (precision/recall), angle in degrees, offset in pixels; {len(drawn)} scenes of seed {options.seed}')
    print(f'| | {" | ".join(columns)} |\n|{"---|" * (len(columns) + 1)}')
    table = {}
    for name, detect in detectors().items():
        row = {str(sigma): measure(detect, drawn, sigma) for sigma in SIGMAS}
        if labelled:
            row['York Urban'] = measure(detect, labelled, 0)
        false = false_segments(detect, 5)
        cells = ['{F:.3f} ({precision:.2f}/{recall:.2f}) {angle:.3f} {offset:.3f}'.format(**values)
                 for values in row.values()]
        print(f'| {name} | {" | ".join(cells)} | {false:.1f} |', flush=True)
        table[name] = {**row, 'noise': {'false': false}}
    if options.results:
        sets = {f'drawn scenes, sigma {CURVE_SIGMA}, by least length': (drawn, CURVE_SIGMA),
                **({'York Urban, by least length': (labelled, 0)} if labelled else {})}
        curves = {title: {name: curve(detect, *scenes) for name, detect in detectors().items()}
                  for title, scenes in sets.items()}
        options.results.mkdir(parents=True, exist_ok=True)
        (options.results / 'accuracy.json').write_text(json.dumps({'table': table, 'curves': curves}, indent=1))
        draw(table, curves, options.results / 'accuracy.png')


if __name__ == '__main__':
    main()
