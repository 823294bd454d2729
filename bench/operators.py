"""Measure noise gain, step response, cost and memory of each edge operator; prints the table of docs/operators.md.

    python bench/operators.py
"""

import time
from typing import Any

import cv2
import numpy as np

from line_feature_node.core import Parameters
from line_feature_node.core.buffers import Buffers
from line_feature_node.core.edges import PAD, STENCILS, deriche_stencil, extract_edges, recur
from line_feature_node.scenes import corridor

OPERATORS: list[dict[str, Any]] = [
    {'operator': 'deriche', 'alpha': 0.7}, {'operator': 'deriche', 'alpha': 1.0}, {'operator': 'deriche', 'alpha': 1.8},
    {'operator': 'dog', 'sigma': 1.0}, {'operator': 'dog', 'sigma': 1.5},
    {'operator': 'sobel'}, {'operator': 'prewitt'}, {'operator': 'scharr'},
]
SIGMA = 10.0
REPS = 200


def gradient(image: Any, parameters: Parameters) -> Any:
    """The derivative along x of each pixel, from the plane that edge extraction leaves."""
    buffers = Buffers()
    extract_edges(image, parameters, buffers)
    height, width = image.shape
    plane = buffers.image('smoothed' if parameters.operator == 'dog' else 'plane',
                          *buffers._arrays['plane'].shape, np.float32)[:height + 2 * PAD, :width + 2 * PAD]
    if parameters.operator == 'deriche':
        # What the sweep does row by row.
        for row in range(height + PAD - 1, -1, -1):
            recur(plane[row], plane[row + 1], plane[row + 2], np.float32(np.exp(-parameters.alpha)))
    side, centre = STENCILS.get(parameters.operator) or deriche_stencil(parameters.alpha)
    across = centre * plane[1:-1] + side * (plane[:-2] + plane[2:])
    return (across[:, 2:] - across[:, :-2])[1:-1, 1:-1]


def noise_gain(parameters: Parameters) -> float:
    """Standard deviation of one component of the gradient, per grey level of white noise."""
    noise = np.random.default_rng(0).normal(128, SIGMA, (1000, 1000)).astype(np.float32)
    return float(gradient(noise, parameters)[50:-50, 50:-50].std() / SIGMA)


def step_response(parameters: Parameters) -> float:
    """The greatest gradient at a step between two pixels, per grey level of it."""
    step = np.repeat(np.where(np.arange(200) < 100, 50, 150).astype(np.float32)[None], 50, 0)
    return float(gradient(step, parameters).max() / 100)


def main() -> None:
    image = cv2.cvtColor(corridor().image, cv2.COLOR_BGR2GRAY)
    image.flags.writeable = False
    chosen = [Parameters(**operator) for operator in OPERATORS]
    buffers = [Buffers() for _ in chosen]
    times: list[list[float]] = [[] for _ in chosen]
    for _ in range(REPS):
        for k, parameters in enumerate(chosen):
            start = time.perf_counter()
            extract_edges(image, parameters, buffers[k])
            times[k].append(time.perf_counter() - start)
    cost = [float(np.median(values[10:])) for values in times]
    base = cost[chosen.index(Parameters())]
    print('| operator | noise gain | step response | step / noise | time, Deriche α = 1 being 1 | bytes a pixel |')
    print('|---|---|---|---|---|---|')
    for k, parameters in enumerate(chosen):
        noise, step = noise_gain(parameters), step_response(parameters)
        memory = sum(array.nbytes for array in buffers[k]._arrays.values()) / image.size
        name = ', '.join(str(value) for value in OPERATORS[k].values())
        print(f'| {name} | {noise:.4f} | {step:.3f} | {step / noise:.2f} | {cost[k] / base:.2f} | {memory:.1f} |')


if __name__ == '__main__':
    main()
