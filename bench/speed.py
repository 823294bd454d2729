"""Time the paper profile, step by step, beside OpenCV's Canny and LSD.

    python bench/speed.py [PHOTO ...] [--reps 15] [--json FILE]

One thread, all contestants in turn on the same picture in one run; of each picture the best time counts, of the
pictures the median. Milliseconds differ between machines and hours: quote the ratios. Without photographs a rendered
corridor stands in for them, which has fewer edges than most.
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

from line_feature_node.core import STEPS, LineFeatureExtractor, Parameters
from line_feature_node.images import decode
from line_feature_node.scenes import Camera, corridor

SIZES = ((640, 480), (1280, 720), (1920, 1080))
PARAMETERS = {'T1': 8.0, 'T2': 3.0, 'alpha': 1.0}


def pictures(paths: list[Path]) -> list[Any]:
    """The photographs in grey, or rendered ones."""
    if not paths:
        return [cv2.cvtColor(corridor(Camera(x=x), width=1920, height=1080, seed=k).image, cv2.COLOR_BGR2GRAY)
                for k, x in enumerate((2.0, 6.0, 10.0))]
    images = [decode(path.read_bytes()) for path in paths]
    return [cv2.cvtColor(image, cv2.COLOR_BGR2GRAY) if image.ndim == 3 else image for image in images]


def fitted(image: Any, width: int, height: int) -> Any:
    """The middle of a picture, scaled to a size."""
    scale = max(width / image.shape[1], height / image.shape[0])
    inner_width, inner_height = min(image.shape[1], round(width / scale)), min(image.shape[0], round(height / scale))
    x, y = (image.shape[1] - inner_width) // 2, (image.shape[0] - inner_height) // 2
    inner = image[y:y + inner_height, x:x + inner_width]
    return cv2.resize(inner, (width, height), interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_CUBIC)


def measure(images: list[Any], reps: int) -> dict[str, float]:
    """Median over the pictures of the best milliseconds of each step, of the whole, and of OpenCV's."""
    extractor = LineFeatureExtractor(Parameters.profile('paper', **PARAMETERS))
    lsd = cv2.createLineSegmentDetector()
    others: dict[str, Callable[[Any], Any]] = {
        'OpenCV Canny(50, 150)': lambda image: cv2.Canny(image, 50, 150),
        'OpenCV LSD': lsd.detect,
    }
    best: dict[str, list[float]] = {name: [] for name in (*STEPS, 'all steps', *others)}
    for image in images:
        extractor.extract(image)
        times: dict[str, list[float]] = {name: [] for name in best}
        for _ in range(reps):
            start = time.perf_counter()
            extractor.extract(image)
            times['all steps'].append(time.perf_counter() - start)
            for step in STEPS:
                times[step].append(extractor.times[step])
            for name, detect in others.items():
                start = time.perf_counter()
                detect(image)
                times[name].append(time.perf_counter() - start)
        for name, values in times.items():
            best[name].append(min(values) * 1e3)
    return {name: float(np.median(values)) for name, values in best.items()}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('photos', nargs='*', type=Path)
    parser.add_argument('--reps', type=int, default=15)
    parser.add_argument('--json', type=Path)
    options = parser.parse_args()
    cv2.setNumThreads(1)
    if hasattr(os, 'sched_setaffinity'):
        os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
    images = pictures(options.photos)
    result = {f'{width}×{height}': measure([fitted(image, width, height) for image in images], options.reps)
              for width, height in SIZES}
    print(f'{len(images)} {"photographs" if options.photos else "rendered pictures"}, one thread, ms (ratio to Canny)')
    print(f'{"":24}' + ''.join(f'{size:>18}' for size in result))
    for name in next(iter(result.values())):
        cells = [f'{row[name]:.3f} ({row[name] / row["OpenCV Canny(50, 150)"]:.2f})' for row in result.values()]
        print(f'{name:24}' + ''.join(f'{cell:>18}' for cell in cells))
    ratios = [f'1/{row["OpenCV LSD"] / row["all steps"]:.1f}' for row in result.values()]
    print(f'{"all steps to LSD":24}' + ''.join(f'{ratio:>18}' for ratio in ratios))
    if options.json:
        options.json.write_text(json.dumps(result, indent=1))


if __name__ == '__main__':
    main()
