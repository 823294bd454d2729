"""Memory that an extractor keeps from frame to frame, so that nothing is allocated in the hot path."""

from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray


class Buffers:
    """Arrays by name, in as much memory as the largest frame so far needed, and a quarter for somewhat larger ones.

    What an array holds at first is unspecified, but for those asked for with ``zeros``: their users leave them as
    they found them, all zero.
    """

    def __init__(self) -> None:
        self._arrays: dict[str, NDArray[Any]] = {}
        self._images: dict[str, NDArray[Any]] = {}
        self._parts: list[Buffers] = []

    def parts(self, count: int) -> 'list[Buffers]':
        """So much other memory, always the same, for parts of a frame that are worked on at the same time."""
        while len(self._parts) < count:
            self._parts.append(Buffers())
        return self._parts[:count]

    def array(self, name: str, size: int, dtype: DTypeLike, *, zeros: bool = False) -> NDArray[Any]:
        """A one-dimensional array of at least that size, always the same one until a larger one is needed.

        Raises:
            TypeError: It was asked for with another type before: two things have one name.
        """
        array = self._arrays.get(name)
        if array is not None and array.dtype != dtype:
            raise TypeError(f'{name} was an array of {array.dtype}, and is asked for as one of {np.dtype(dtype)}')
        if array is None or array.size < size:
            # A video's frames differ a little: room to grow saves most of them from allocating.
            room = size + size // 4
            array = np.zeros(room, dtype) if zeros else np.empty(room, dtype)
            self._arrays[name] = array
        return array

    def image(self, name: str, height: int, width: int, dtype: DTypeLike) -> NDArray[Any]:
        """A two-dimensional array of exactly that size; all zero when it is another than last time.

        Frames of several sizes by turns share its memory, which would soon be in pieces if each had its own.
        """
        image = self._images.get(name)
        if image is None or image.shape != (height, width) or image.dtype != dtype:
            size = height * width * np.dtype(dtype).itemsize
            image = self.array(name, size, np.uint8)[:size].view(dtype).reshape(height, width)
            image.fill(0)
            self._images[name] = image
        return image

    def last_image(self, name: str) -> NDArray[Any]:
        """The image that was last asked for by this name."""
        return self._images[name]
