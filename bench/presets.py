"""Measure the presets of parameters beside the default: what they find, what they find besides, and how long they take.

    python bench/presets.py [--f1tenth FOLDER] [--tusimple FOLDER] [--york FOLDER] [--half report|choose|all] [--reps 7]
                            [--preset NAME --photos PHOTO ... [--overlays FOLDER]] [--picture FILE]

Without a folder of labelled photographs only rendered corridors are measured. What is printed is Markdown: the settings
of each preset, then the figures, one thread. The values of the presets were chosen on one half of each set (--half
choose: the first, third, ... frame, corridors of even layouts); what is reported is the other half.

    --f1tenth   images/*.png and polylines.json: for each file polylines [[x, y], ...] along lane marks and kerbs
    --tusimple  images/*.png and labels/*.json: lanes (x for each row, negative where there is none) and h_samples
    --york      images/*.jpg and gt_csv/*.csv: x1,y1,x2,y2 a line, 0.7 pixels more than pixel centres are
    --photos    photographs without labels: counts and times of --preset beside the default, and with --overlays drawn
    --picture   a rendered corridor with the segments of the default and of the preset side by side

How lanes are measured: labels run along the middle of a painted mark, or of a double one, and through the gaps of
dashes. So both borders of a mark must count as right, and no detector can cover a dashed line wholly. A point of a
label is covered when a segment passes beside it within 2 pixels and, in proportion to the depth below the top of the
labels, as much more as half a mark is wide: at the bottom row 4 % of the picture's width on f1tenth, whose camera is
just above a double line, 1.5 % on tusimple. Directions may differ by 7 degrees: labels are polygons, and the borders of
a mark converge. What of the segments lies on no label in this sense is the false length. It need not be wrong, cars and
arrows on the road are in the picture too; but a tracker has to get past it.
"""

import argparse
import csv
import itertools
import json
import os
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from line_feature_node.core import LineFeatureExtractor, Parameters, end_points
from line_feature_node.core.profiles import PROFILES
from line_feature_node.images import decode
from line_feature_node.overlay import draw_overlay
from line_feature_node.scenes import Camera, corridor
from line_feature_node.truth import compare

Lines = NDArray[np.floating]
#: Pixels between a label and a segment on it, everywhere.
NEAR = 2.0
#: Radians between a label and a segment on it.
ANGLE = np.radians(7)
#: Pixels between the points of a label, or of a segment, that are looked at.
STEP = 2.0
#: What York's coordinates exceed those of pixel centres by.
YORK_SHIFT = 0.7
#: Layouts of the rendered corridors of either half; each has cameras of its own.
LAYOUTS = {'choose': (100, 102, 104, 106), 'report': (101, 103, 105, 107)}
#: How many cameras see a layout.
CAMERAS = 4


@dataclass(frozen=True)
class Frame:
    """A picture with what is to be found in it.

    Attributes:
        image: What a camera gives.
        truth: N×4, lines to find; of lanes, the parts of the polylines that the labels are.
        weak: M×4, lines that count neither for nor against.
        mark: Half the width of a lane mark at the bottom row, as a share of the picture's width.
    """

    image: NDArray[Any]
    truth: Lines
    weak: Lines | None = None
    mark: float = 0.0


@dataclass(frozen=True)
class Score:
    """How one preset does on a frame: lengths in pixels.

    Attributes:
        found: Share of the true length that is covered.
        precision: Share of the segments' length that is right; NaN without segments.
        off: Length of the segments that is not.
        segments: How many there are.
        ms: The best time.
    """

    found: float
    precision: float
    off: float
    segments: int
    ms: float


Judge = Callable[[Lines, Frame], tuple[float, float, float]]


def read(path: Path) -> NDArray[Any]:
    try:
        return decode(path.read_bytes())
    except (OSError, ValueError) as error:
        raise SystemExit(f'{path}: {error}') from None


def half(names: list[Any], which: str) -> list[Any]:
    """Every second one, or all."""
    return {'choose': names[::2], 'report': names[1::2], 'all': names}[which]


def pieces(polyline: Any) -> Lines:
    """The parts of a polyline, N×4."""
    points = np.asarray(polyline, float).reshape(-1, 2)
    return np.hstack([points[:-1], points[1:]])


def stacked(parts: list[Lines]) -> Lines:
    return np.concatenate([np.empty((0, 4)), *parts])


def f1tenth(folder: Path, which: str) -> list[Frame]:
    """Frames of a small car's drive along lanes."""
    labels = json.loads((folder / 'polylines.json').read_text())
    names = half(sorted(labels, key=lambda name: (len(name), name)), which)
    return [Frame(read(folder / 'images' / name), stacked([pieces(line) for line in labels[name]]), mark=0.04)
            for name in names]


def tusimple(folder: Path, which: str) -> list[Frame]:
    """Frames of a highway."""
    frames = []
    for path in half(sorted((folder / 'labels').glob('*.json')), which):
        label = json.loads(path.read_text())
        lanes = [pieces([(x, y) for x, y in zip(lane, label['h_samples'], strict=True) if x >= 0])
                 for lane in label['lanes']]
        frames.append(Frame(read(folder / 'images' / f'{path.stem}.png'), stacked(lanes), mark=0.015))
    return frames


def york(folder: Path, which: str) -> list[Frame]:
    """Photographs of buildings and rooms with all their lines."""
    frames = []
    for path in half(sorted((folder / 'gt_csv').glob('*.csv')), which):
        with path.open(newline='') as file:
            rows = [[float(row[name]) for name in ('x1', 'y1', 'x2', 'y2')] for row in csv.DictReader(file)]
        frames.append(Frame(read(folder / 'images' / f'{path.stem}.jpg'), np.array(rows).reshape(-1, 4) - YORK_SHIFT))
    return frames


def cameras(layout: int) -> list[Camera]:
    """Where a robot may stand in a corridor, and how its camera may look."""
    rng = np.random.default_rng(layout)
    return [Camera(x=rng.uniform(1, 12), y=rng.uniform(-0.8, 0.8), z=rng.uniform(0.25, 1.6), yaw=rng.uniform(-0.3, 0.3),
                   pitch=rng.uniform(-0.1, 0.1), roll=rng.uniform(-0.03, 0.03)) for _ in range(CAMERAS)]


def corridors(which: str) -> list[Frame]:
    """Rendered corridors, each layout seen by its cameras."""
    layouts = [layout for name, some in LAYOUTS.items() if which in (name, 'all') for layout in some]
    scenes = [corridor(camera, seed=CAMERAS * layout + k, layout=layout)
              for layout in layouts for k, camera in enumerate(cameras(layout))]
    return [Frame(scene.image, scene.truth, scene.weak) for scene in scenes]


def lengths(lines: Lines) -> Lines:
    return np.hypot(lines[:, 2] - lines[:, 0], lines[:, 3] - lines[:, 1])


def directions(lines: Lines) -> Lines:
    """Unit vectors, N×2."""
    return np.asarray((lines[:, 2:] - lines[:, :2]) / np.maximum(lengths(lines), 1e-9)[:, None])


def points_on(lines: Lines) -> tuple[Lines, NDArray[np.intp], Lines]:
    """Points along lines: places (N×2), the line that each is on, and the length that it stands for."""
    counts = np.maximum(1, np.ceil(lengths(lines) / STEP)).astype(int)
    line = np.repeat(np.arange(len(lines)), counts)
    shares = (np.arange(len(line)) - np.repeat(np.cumsum(counts) - counts, counts) + 0.5) / counts[line]
    places = lines[line, :2] + shares[:, None] * (lines[line, 2:] - lines[line, :2])
    return places, line, (lengths(lines) / counts)[line]


def margins(places: Lines, frame: Frame) -> Lines:
    """How far from a label a segment on it may be, for places: as the docstring of the script says."""
    height, width = frame.image.shape[:2]
    top = frame.truth[:, 1::2].min(initial=height - 1)
    return np.asarray(NEAR + frame.mark * width * np.clip((places[:, 1] - top) / (height - top), 0, 1))


def on_lines(places: Lines, along: Lines, reach: Lines, lines: Lines) -> NDArray[np.bool_]:
    """Which places, with the direction there, have one of the lines beside them within reach and of that direction."""
    beside = np.zeros(len(places), bool)
    for unit, length, start in zip(directions(lines), lengths(lines), lines[:, :2], strict=True):
        away = places - start
        place = away @ unit
        across = np.abs(away[:, 1] * unit[0] - away[:, 0] * unit[1])
        turned = np.abs(along[:, 1] * unit[0] - along[:, 0] * unit[1]) <= np.sin(ANGLE)
        beside |= (across <= reach) & turned & (place >= -STEP) & (place <= length + STEP)
    return beside


def judge_lanes(segments: Lines, frame: Frame) -> tuple[float, float, float]:
    """Share of the labels that is covered, share of the segments on labels, and their length that is on none."""
    covered, right = length_on(frame.truth, segments, frame), length_on(segments, frame.truth, frame)
    total = float(lengths(segments).sum())
    return covered / max(lengths(frame.truth).sum(), 1e-9), right / total if total else float('nan'), total - right


def length_on(lines: Lines, others: Lines, frame: Frame) -> float:
    """Length of the lines that has one of the others beside it."""
    places, line, weight = points_on(lines)
    return float(weight[on_lines(places, directions(lines)[line], margins(places, frame), others)].sum())


def judge_lines(segments: Lines, frame: Frame) -> tuple[float, float, float]:
    """Recall and precision of `line_feature_node.truth`, and the length of the segments on no line, weak or not."""
    agreement = compare(segments, frame.truth, frame.weak)
    whole = compare(segments, stacked([frame.truth] if frame.weak is None else [frame.truth, frame.weak]))
    off = (1 - whole.precision) * lengths(segments).sum() if len(segments) else 0.0
    return agreement.recall, agreement.precision, off


def measure(frames: list[Frame], sets: dict[str, Parameters], judge: Judge, reps: int) -> dict[str, list[Score]]:
    """The scores of each set of parameters; they take turns on every frame."""
    extractors = {name: LineFeatureExtractor(parameters) for name, parameters in sets.items()}
    scores: dict[str, list[Score]] = {name: [] for name in sets}
    for frame in frames:
        times: dict[str, list[float]] = {name: [] for name in sets}
        for _, (name, extractor) in itertools.product(range(reps + 1), extractors.items()):
            start = time.perf_counter()
            extractor.extract(frame.image)
            times[name].append(time.perf_counter() - start)
        for name, extractor in extractors.items():
            ends = end_points(extractor.extract(frame.image)).astype(float)
            scores[name].append(Score(*judge(ends, frame), len(ends), min(times[name]) * 1e3))
    return scores


def mean_of(scores: list[Score], field: str) -> float:
    return float(np.nanmean([getattr(score, field) for score in scores]))


def rows(title: str, scores: dict[str, list[Score]]) -> list[list[str]]:
    """The lines of a table for one set of frames."""
    lines = []
    for name, some in scores.items():
        found, precision, off, count, ms = (
            mean_of(some, field) for field in ('found', 'precision', 'off', 'segments', 'ms'))
        balance = 2 * found * precision / max(found + precision, 1e-9)
        lines.append([title, name, f'{found:.3f}', f'{precision:.3f}', f'{balance:.3f}', f'{off:.0f}', f'{count:.0f}',
                      f'{ms:.2f}'])
    return lines


HEAD = ['data', 'parameters', 'covered', 'precision', 'F', 'false px a frame', 'segments', 'ms']


def table(head: list[str], lines: list[list[str]]) -> str:
    """A table in Markdown."""
    return '\n'.join(f'| {" | ".join(cells)} |' for cells in (head, ['---'] * len(head), *lines))


def settings(name: str) -> str:
    """What a profile changes, in Markdown."""
    lines = [[f'`{key}`', f'{list(value) if isinstance(value, tuple) else value}', reason]
             for key, (value, reason) in PROFILES[name].settings.items()]
    return f'{PROFILES[name].description}\n\n' + table(['setting', 'value', 'reason'], lines)


def photographs(preset: str, paths: list[Path], folder: Path | None, reps: int) -> str:
    """Counts of a preset and the default in photographs without labels; overlays, if there is a folder for them."""
    lines = []
    for path in paths:
        image = read(path)
        frame = Frame(image, np.empty((0, 4)))
        for name, (score,) in measure([frame], sets_for(preset), judge_nothing, reps).items():
            segments = LineFeatureExtractor(Parameters.profile(name.strip('`'))).extract(image)
            size = segments['length']
            lines.append([path.name, name, f'{len(segments)}', f'{size.sum():.0f}',
                          f'{np.median(size) if len(size) else 0:.0f}', f'{score.ms:.2f}'])
            if folder is not None:
                folder.mkdir(parents=True, exist_ok=True)
                cv2.imwrite(str(folder / f'{path.stem}-{name.strip("`")}.png'), draw_overlay(image, segments))
    return table(['picture', 'parameters', 'segments', 'px in all', 'median px', 'ms'], lines)


def judge_nothing(_segments: Lines, _frame: Frame) -> tuple[float, float, float]:
    """The judge of frames without labels."""
    return (float('nan'),) * 3


def sets_for(preset: str, roi: tuple[float, float, float, float] | None = None) -> dict[str, Parameters]:
    """What is compared, by its name in the tables: the default, the preset and, with a region, the preset with that."""
    sets = {f'`{name}`': Parameters.profile(name) for name in ('default', preset)}
    if roi is not None:
        sets[f'`{preset}`, `roi` {list(roi)}'] = replace(sets[f'`{preset}`'], roi=roi)
    return sets


def draw_picture(path: Path) -> None:
    """A rendered corridor with what the default and the preset find, side by side."""
    layout = LAYOUTS['report'][0]
    camera = Camera(x=3.0, y=-0.6, z=0.4, yaw=-0.1, pitch=0.0, roll=0.0)
    scene = corridor(camera, seed=layout, layout=layout)
    sides = [draw_overlay(scene.image, LineFeatureExtractor(parameters).extract(scene.image), name.strip('`'))
             for name, parameters in sets_for('corridor').items()]
    cv2.imwrite(str(path), np.hstack(sides), [cv2.IMWRITE_JPEG_QUALITY, 88])


@dataclass(frozen=True)
class Data:
    """A set of labelled frames.

    Attributes:
        read: What reads a half of it.
        preset: Which preset it is for.
        judge: How segments are held against its labels.
        roi: The region below the horizon, for a camera whose horizon is not where the preset has it.
    """

    read: Callable[[Path, str], list[Frame]]
    preset: str
    judge: Judge
    roi: tuple[float, float, float, float] | None = None


DATA = {
    'f1tenth': Data(f1tenth, 'lane_tracking', judge_lanes, (0.0, 0.1, 1.0, 0.9)),
    'tusimple': Data(tusimple, 'lane_tracking', judge_lanes),
    'york': Data(york, 'corridor', judge_lines),
}


def figures(folders: dict[str, Path | None], which: str, reps: int) -> list[list[str]]:
    """The lines of the table of all labelled data."""
    lines = []
    for name, data in DATA.items():
        folder = folders[name]
        if folder is None:
            print(f'{name}: skipped, no folder given (--{name})\n')
            continue
        frames = data.read(folder, which)
        scores = measure(frames, sets_for(data.preset, data.roi), data.judge, reps)
        lines += rows(f'{name}, {len(frames)} frames', scores)
    frames = corridors(which)
    return lines + rows(f'rendered corridors, {len(frames)} frames',
                        measure(frames, sets_for('corridor'), judge_lines, reps))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    for name in DATA:
        parser.add_argument(f'--{name}', type=Path, metavar='FOLDER')
    parser.add_argument('--half', choices=('choose', 'report', 'all'), default='report')
    parser.add_argument('--reps', type=int, default=7)
    parser.add_argument('--preset', choices=[name for name in PROFILES if name != 'default'], default='car_following')
    parser.add_argument('--photos', nargs='+', type=Path, metavar='PHOTO')
    parser.add_argument('--overlays', type=Path, metavar='FOLDER')
    parser.add_argument('--picture', type=Path, metavar='FILE')
    options = parser.parse_args()
    cv2.setNumThreads(1)
    if hasattr(os, 'sched_setaffinity'):
        os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
    if options.picture:
        draw_picture(options.picture)
    elif options.photos:
        print(photographs(options.preset, options.photos, options.overlays, options.reps))
    else:
        for name, profile in PROFILES.items():
            if profile.settings:
                print(f'## {name}\n\n{settings(name)}\n')
        print(table(HEAD, figures({name: getattr(options, name) for name in DATA}, options.half, options.reps)))


if __name__ == '__main__':
    main()
