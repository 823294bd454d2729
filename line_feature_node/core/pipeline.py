"""The six steps in their order: an image comes in, segments go out."""

import contextlib
import copy
import dataclasses
import math
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from line_feature_node.core.blobs import Blobs, extract_blobs, joined_blobs
from line_feature_node.core.buffers import Buffers
from line_feature_node.core.edges import CODE, MARGIN, PAD, STRONG, extract_edges, kept_gradient
from line_feature_node.core.features import compute_lines, segments_of
from line_feature_node.core.linking import link_lines
from line_feature_node.core.noise import adapted, correlation_length, gradient_noise, measure, step_response
from line_feature_node.core.normalization import normalize_codes
from line_feature_node.core.parameters import Parameters
from line_feature_node.core.refinement import (
    Demands,
    Guesses,
    Ridges,
    demands,
    first_guesses,
    grown_ahead,
    refine_lines,
)
from line_feature_node.core.scanning import BRIDGED, TAKEN, Chains, chain_directions, joined, scan_edges, trace_edges
from line_feature_node.core.selection import check_mask, enlarged, filled, placed, region, selected, smaller
from line_feature_node.core.splitting import deviation_variance, split_chains
from line_feature_node.core.team import ALONE, Team
from line_feature_node.core.thinning import thin, unscanned

#: What a frame goes through, as `times` names it: `input` is the check, the conversion to grey and the measuring of the
#: noise. Of linking and refinement one takes place.
STEPS = ('input', 'edges', 'scanning', 'normalization', 'blobs', 'features', 'linking', 'refinement')

#: Types of pixels that an image may have.
PIXEL_TYPES = (np.uint8, np.uint16, np.float32)

#: Told the result of each step.
Watch = Callable[[str, Any], None]

#: Pixels from which on several threads work on a frame: they would wait for each other longer than they save.
LEAST_SHARED = 2**19
#: Parts in which a team has edges traced.
PARTS = 8
#: Pixels an image may have: positions are 32-bit numbers, also in the border of so many rows or columns, or less, that
#: an image gets.
MOST_PIXELS, BORDER = 2**30, 64
#: Parameters that between them use all kernels.
ALL_KERNELS = (Parameters(), Parameters.paper(), Parameters(threads=2), Parameters(operator='sobel'))


@dataclass(frozen=True)
class Stages:
    """What each step made of one image, for figures, for teaching and to find out why a line is missing.

    All but `segments` is in pixels of the working picture: the region of interest, made smaller by `scale`.

    Pixels are N×2 int32, column and row; codes are uint8, 1 to 4. All chains stand one after the other, chain k from
    ``chain_offsets[k]`` to ``chain_offsets[k + 1]``; blobs in the same way.

    Attributes:
        grey: H×W, the working picture as the first step saw it, before its intensity is mapped.
        candidates: H×W uint8, codes of the pixels that pass the thinning and exceed T2, 0 elsewhere.
        strong: H×W bool, those of them that exceed T1.
        edges: H×W uint8, the quintuple image after hysteresis: codes of all edge pixels, 0 elsewhere.
        chain_pixels: Pixels of the chains, filled gaps included.
        chain_offsets: int32, where each chain starts.
        chain_directions: uint8, direction from each pixel to the next as a chain code, 0 to 7 (from +x towards +y in
            steps of 45 degrees); 255 at the end of an open chain.
        closed: bool, which chains are closed.
        bridged: bool, which pixels fill a gap.
        codes_before, codes_after: Codes of the chains' pixels before and after edge normalisation.
        blobs: BLOB_DTYPE, the attributes of Fig. 13 of each label; those with `select` are the line-blobs, the others
            merged into them and are empty.
        blob_pixels: Pixels of the line-blobs.
        blob_offsets: int32, where each blob starts.
        unlinked: SEGMENT_DTYPE, segments before linking.
        linked: SEGMENT_DTYPE, all segments after linking or refinement.
        segments: SEGMENT_DTYPE, the result: those of them that are selected, in pixels of the full picture.
    """

    grey: NDArray[Any]
    candidates: NDArray[np.uint8]
    strong: NDArray[np.bool_]
    edges: NDArray[np.uint8]
    chain_pixels: NDArray[np.int32]
    chain_offsets: NDArray[np.int32]
    chain_directions: NDArray[np.uint8]
    closed: NDArray[np.bool_]
    bridged: NDArray[np.bool_]
    codes_before: NDArray[np.uint8]
    codes_after: NDArray[np.uint8]
    blobs: NDArray[np.void]
    blob_pixels: NDArray[np.int32]
    blob_offsets: NDArray[np.int32]
    unlinked: NDArray[np.void]
    linked: NDArray[np.void]
    segments: NDArray[np.void]


@dataclass(frozen=True)
class View:
    """Where the working picture lies in the full one.

    Attributes:
        shape: Rows and columns of the full picture.
        x, y: Column and row of its first pixel in the full picture.
        width, height: Columns and rows of the full picture that it covers.
        across, down: Columns and rows of the full picture for each of its own.
    """

    shape: tuple[int, int] = (0, 0)
    x: int = 0
    y: int = 0
    width: int = 0
    height: int = 0
    across: float = 1.0
    down: float = 1.0

    @property
    def whole(self) -> bool:
        """Whether it is the full picture."""
        return (self.x, self.y, self.across, self.down) == (0, 0, 1, 1)


class LineFeatureExtractor:
    """Extracts line segments from images with one set of parameters.

    Memory is kept between frames, as much as the largest so far needed, so use one extractor a thread. The kernels run
    without the GIL.

    Attributes:
        parameters: What the next frame is extracted with; may be replaced between two frames.
        times: Seconds that each of STEPS took in the last frame that was extracted. What several threads do of it at
            the same time, from scanning to the growth of the lines, counts as scanning.
        unlinked: How many segments the last frame had before linking.
    """

    def __init__(self, parameters: Parameters | None = None) -> None:
        if not isinstance(parameters, Parameters | None):
            raise TypeError(f'parameters must be Parameters, got {type(parameters).__name__}')
        self.parameters = parameters or Parameters()
        self.times = dict.fromkeys(STEPS, 0.0)
        self.unlinked = 0
        self._buffers = Buffers()
        self._team = ALONE
        self._busy = threading.Lock()
        self._view = View()
        self._marks: NDArray[np.uint8] = np.zeros((2 * MARGIN, 2 * MARGIN), np.uint8)

    def extract(self, image: NDArray[Any], mask: NDArray[Any] | None = None) -> NDArray[np.void]:
        """Extract the line segments of an image.

        Args:
            image: H×W (grey), H×W×1, H×W×3 (BGR) or H×W×4 (BGRA), of any strides; uint8, uint16 or float32.
            mask: H×W, bool or uint8: no edge is found where it is 0, nor beside masked pixels that are NaN or infinite.

        Returns:
            SEGMENT_DTYPE, one record a segment, a new array each time.

        Raises:
            TypeError: The image or the mask is no array or has another type of pixel.
            ValueError: The image or the mask has another shape; the image has no pixels, none that is finite, or some
                that are neither finite nor masked; nothing of it is in the region of interest; or intensity_min or
                intensity_max, of which only one is given, contradicts the type of the pixels.
            RuntimeError: Another thread uses the extractor at this moment.
        """
        last = time.perf_counter()

        def lap(step: str, _: Any) -> None:
            nonlocal last
            now = time.perf_counter()
            self.times[step] = now - last
            last = now

        return self._run(image, mask, lap)

    def edges(self) -> NDArray[np.uint8]:
        """The edges of the last frame after hysteresis, in the size of the full picture.

        Returns:
            H×W uint8: 255 on an edge, 0 elsewhere and outside the region of interest.
        """
        view, marks = self._view, self._marks
        height, width = (round(size / factor) for size, factor in (
            (view.height, view.down), (view.width, view.across)))
        inner = marks[MARGIN:MARGIN + height, MARGIN:MARGIN + width]
        edges = np.where(inner & (TAKEN | BRIDGED) == TAKEN, np.uint8(255), np.uint8(0))
        if view.whole and edges.shape == view.shape:
            return edges
        full = np.zeros(view.shape, np.uint8)
        full[view.y:view.y + view.height, view.x:view.x + view.width] = enlarged(edges, view.height, view.width)
        return full

    def warm_up(self, *types: Any) -> None:
        """Compile the kernels, or load them from the cache, so that the first frame takes no longer than others.

        Args:
            *types: Types of pixels to expect; without, those of uint8, uint16 and float32 that the range of
                intensities, if one end of it is given, does not contradict.

        Raises:
            TypeError, ValueError: As :meth:`extract`, for a type that was asked for.
        """
        for kind in types or PIXEL_TYPES:
            with contextlib.suppress(*() if types else (ValueError,)):
                copy_of_it = LineFeatureExtractor(dataclasses.replace(self.parameters, roi=(0, 0, 1, 1), scale=1))
                # Some kernels are for several threads only, which small pictures do not have.
                size = 16 if self.parameters.threads == 1 else math.isqrt(LEAST_SHARED) + 1
                copy_of_it.extract(np.zeros((size, size), kind))

    def stages(self, image: NDArray[Any], mask: NDArray[Any] | None = None) -> Stages:
        """Extract, and keep what every step made; arguments and errors as for :meth:`extract`."""
        kept: dict[str, Any] = {}

        def keep(step: str, result: Any) -> None:
            kept[step] = copy.deepcopy(result)

        segments = self._run(image, mask, keep)
        return _stages(kept, segments)

    def _team_for(self, pixels: int) -> Team:
        """The threads that the parameters ask for, for a picture that is large enough."""
        if self._team.size != self.parameters.threads:
            self._team = Team(self.parameters.threads)
        return self._team if pixels >= LEAST_SHARED else ALONE

    def _run(self, image: NDArray[Any], mask: NDArray[Any] | None, watch: Watch) -> NDArray[np.void]:
        """The pipeline, for one frame at a time: two in the same memory would end the process."""
        if not self._busy.acquire(blocking=False):
            raise RuntimeError('the extractor is at work in another thread: each thread needs an extractor of its own')
        try:
            return self._steps(image, mask, watch)
        finally:
            self._busy.release()

    def _steps(self, image: NDArray[Any], mask: NDArray[Any] | None, watch: Watch) -> NDArray[np.void]:
        """The steps in their order.

        `watch` sees what each made before the next one works on it; of what several threads do at the same time, all of
        it when they are done.
        """
        buffers = self._buffers
        grey, keep, view = working_picture(image, mask, self.parameters, buffers)
        team = self._team_for(grey.size)
        p, noise = self.parameters, 0.0
        if p.refine or p.adaptive or p.grouping == 'straightness':
            quality = measure(grey, p, buffers, keep)
            p, noise = adapted(p, quality), quality.noise
        watch('input', grey)
        marks = extract_edges(grey, p, buffers, team)
        self._view, self._marks = view, marks
        if keep is not None:
            inner = marks[MARGIN:MARGIN + grey.shape[0], MARGIN:MARGIN + grey.shape[1]]
            np.bitwise_and(inner, keep, out=inner)
        if p.thinning == 'morphological':
            thin(marks)
        watch('edges', marks)
        ridges = _ridges(grey.shape, keep, noise, p, buffers) if p.refine else None
        if ridges is None:
            lines, self.unlinked = lines_of_edges(marks, grey.shape, noise, p, buffers, watch)
            segments = segments_of(lines, link_lines(lines, self.unlinked, grey.shape, p, buffers))
            watch('linking', None)
        else:
            if team.size > 1 and p.grouping == 'straightness' and p.thinning != 'none':
                asked = demands(ridges, p, buffers)
                guesses = shared_guesses(marks, grey.shape, noise, ridges, asked, p, buffers, team, watch)
            else:
                lines, count = lines_of_edges(marks, grey.shape, noise, p, buffers, watch)
                watch('linking', None)
                asked = demands(ridges, p, buffers)
                guesses = [first_guesses(lines, count, ridges, buffers)]
            self.unlinked = sum(part.strengths.size for part in guesses)
            segments = refine_lines(guesses, ridges, asked, buffers)
        watch('refinement', segments)
        if not view.whole:
            segments = placed(segments, view.x, view.y, view.across, view.down)
        return selected(segments, p)


def warm_up_all() -> None:
    """As :meth:`LineFeatureExtractor.warm_up`, for whatever parameters and types of pixels there will be."""
    for parameters in ALL_KERNELS:
        LineFeatureExtractor(parameters).warm_up()


def lines_of_edges(
    marks: NDArray[np.uint8], shape: tuple[int, int], noise: float, parameters: Parameters, buffers: Buffers,
    watch: Watch,
) -> tuple[NDArray[np.void], int]:
    """Steps 2 to 5, from edge scanning to line features.

    Args:
        marks: As edge extraction leaves them.
        shape: Rows and columns of the picture.
        noise: Standard deviation, in grey levels.
        parameters: Adapted to the picture.
        buffers: Memory to work in.
        watch: Sees the result of each step.

    Returns:
        LINE_DTYPE, and how many there are.
    """
    p = parameters
    by_codes = p.grouping == 'codes' or p.thinning == 'none'
    chains = unscanned(marks) if p.thinning == 'none' else scan_edges(marks, p, buffers)
    watch('scanning', (chains, marks))
    normalize_codes(chains, p.n if by_codes else 0)
    watch('normalization', chains.codes)
    if by_codes:
        blobs = extract_blobs(chains.pixels, chains.codes, chains.bridged, marks, MARGIN, buffers)
    else:
        blobs = split_chains(chains, _deviation(noise, p), marks.shape[1], MARGIN, p.min_size, buffers)
    watch('blobs', [blobs])
    lines = compute_lines(blobs, shape, p, buffers)
    watch('features', [lines])
    return lines


def shared_guesses(
    marks: NDArray[np.uint8], shape: tuple[int, int], noise: float, ridges: Ridges, asked: Demands,
    parameters: Parameters, buffers: Buffers, team: Team, watch: Watch,
) -> list[Guesses]:
    """Steps 2 to 5, the look at the gradient along the lines, and their growth, all at the same time.

    One of a team traces edges; the others make first guesses of them meanwhile, and let them grow. `watch` sees all
    when it is done.
    """
    parts: list[Chains] = []

    def traced() -> Iterator[tuple[Chains, Buffers]]:
        for chains, memory in zip(trace_edges(marks, PARTS, buffers), buffers.parts(PARTS), strict=True):
            parts.append(chains)
            yield chains, memory

    def guess(chains: Chains, memory: Buffers) -> tuple[Blobs, tuple[NDArray[np.void], int], Guesses]:
        p = parameters
        blobs = split_chains(chains, _deviation(noise, p), marks.shape[1], MARGIN, p.min_size, memory)
        lines = compute_lines(blobs, shape, p, memory)
        return blobs, lines, grown_ahead(first_guesses(*lines, ridges, memory), ridges, asked, memory)

    blobs, lines, guesses = zip(*team.pipe(guess, traced()), strict=True)
    chains = joined(parts)
    for step, result in (('scanning', (chains, marks)), ('normalization', chains.codes), ('blobs', blobs),
                         ('features', lines), ('linking', None)):
        watch(step, result)
    return list(guesses)


def _deviation(noise: float, parameters: Parameters) -> float:
    """Variance of the distance of edge pixels from their line."""
    return deviation_variance(noise * gradient_noise(parameters), parameters.T1)


def _ridges(
    shape: tuple[int, ...], keep: NDArray[np.uint8] | None, noise: float, parameters: Parameters, buffers: Buffers,
) -> Ridges:
    """The gradient that edge extraction left, nothing where the mask is, with what is known of its noise."""
    height, width = shape
    gradient, unit = kept_gradient(buffers)
    if keep is not None:
        gradient[PAD:PAD + height, PAD:PAD + width][keep == 0] = 0
    return Ridges(gradient, PAD, height, width, noise * gradient_noise(parameters) / unit,
                  step_response(parameters) / unit, correlation_length(parameters))


def working_picture(
    image: NDArray[Any], mask: NDArray[Any] | None, parameters: Parameters, buffers: Buffers,
) -> tuple[NDArray[Any], NDArray[np.uint8] | None, View]:
    """What the first step is to see of an image; arguments and errors as for :meth:`LineFeatureExtractor.extract`.

    Returns:
        Grey, H×W, C-contiguous, read-only: the image itself where it is that already; the mask, 255 where pixels count,
        None where all do; and where the working picture lies in the image.
    """
    _check(image)
    shape = image.shape[:2]
    x, y, width, height = region(parameters.roi, shape[1], shape[0])
    part = slice(y, y + height), slice(x, x + width)
    keep = None
    if mask is not None:
        check_mask(mask, shape)
        keep = np.where(mask[part], np.uint8(255), np.uint8(0))
    grey = grey_image(image[part], buffers)
    if grey.dtype == np.float32 and not cv2.checkRange(grey)[0]:
        if keep is None:
            raise ValueError('image must be finite, got pixels that are NaN or infinite')
        grey, keep = filled(grey, keep)
    if parameters.scale < 1:
        grey, keep = smaller(grey, keep, parameters.scale)
    # Numba tells read-only arrays from others and would compile the kernels for both.
    grey = grey.view()
    grey.flags.writeable = False
    return grey, keep, View(shape, x, y, width, height, width / grey.shape[1], height / grey.shape[0])


def grey_image(image: NDArray[Any], buffers: Buffers) -> NDArray[Any]:
    """An image that was checked in grey, H×W and C-contiguous: the image itself where it is that already."""
    if not (image.flags.c_contiguous and image.dtype.isnative):
        image = np.ascontiguousarray(image, image.dtype.newbyteorder('='))
    height, width = image.shape[:2]
    if image.ndim == 3 and image.shape[2] > 1:
        grey = buffers.array(f'grey {image.dtype}', height * width, image.dtype)[:height * width].reshape(height, width)
        cv2.cvtColor(image, cv2.COLOR_BGR2GRAY if image.shape[2] == 3 else cv2.COLOR_BGRA2GRAY, dst=grey)
    else:
        grey = image.reshape(height, width)
    return grey


def _check(image: Any) -> None:
    """Raise what is wrong with an image."""
    if not isinstance(image, np.ndarray):
        raise TypeError(f'image must be a numpy array, got {type(image).__name__}')
    if image.dtype.type not in PIXEL_TYPES:
        hint = ': use image.astype(numpy.float32)' if image.dtype == np.float64 else ''
        raise TypeError(f'image must be uint8, uint16 or float32, got {image.dtype}{hint}')
    if not (image.ndim == 2 or (image.ndim == 3 and image.shape[2] in (1, 3, 4))):
        raise ValueError(f'image must be H×W (grey), H×W×3 (BGR) or H×W×4 (BGRA), got shape {image.shape}')
    rows, columns = image.shape[:2]
    if not image.size or rows * columns > MOST_PIXELS or (rows + BORDER) * (columns + BORDER) >= 2**31:
        raise ValueError(
            f'image must have 1 to {MOST_PIXELS} pixels, fewer if it is very thin, got shape {image.shape}')


def _stages(kept: dict[str, Any], segments: NDArray[np.void]) -> Stages:
    """Bring what was kept of the steps from padded arrays and flat indices to pixels of the image."""
    grey, marks = kept['input'], kept['edges']
    chains, visited = kept['scanning']
    blobs = joined_blobs(kept['blobs'])
    members, blob_offsets = blobs.members()
    lines = np.concatenate([part[:count] for part, count in kept['features']])
    height, width = grey.shape
    inside = slice(MARGIN, MARGIN + height), slice(MARGIN, MARGIN + width)
    candidates = (marks & CODE)[inside]
    pixels = np.stack(np.divmod(chains.pixels, marks.shape[1])[::-1], -1) - MARGIN
    return Stages(
        grey=grey, candidates=candidates, strong=(marks & STRONG != 0)[inside],
        edges=np.where(visited[inside] & TAKEN, candidates, 0).astype(np.uint8), chain_pixels=pixels,
        chain_offsets=chains.offsets, chain_directions=chain_directions(chains, marks.shape[1]), closed=chains.closed,
        bridged=chains.bridged, codes_before=chains.codes, codes_after=kept['normalization'],
        blobs=blobs.attributes, blob_pixels=pixels[members], blob_offsets=blob_offsets,
        unlinked=segments_of(lines, np.ones(lines.size, np.bool_)), linked=kept['refinement'], segments=segments)


_of_thread = threading.local()


def extract(image: NDArray[Any], mask: NDArray[Any] | None = None, **parameters: Any) -> NDArray[np.void]:
    """Extract the line segments of an image; may be called from any thread.

    Args:
        image: H×W (grey), H×W×3 (BGR) or H×W×4 (BGRA), of any strides; uint8, uint16 or float32.
        mask: H×W, bool or uint8: no edge is found where it is 0, nor beside masked pixels that are NaN or infinite.
        **parameters: Those of :class:`Parameters`; what is not given has its default. `profile` names a set.

    Returns:
        SEGMENT_DTYPE, one record a segment.

    Raises:
        TypeError: A parameter is unknown or has the wrong type, or the image is no array of these types.
        ValueError: A parameter is out of range, or the image is empty, has another shape or pixels that are not finite.
    """
    chosen = Parameters.profile(parameters.pop('profile', 'default'), **parameters)
    extractor: LineFeatureExtractor | None = getattr(_of_thread, 'extractor', None)
    if extractor is None or extractor.parameters != chosen:
        extractor = _of_thread.extractor = LineFeatureExtractor(chosen)
    return extractor.extract(image, mask)
