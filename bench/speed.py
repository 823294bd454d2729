"""Time the default, step by step, and the paper's profile, beside OpenCV's Canny, LSD and EdgeDrawing (if installed).

    python bench/speed.py [PHOTO ...] [--reps 15] [--results FOLDER]

One thread, all contestants in turn on the same picture in one run; of each picture the least processor time counts, of
the pictures the median. Milliseconds differ between machines and hours: quote the ratios. Without photographs rendered
corridors stand in for them, which have fewer edges than most. Then come contents that make some detectors slow, beside
the median photograph of their size, and several threads on one frame beside one, by the wall clock. With a folder for
results, two curves are measured and drawn as well (matplotlib): time by pixels, and by edge pixels at one size.
"""

import argparse
import json
import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from matplotlib.figure import Figure

from line_feature_node.core import STEPS, LineFeatureExtractor, Parameters
from line_feature_node.images import decode
from line_feature_node.scenes import Camera, corridor

Contestant = Callable[[Any], Any]
SIZES = ((640, 480), (1280, 720), (1920, 1080))
#: Sizes of the curve by pixels.
WIDTHS = (160, 320, 640, 960, 1280, 1920, 2560, 3840)
#: How many rectangles the pictures of the curve by edge pixels have.
DENSITIES = (0, 10, 30, 60, 120, 250, 500, 1000, 2000)
#: Sizes of the contents that may be slow.
CONTENT_SIZES = ((640, 480), (7680, 4320))
PAPER = 'paper profile'
CANNY = 'OpenCV Canny(50, 150)'


def pictures(paths: list[Path]) -> list[Any]:
    """The photographs in grey, or rendered ones."""
    if not paths:
        return [cv2.cvtColor(corridor(Camera(x=x), width=1920, height=1080, seed=k).image, cv2.COLOR_BGR2GRAY)
                for k, x in enumerate((2.0, 6.0, 10.0))]
    try:
        images = [decode(path.read_bytes()) for path in paths]
    except (OSError, ValueError) as error:
        raise SystemExit(f'not all of the photographs can be read: {error}') from None
    return [cv2.cvtColor(image, cv2.COLOR_BGR2GRAY) if image.ndim == 3 else image for image in images]


def fitted(image: Any, width: int, height: int) -> Any:
    """The middle of a picture, scaled to a size."""
    scale = max(width / image.shape[1], height / image.shape[0])
    inner_width, inner_height = min(image.shape[1], round(width / scale)), min(image.shape[0], round(height / scale))
    x, y = (image.shape[1] - inner_width) // 2, (image.shape[0] - inner_height) // 2
    inner = image[y:y + inner_height, x:x + inner_width]
    return cv2.resize(inner, (width, height), interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_CUBIC)


def peers() -> dict[str, Contestant]:
    """What is installed of OpenCV's."""
    found: dict[str, Contestant] = {
        CANNY: lambda image: cv2.Canny(image, 50, 150), 'OpenCV LSD': cv2.createLineSegmentDetector().detect}
    if hasattr(cv2, 'ximgproc'):
        drawing = cv2.ximgproc.createEdgeDrawing()

        def edge_drawing(image: Any) -> Any:
            drawing.detectEdges(image)
            return drawing.detectLines()

        found['OpenCV EdgeDrawing'] = edge_drawing
    return found


def measure(images: list[Any], reps: int) -> dict[str, float]:
    """Median over the pictures of the best milliseconds of each step, of the whole, and of the peers."""
    extractor = LineFeatureExtractor()
    others = {PAPER: LineFeatureExtractor(Parameters.paper()).extract, **peers()}
    best: dict[str, list[float]] = {name: [] for name in (*STEPS, 'all steps', *others)}
    for image in images:
        for detect in (extractor.extract, *others.values()):
            detect(image)
        times: dict[str, list[float]] = {name: [] for name in best}
        for _ in range(reps):
            start = time.process_time()
            extractor.extract(image)
            times['all steps'].append(time.process_time() - start)
            for step in STEPS:
                times[step].append(extractor.times[step])
            for name, detect in others.items():
                start = time.process_time()
                detect(image)
                times[name].append(time.process_time() - start)
        for name, values in times.items():
            best[name].append(min(values) * 1e3)
    return {name: float(np.median(values)) for name, values in best.items()}


def best_of(detect: Contestant, image: Any, reps: int) -> float:
    """The best milliseconds of a contestant on a picture."""
    detect(image)
    times = []
    for _ in range(reps):
        start = time.process_time()
        detect(image)
        times.append(time.process_time() - start)
    return min(times) * 1e3


def curve_by_pixels(images: list[Any], reps: int) -> dict[str, list[float]]:
    """Milliseconds of the whole and of Canny for sizes of 4:3, the median over the pictures."""
    extractor = LineFeatureExtractor()
    rows: dict[str, list[float]] = {'pixels': [], 'all steps': [], CANNY: []}
    for width in WIDTHS:
        sized = [fitted(image, width, width * 3 // 4) for image in images]
        rows['pixels'].append(float(sized[0].size))
        rows['all steps'].append(float(np.median([best_of(extractor.extract, image, reps) for image in sized])))
        rows[CANNY].append(float(np.median([best_of(peers()[CANNY], image, reps) for image in sized])))
    return rows


def curve_by_edges(reps: int) -> dict[str, list[float]]:
    """Milliseconds for pictures of 640×480 with more and more rectangles, and how many edge pixels they have."""
    extractor = LineFeatureExtractor()
    rng = np.random.default_rng(0)
    image = np.full((480, 640), 128, np.uint8)
    rows: dict[str, list[float]] = {'edge pixels': [], 'all steps': []}
    drawn = 0
    for density in DENSITIES:
        for _ in range(density - drawn):
            box = ((float(rng.uniform(0, 640)), float(rng.uniform(0, 480))),
                   (float(rng.uniform(10, 60)), float(rng.uniform(10, 60))), float(rng.uniform(0, 90)))
            cv2.fillPoly(image, [cv2.boxPoints(box).astype(np.int32)], int(rng.integers(0, 256)), cv2.LINE_AA)
        drawn = density
        rows['edge pixels'].append(float(np.count_nonzero(extractor.stages(image).edges)))
        rows['all steps'].append(best_of(extractor.extract, image, reps))
    return rows


def contents(images: list[Any], width: int, height: int) -> dict[str, Any]:
    """Pictures of a size that are slow with some detectors; and one that is full of small photographs."""
    rng = np.random.default_rng(0)
    rows, columns = np.indices((height, width), sparse=True)
    lines, text = np.zeros((2, height, width), np.uint8)
    for x in range(8, width, 160):
        cv2.line(lines, (x, 0), (width - x, height - 1), 255)
    for y in range(10, height, 12):
        cv2.putText(text, 'Quick brown foxes jump over lazy dogs. ' * (width // 200 + 1), (2, y),
                    cv2.FONT_HERSHEY_PLAIN, 0.8, 255)
    small = np.concatenate([fitted(image, 640, 480) for image in images], 1)
    times = -(-height // small.shape[0]), -(-width // small.shape[1])
    found = {'photographs side by side': np.ascontiguousarray(np.tile(small, times)[:height, :width]),
             'black': np.zeros((height, width), np.uint8), 'bright lines on black': lines, 'text': text,
             'checkerboard of 1 px': (255 * ((rows + columns) % 2)).astype(np.uint8),
             'checkerboard of 4 px': (255 * ((rows // 4 + columns // 4) % 2)).astype(np.uint8),
             'stripes of 3 px': np.ascontiguousarray(
                 np.broadcast_to(255 * (columns // 3 % 2), (height, width)), np.uint8),
             'black and white at random': (255 * rng.integers(0, 2, (height, width), np.uint8))}
    noise = rng.standard_normal((height, width), np.float32)
    return found | {f'noise of {sigma} grey levels': np.clip(noise * sigma + 128, 0, 255).astype(np.uint8)
                    for sigma in (1, 3, 10, 30, 100)}


def measure_contents(images: list[Any], reps: int) -> dict[str, dict[str, float]]:
    """The best milliseconds of the default for each content, by size, and for the photographs their median."""
    extractor = LineFeatureExtractor()
    result = {}
    for width, height in CONTENT_SIZES:
        few = max(2, min(reps, reps * 640 * 480 // (width * height)))
        photographs = [best_of(extractor.extract, fitted(image, width, height), few) for image in images]
        result[f'{width}×{height}'] = {'photograph': float(np.median(photographs))} | {
            name: best_of(extractor.extract, image, few) for name, image in contents(images, width, height).items()}
    return result


def measure_threads(images: list[Any], reps: int) -> dict[str, dict[str, float]]:
    """Milliseconds by the wall clock with one thread and more on a frame, by size: medians over all frames."""
    counts = [count for count in (1, 2, 4, 8) if count <= len(os.sched_getaffinity(0))]
    extractors = {count: LineFeatureExtractor(Parameters(threads=count)) for count in counts}
    result = {}
    for width, height in SIZES:
        times: dict[int, list[float]] = {count: [] for count in counts}
        for image in images:
            sized = fitted(image, width, height)
            for extractor in extractors.values():
                extractor.extract(sized)
            for _ in range(reps):
                for count, extractor in extractors.items():
                    start = time.perf_counter()
                    extractor.extract(sized)
                    times[count].append(time.perf_counter() - start)
        result[f'{width}×{height}'] = {f'{count} threads': float(np.median(values)) * 1e3
                                       for count, values in times.items()}
    return result


def draw_curves(curves: dict[str, dict[str, list[float]]], path: Path) -> None:
    """Draw both curves side by side, each with the straight line that fits the whole best."""
    figure = Figure((11, 4.2), layout='constrained')
    for axes, (name, rows) in zip(figure.subplots(1, 2), curves.items(), strict=True):
        x = np.array(rows[name])
        for label, values in rows.items():
            if label != name:
                axes.plot(x, values, 'o-', label=label)
        slope, start = np.polyfit(x, rows['all steps'], 1)
        axes.plot(x, slope * x + start, 'k:', label=f'{slope * 1e6:.1f} ns each')
        axes.set(xlabel=name, ylabel='ms', title=f'time by {name}')
        axes.legend()
    figure.savefig(path, dpi=110)


def print_table(result: dict[str, dict[str, float]], title: str, unit: str) -> None:
    """A row for each contestant, a column for each size; in parentheses the ratio to one of them."""
    print(title)
    print(f'{"":28}' + ''.join(f'{size:>20}' for size in result))
    for name in next(iter(result.values())):
        cells = [f'{row[name]:.3f} ({row[name] / row[unit]:.2f})' for row in result.values()]
        print(f'{name:28}' + ''.join(f'{cell:>20}' for cell in cells))


def print_ratios(result: dict[str, dict[str, float]]) -> None:
    """What of the peers' times ours are."""
    for ours in ('all steps', PAPER):
        for name in peers():
            ratios = [f'{row[ours] / row[name]:.3f}' for row in result.values()]
            print(f'{f"{ours} to {name}":40}' + ''.join(f'{ratio:>12}' for ratio in ratios))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('photos', nargs='*', type=Path)
    parser.add_argument('--reps', type=int, default=15)
    parser.add_argument('--results', type=Path)
    options = parser.parse_args()
    cv2.setNumThreads(1)
    images = pictures(options.photos)
    threads = measure_threads(images, options.reps)
    os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
    result = {f'{width}×{height}': measure([fitted(image, width, height) for image in images], options.reps)
              for width, height in SIZES}
    kind = 'photographs' if options.photos else 'rendered pictures'
    print_table(result, f'{len(images)} {kind}, one thread, ms (ratio to Canny)', CANNY)
    print_ratios(result)
    slow = measure_contents(images, options.reps)
    print_table(slow, '\ncontents, one thread, ms (ratio to a photograph)', 'photograph')
    print_table(threads, '\nthreads on one frame, ms by the wall clock (ratio to one)', '1 threads')
    if options.results:
        curves = {'pixels': curve_by_pixels(images, options.reps), 'edge pixels': curve_by_edges(options.reps)}
        options.results.mkdir(parents=True, exist_ok=True)
        (options.results / 'speed.json').write_text(json.dumps(
            {'sizes': result, 'contents': slow, 'threads': threads, 'curves': curves}, indent=1))
        draw_curves(curves, options.results / 'speed.png')
        print(f'curves: {options.results / "speed.png"}')


if __name__ == '__main__':
    main()
