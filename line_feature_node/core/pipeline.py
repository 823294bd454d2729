"""The six steps in their order: an image comes in, segments go out."""

import contextlib
import copy
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from line_feature_node.core.blobs import extract_blobs
from line_feature_node.core.buffers import Buffers
from line_feature_node.core.edges import CODE, MARGIN, STRONG, extract_edges
from line_feature_node.core.features import compute_lines, segments_of
from line_feature_node.core.linking import link_lines
from line_feature_node.core.normalization import normalize_codes
from line_feature_node.core.parameters import Parameters
from line_feature_node.core.scanning import TAKEN, scan_edges
from line_feature_node.core.thinning import thin, unscanned

#: What a frame goes through, as `times` names it: `input` is the check and the conversion to grey.
STEPS = ('input', 'edges', 'scanning', 'normalization', 'blobs', 'features', 'linking')

#: Types of pixels that an image may have.
PIXEL_TYPES = (np.uint8, np.uint16, np.float32)

#: Pixels an image may have: positions are 32-bit numbers.
MOST_PIXELS = 2**30


@dataclass(frozen=True)
class Stages:
    """What each step made of one image, for figures, for teaching and to find out why a line is missing.

    Pixels are N×2 int32, column and row; codes are uint8, 1 to 4. All chains stand one after the other, chain k from
    ``chain_offsets[k]`` to ``chain_offsets[k + 1]``; blobs in the same way.

    Attributes:
        grey: H×W, the image as the first step saw it, before its intensity is mapped.
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
        unlinked: SEGMENT_DTYPE, segments before linking; `min_length` applies after it.
        segments: SEGMENT_DTYPE, the result.
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
    segments: NDArray[np.void]


class LineFeatureExtractor:
    """Extracts line segments from images with one set of parameters.

    Memory is kept between frames, as much as the largest so far needed, so use one extractor a thread. The kernels run
    without the GIL.

    Attributes:
        parameters: What it was made with.
        times: Seconds that each of STEPS took in the last frame that was extracted.
        unlinked: How many segments the last frame had before linking.
    """

    def __init__(self, parameters: Parameters | None = None) -> None:
        if not isinstance(parameters, Parameters | None):
            raise TypeError(f'parameters must be Parameters, got {type(parameters).__name__}')
        self.parameters = parameters or Parameters()
        self.times = dict.fromkeys(STEPS, 0.0)
        self.unlinked = 0
        self._buffers = Buffers()
        self._busy = threading.Lock()

    def extract(self, image: NDArray[Any]) -> NDArray[np.void]:
        """Extract the line segments of an image.

        Args:
            image: H×W (grey), H×W×1, H×W×3 (BGR) or H×W×4 (BGRA), of any strides; uint8, uint16 or float32.

        Returns:
            SEGMENT_DTYPE, one record a segment, a new array each time.

        Raises:
            TypeError: The image is no array or has another type of pixel.
            ValueError: The image has another shape, no pixels, or pixels that are NaN or infinite; or intensity_min or
                intensity_max, of which only one is given, contradicts the type of the pixels.
            RuntimeError: Another thread uses the extractor at this moment.
        """
        last = time.perf_counter()

        def lap(step: str, _: Any) -> None:
            nonlocal last
            now = time.perf_counter()
            self.times[step] = now - last
            last = now

        return self._run(image, lap)

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
                self.extract(np.zeros((16, 16), kind))

    def stages(self, image: NDArray[Any]) -> Stages:
        """Extract, and keep what every step made; arguments and errors as for :meth:`extract`."""
        kept: dict[str, Any] = {}

        def keep(step: str, result: Any) -> None:
            kept[step] = copy.deepcopy(result)

        segments = self._run(image, keep)
        return _stages(kept, segments)

    def _run(self, image: NDArray[Any], watch: Callable[[str, Any], None]) -> NDArray[np.void]:
        """The pipeline, for one frame at a time: two in the same memory would end the process."""
        if not self._busy.acquire(blocking=False):
            raise RuntimeError('the extractor is at work in another thread: each thread needs an extractor of its own')
        try:
            return self._steps(image, watch)
        finally:
            self._busy.release()

    def _steps(self, image: NDArray[Any], watch: Callable[[str, Any], None]) -> NDArray[np.void]:
        """The steps in their order; `watch` sees the result of each before the next one works on it."""
        p, buffers = self.parameters, self._buffers
        grey = grey_image(image, buffers)
        watch('input', grey)
        marks = extract_edges(grey, p, buffers)
        if p.thinning == 'morphological':
            thin(marks)
        watch('edges', marks)
        chains = unscanned(marks) if p.thinning == 'none' else scan_edges(marks, p, buffers)
        watch('scanning', (chains, marks))
        normalize_codes(chains, p.n)
        watch('normalization', chains.codes)
        blobs = extract_blobs(chains.pixels, chains.codes, marks.shape, MARGIN, buffers)
        watch('blobs', blobs)
        lines, count = compute_lines(blobs, chains.pixels, chains.bridged, marks.shape[1], MARGIN, grey.shape, p,
                                     buffers)
        watch('features', lines[:count])
        self.unlinked = count
        alive = link_lines(lines, count, grey.shape, p, buffers)
        segments = segments_of(lines, alive, p.min_length)
        watch('linking', segments)
        return segments


def grey_image(image: NDArray[Any], buffers: Buffers) -> NDArray[Any]:
    """Check an image and make it grey; arguments and errors as for :meth:`LineFeatureExtractor.extract`.

    Returns:
        H×W, C-contiguous, read-only: the image itself where it is that already.
    """
    _check(image)
    if not (image.flags.c_contiguous and image.dtype.isnative):
        image = np.ascontiguousarray(image, image.dtype.newbyteorder('='))
    height, width = image.shape[:2]
    if image.ndim == 3 and image.shape[2] > 1:
        grey = buffers.array(f'grey {image.dtype}', height * width, image.dtype)[:height * width].reshape(height, width)
        cv2.cvtColor(image, cv2.COLOR_BGR2GRAY if image.shape[2] == 3 else cv2.COLOR_BGRA2GRAY, dst=grey)
    else:
        grey = image.reshape(height, width)
    if grey.dtype == np.float32 and not cv2.checkRange(grey)[0]:
        raise ValueError('image must be finite, got pixels that are NaN or infinite')
    # Numba tells read-only arrays from others and would compile the kernels for both.
    grey = grey.view()
    grey.flags.writeable = False
    return grey


def _check(image: Any) -> None:
    """Raise what is wrong with an image."""
    if not isinstance(image, np.ndarray):
        raise TypeError(f'image must be a numpy array, got {type(image).__name__}')
    if image.dtype.newbyteorder('=') not in PIXEL_TYPES:
        hint = ': use image.astype(numpy.float32)' if image.dtype == np.float64 else ''
        raise TypeError(f'image must be uint8, uint16 or float32, got {image.dtype}{hint}')
    if not (image.ndim == 2 or (image.ndim == 3 and image.shape[2] in (1, 3, 4))):
        raise ValueError(f'image must be H×W (grey), H×W×3 (BGR) or H×W×4 (BGRA), got shape {image.shape}')
    if not 0 < image.size <= 4 * MOST_PIXELS or image.shape[0] * image.shape[1] > MOST_PIXELS:
        raise ValueError(f'image must have 1 to {MOST_PIXELS} pixels, got shape {image.shape}')


def _stages(kept: dict[str, Any], segments: NDArray[np.void]) -> Stages:
    """Bring what was kept of the steps from padded arrays and flat indices to pixels of the image."""
    grey, marks, lines = kept['input'], kept['edges'], kept['features']
    chains, visited = kept['scanning']
    blobs = kept['blobs']
    height, width = grey.shape
    inside = slice(MARGIN, MARGIN + height), slice(MARGIN, MARGIN + width)
    candidates = (marks & CODE)[inside]
    pixels = np.stack(np.divmod(chains.pixels, marks.shape[1])[::-1], -1) - MARGIN
    return Stages(
        grey=grey, candidates=candidates, strong=(marks & STRONG != 0)[inside],
        edges=np.where(visited[inside] & TAKEN, candidates, 0).astype(np.uint8), chain_pixels=pixels,
        chain_offsets=chains.offsets, chain_directions=chains.directions, closed=chains.closed,
        bridged=chains.bridged, codes_before=chains.codes, codes_after=kept['normalization'],
        blobs=blobs.attributes, blob_pixels=pixels[blobs.members], blob_offsets=blobs.offsets,
        unlinked=segments_of(lines, np.ones(lines.size, np.bool_), 0.0), segments=segments)


_of_thread = threading.local()


def extract(image: NDArray[Any], **parameters: Any) -> NDArray[np.void]:
    """Extract the line segments of an image; may be called from any thread.

    Args:
        image: H×W (grey), H×W×3 (BGR) or H×W×4 (BGRA), of any strides; uint8, uint16 or float32.
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
    return extractor.extract(image)
