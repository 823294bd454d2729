"""How the kernels are compiled: Numba, without the GIL, cached where a folder can be written."""

import hashlib
from collections.abc import Callable
from pathlib import Path
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
    # Without Numba's runtime, references to arrays are not counted: kernels allocate nothing and return none, and the
    # atomic counting took a third of the time.
    options |= {'nogil': True, 'fastmath': {'contract'}, 'error_model': 'numpy', '_nrt': False}
    try:
        compiled = numba.njit(cache=True, **options)(function)
    except RuntimeError:
        return numba.njit(**options)(function)
    # Numba takes cached code for current while the file of its function is unchanged; but ours has functions and
    # constants of other modules compiled into it. So the stamp of that file becomes one of all of them.
    cache_file: Any = getattr(getattr(compiled, '_cache', None), '_cache_file', None)
    if hasattr(cache_file, '_source_stamp'):
        cache_file._source_stamp = SOURCES
    return compiled


def _sources() -> str:
    """A digest of all modules of the core."""
    digest = hashlib.sha256()
    for path in sorted(Path(__file__).parent.glob('*.py')):
        digest.update(path.read_bytes())
    return digest.hexdigest()


SOURCES = _sources()
