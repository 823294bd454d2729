"""Who does the work of the offline run: processes of this machine, or a Dask cluster, behind the executor interface."""

import contextlib
import multiprocessing
import os
import signal
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import BrokenExecutor, CancelledError, Executor, Future, ProcessPoolExecutor, ThreadPoolExecutor
from dataclasses import dataclass
from multiprocessing.connection import wait
from typing import Any

#: How often a piece of work is given out when those who had it died.
ATTEMPTS = 3


class WorkersError(RuntimeError):
    """The work cannot be done by these workers; the message is a sentence for users."""


@dataclass(frozen=True)
class Workers:
    """Where executors come from.

    Attributes:
        count: How many pieces of work they do at a time.
        make: Makes an executor, a context manager; again when the one before broke.
        broken: Exceptions that say that workers died.
    """

    count: int
    make: Callable[[], 'contextlib.AbstractContextManager[Executor]']
    broken: tuple[type[BaseException], ...] = (BrokenExecutor,)


def local(count: int | None = None) -> Workers:
    """Processes of this machine, as many as there are processors unless a number is given."""
    number = count or len(os.sched_getaffinity(0))
    return Workers(number, lambda: _pool(number))


@contextlib.contextmanager
def _pool(count: int) -> Iterator[Executor]:
    pool = ProcessPoolExecutor(count, multiprocessing.get_context('spawn'), _begin)
    try:
        yield pool
    finally:
        # What was not begun is not done any more; what was is short.
        pool.shutdown(wait=True, cancel_futures=True)


def _begin() -> None:
    """Let a worker end with its parent, however that ends, and leave signals of the terminal to it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = multiprocessing.parent_process()
    if parent is not None:
        threading.Thread(target=_end_with, args=(parent.sentinel,), daemon=True).start()


def _end_with(sentinel: int) -> None:
    wait([sentinel])
    os._exit(1)


def inline() -> Workers:
    """A thread of this process, for what is not worth starting another."""
    return Workers(1, lambda: ThreadPoolExecutor(1))


def cluster(address: str) -> Workers:
    """The workers of a Dask cluster.

    Args:
        address: Of its scheduler, tcp://host:port.

    Raises:
        WorkersError: Dask is not installed, or nobody answers there.
    """
    try:
        from distributed import Client, KilledWorker
        from distributed.comm import CommClosedError
    except ImportError:
        raise WorkersError("Dask is not installed: install the extra 'fleet'") from None
    try:
        client = Client(address, timeout='10s')
    except (OSError, TimeoutError, ValueError) as error:
        raise WorkersError(f'no Dask scheduler answers at {address}: {error}') from None
    number = sum(client.nthreads().values())
    if not number:
        raise WorkersError(f'the Dask cluster at {address} has no workers')
    broken = (BrokenExecutor, CancelledError, CommClosedError, KilledWorker)
    return Workers(number, lambda: contextlib.closing(_Closable(client)), broken)


class _Closable(Executor):
    """A client's executor; closing it gives back what was not begun, and leaves the client for the next."""

    def __init__(self, client: Any) -> None:
        self._executor = client.get_executor(retries=ATTEMPTS, pure=False)

    def submit(self, work: Any, /, *arguments: Any, **options: Any) -> Any:
        """As any executor does."""
        return self._executor.submit(work, *arguments, **options)

    def close(self) -> None:
        self._executor.shutdown(wait=False)


def in_order(
    workers: Workers, work: Callable[..., bytes], pieces: Iterable[tuple[Any, ...]],
) -> Iterator[bytes]:
    """Results of the work on each piece, in the order of the pieces; only so many at a time as keep the workers busy.

    Args:
        workers: Who does it.
        work: A function that can be sent to another process.
        pieces: Its arguments.

    Raises:
        WorkersError: Those who work on a piece die again and again.
        Exception: What the work raised.
    """
    remaining = deque(pieces)
    attempts = 0
    while remaining:
        before = len(remaining)
        with contextlib.suppress(*workers.broken), workers.make() as executor:
            yield from _results(executor, work, remaining, 2 * workers.count)
        attempts = attempts + 1 if len(remaining) == before else 0
        if attempts == ATTEMPTS:
            raise WorkersError(f'workers were killed {ATTEMPTS} times in a row, perhaps for want of memory')


def _results(
    executor: Executor, work: Callable[..., bytes], remaining: 'deque[tuple[Any, ...]]', ahead: int,
) -> Iterator[bytes]:
    """Take from what remains piece by piece, as each is done; the others are under way."""
    under_way: deque[Future[bytes]] = deque(executor.submit(work, *piece) for piece in list(remaining)[:ahead])
    while under_way:
        result = under_way.popleft().result()
        remaining.popleft()
        yield result  # before anything that fails when workers died, or it would be lost
        if len(remaining) > len(under_way):
            under_way.append(executor.submit(work, *remaining[len(under_way)]))
