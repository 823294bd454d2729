"""How the kernels are compiled: Numba, without the GIL, cached where a folder can be written."""

from collections.abc import Callable
from typing import Any

import numba


def kernel(function: Callable[..., Any]) -> Callable[..., Any]:
    """Compile at the first call, for the types of that call.

    The machine code is kept beside the source or in the user's cache folder. Where neither can be written (a
    read-only installation without a home) Numba refuses to cache, and the function is compiled in every process.
    A product and a sum may be contracted to one instruction; no other liberty is taken with floats, so that NaN and
    the order of sums mean what they say.
    """
    return _compile(function)


def inlined(function: Callable[..., Any]) -> Callable[..., Any]:
    """As :func:`kernel`, for what is called once an end or a pixel: an array costs seven arguments in a real call."""
    return _compile(function, forceinline=True)


def _compile(function: Callable[..., Any], **options: Any) -> Callable[..., Any]:
    options |= {'nogil': True, 'fastmath': {'contract'}, 'error_model': 'numpy'}
    try:
        return numba.njit(cache=True, **options)(function)
    except RuntimeError:
        return numba.njit(**options)(function)
