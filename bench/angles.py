"""Measure how near the angles of the segments come to what noise allows.

    python bench/angles.py [--seed 0] [--scenes 20]

No unbiased estimate of an edge's angle errs by less than the bound of Cramér and Rao: with g the gradient of the
picture without noise across the edge, t the place of a pixel along it and t0 their mean, weighted by g^2, its variance
is at least sigma^2 over the sum of g^2 (t - t0)^2 of all pixels near the edge, whoever knows the picture but for the
angle and the position of that edge. The scenes are those of bench/accuracy.py. The least median error is that of normal
errors with these bounds as their deviations: for the part of an edge that a segment covers, without the two pixels at
either end where corners bend it, and for the whole edge, as if corners did not exist. The same segments count for all,
those that match an edge.
"""

import argparse
from statistics import NormalDist

import cv2
import numpy as np
from accuracy import Lines, scene, with_noise
from numpy.typing import NDArray

from line_feature_node.core import LineFeatureExtractor, end_points
from line_feature_node.truth import match

SIGMAS = (5, 10, 20, 30)
#: Pixels this near to an edge tell of its angle, and at its ends so many do not.
NEAR, CORNER = 4.0, 2.0
#: Magnitudes of normal errors of deviation 1, each as likely as the others.
NORMAL = np.array([NormalDist().inv_cdf(0.5 + (k + 0.5) / 2000) for k in range(1000)])
#: Rows and columns repeated around a picture before it is differentiated.
AROUND = 64


def gradient(image: NDArray[np.float32]) -> NDArray[np.float64]:
    """Its exact gradient, H×W×2, along x and y, as far as a picture of pixels has one: from its spectrum."""
    padded = np.pad(image, AROUND, mode='reflect')
    spectrum = np.fft.fft2(padded)
    down, right = np.fft.fftfreq(padded.shape[0])[:, None], np.fft.fftfreq(padded.shape[1])[None]
    both = [np.fft.ifft2(spectrum * 2j * np.pi * frequency).real for frequency in (right, down)]
    return np.stack(both, -1)[AROUND:-AROUND, AROUND:-AROUND]


def bound(slopes: NDArray[np.float64], edge: NDArray[np.float64], first: float, last: float, sigma: float) -> float:
    """The least standard deviation of the angle of an edge, radians.

    Args:
        slopes: The gradient of the picture, H×W×2.
        edge: x1, y1, x2, y2.
        first, last: Which part of it is seen, in pixels from its first end.
        sigma: Of the noise, in grey levels.
    """
    x, y = (edge[2:] - edge[:2]) / np.hypot(*(edge[2:] - edge[:2]))
    rows, columns = np.mgrid[:slopes.shape[0], :slopes.shape[1]]
    along = (columns - edge[0]) * x + (rows - edge[1]) * y
    beside = (rows - edge[1]) * x - (columns - edge[0]) * y
    seen = (np.abs(beside) < NEAR) & (first <= along) & (along <= last)
    weights, places = (slopes[seen] @ (-y, x) / sigma) ** 2, along[seen]
    spread = (weights * (places - np.average(places, weights=weights)) ** 2).sum()
    return float(1 / np.sqrt(spread))


def errors(found: Lines, true: Lines, slopes: NDArray[np.float64], sigma: float) -> list[tuple[float, float, float]]:
    """Of each segment that is right: its error, and the bounds for what it covers and for the whole edge, radians."""
    matched, low, high, _, angle = match(found, true)
    rows = []
    for number in np.flatnonzero(matched.any(1)):
        edge = int(np.where(matched[number], high[number] - low[number], -1).argmax())
        first, last = low[number, edge] + CORNER, high[number, edge] - CORNER
        if last - first > CORNER:
            length = float(np.hypot(*(true[edge, 2:] - true[edge, :2])))
            rows.append((float(angle[number, edge]), bound(slopes, true[edge], first, last, sigma),
                         bound(slopes, true[edge], 0, length, sigma)))
    return rows


def median_error(deviations: NDArray[np.float64]) -> float:
    """The median of the magnitudes of normal errors of these standard deviations."""
    return float(np.median(NORMAL[:, None] * deviations))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--seed', type=int, default=0)
    parser.add_argument('--scenes', type=int, default=20)
    options = parser.parse_args()
    cv2.setNumThreads(1)
    extractor = LineFeatureExtractor()
    drawn = [scene(options.seed * 1000 + number) for number in range(options.scenes)]
    slopes = [gradient(image) for image, _, _ in drawn]
    print('| sigma | segments | median error, degrees | least possible | error over that | for whole edges |')
    print('|---|---|---|---|---|---|')
    for sigma in SIGMAS:
        rows = [row for number, (image, true, _) in enumerate(drawn)
                for row in errors(end_points(extractor.extract(with_noise(image, sigma, number))), true,
                                  slopes[number], sigma)]
        angle, least, whole = np.degrees(rows).T
        print(f'| {sigma} | {len(rows)} | {np.median(angle):.3f} | {median_error(least):.3f} | '
              f'{np.median(angle) / median_error(least):.2f} | {median_error(whole):.3f} |')


if __name__ == '__main__':
    main()
