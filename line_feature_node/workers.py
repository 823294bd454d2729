"""Who does the work of the offline run: processes of this machine, or a Dask cluster, behind the executor interface."""

import concurrent.futures
import contextlib
import importlib.metadata
import logging
import multiprocessing
import os
import signal
import threading
import time
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import BrokenExecutor, CancelledError, Executor, Future, ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from multiprocessing import resource_tracker
from multiprocessing.connection import wait
from typing import Any

import cv2

#: Arguments of a piece of work.
Piece = tuple[Any, ...]
#: What the workers of a cluster must have, in the same version as here.
PACKAGE = 'line_feature_node'
#: How often a piece of work is given out when those who had it died.
ATTEMPTS = 3
KILLED = f'workers were killed {ATTEMPTS} times in a row, perhaps for want of memory'
#: Seconds between looks at who is waited for.
LOOK = 0.5
#: Seconds in which a scheduler must answer, ...
ANSWER = 10.0
#: ... and one that was lost must be back.
RETURN = 5.0
#: What Dask would say on its own, with tracebacks, is said in sentences here.
LOGGERS = ('distributed', 'distributed.client', 'distributed.comm', 'distributed.core', 'tornado.application')
#: Seconds in which a cluster whose workers are all gone must have new ones.
REPLACEMENT = 60.0


class WorkersError(RuntimeError):
    """The work cannot be done by these workers; the message is a sentence for users."""


@dataclass(frozen=True)
class Workers:
    """Where executors come from.

    Attributes:
        count: How many pieces of work they do at a time.
        make: Makes an executor, a context manager; again when the one before broke.
        broken: Exceptions that say that workers died.
        look: Called while a result is waited for; raises one of `broken`, or WorkersError, where none is to come.
    """

    count: int
    make: Callable[[], 'contextlib.AbstractContextManager[Executor]']
    broken: tuple[type[BaseException], ...] = (BrokenExecutor,)
    look: Callable[[], None] = lambda: None


def local(count: int | None = None) -> Workers:
    """Processes of this machine, as many as there are processors unless a number is given."""
    number = count or len(os.sched_getaffinity(0))
    return Workers(number, lambda: _processes(number))


@contextlib.contextmanager
def _processes(count: int) -> Iterator[Executor]:
    resource_tracker.ensure_running()  # when it starts, it lets interrupts through again
    processes = _Processes(count)
    try:
        yield processes
    except BaseException:
        processes.kill()  # nobody wants any more what is under way, which may take long
        raise
    finally:
        processes.shutdown(wait=True, cancel_futures=True)


class _Processes(ThreadPoolExecutor):
    """Threads that have their work done by a process each; one that dies is replaced, and its work done again.

    A ProcessPoolExecutor waits without end where a process dies while it sends a result, as the others hold the same
    pipe; here each has its own, which ends with it. A process takes over from its thread that interrupts are blocked,
    and no handler of signals runs there, which would leave it half started.
    """

    def __init__(self, count: int) -> None:
        super().__init__(count, 'process', signal.pthread_sigmask, (signal.SIG_BLOCK, [signal.SIGINT]))
        self._of_thread = threading.local()
        self._started: list[_Process] = []
        self._killed = False

    def submit(self, work: Any, /, *arguments: Any, **options: Any) -> 'Future[Any]':
        """As any executor does."""
        return super().submit(self._do, partial(work, *arguments, **options))

    def kill(self) -> None:
        """End all at once; what is not done is broken."""
        self._killed = True
        for process in list(self._started):
            process.kill()

    def shutdown(self, *arguments: Any, **options: Any) -> None:
        """As any executor does."""
        super().shutdown(*arguments, **options)
        for process in self._started:
            process.close()

    def _do(self, call: Callable[[], Any]) -> Any:
        for _ in range(ATTEMPTS):
            with contextlib.suppress(EOFError, OSError):
                error, result = self._process().do(call)
                break
            self._of_thread.process = None
        else:
            raise WorkersError(KILLED)
        if error is not None:
            raise error
        return result

    def _process(self) -> '_Process':
        """The process of the thread."""
        if getattr(self._of_thread, 'process', None) is None and not self._killed:
            self._of_thread.process = _Process()
            self._started.append(self._of_thread.process)
        if self._killed:
            self.kill()  # that one, too
            raise BrokenExecutor
        process: _Process = self._of_thread.process
        return process


class _Process:
    """A process that does one piece of work after the other."""

    def __init__(self) -> None:
        context = multiprocessing.get_context('spawn')
        self._pipe, its = context.Pipe()
        with its:
            self._process = context.Process(target=_serve, args=(its,), daemon=True)
            self._process.start()

    def do(self, call: Callable[[], Any]) -> tuple[BaseException | None, Any]:
        """What a call raises or returns there; EOFError or OSError where the process dies."""
        self._pipe.send(call)
        error, result = self._pipe.recv()
        return error, result

    def kill(self) -> None:
        """End it at once."""
        self._process.kill()

    def close(self) -> None:
        """Let it end, and wait until it has."""
        self._pipe.close()
        self._process.join()


def _serve(pipe: Any) -> None:
    """Do what comes through a pipe until that ends."""
    _begin()
    with contextlib.suppress(EOFError, OSError), ThreadPoolExecutor(1) as thread:
        while True:
            future = thread.submit(pipe.recv())
            error = future.exception()
            pipe.send((error, None if error else future.result()))


def _begin() -> None:
    """Let a worker end with its parent, however that ends, and leave signals of the terminal to it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, [signal.SIGINT])
    cv2.setNumThreads(1)  # there are as many workers as processors
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
        WorkersError: Dask is not installed, nobody answers there, or the workers are none or have another version.
    """
    try:
        from distributed import Client, KilledWorker
        from distributed.comm import CommClosedError
    except ImportError:
        raise WorkersError("Dask is not installed: install the extra 'fleet'") from None
    for name in LOGGERS:
        logging.getLogger(name).setLevel(logging.CRITICAL + 1)
    try:
        client = Client(address, timeout=ANSWER)
    except (OSError, TimeoutError, ValueError) as error:
        raise WorkersError(f'no Dask scheduler answers at {address}: {error}') from None
    cluster = _Cluster(address, client)
    broken = (BrokenExecutor, CancelledError, CommClosedError, KilledWorker)
    return Workers(cluster.count(), cluster.executor, broken, cluster.look)


class _Cluster:
    """A Dask cluster that is looked after: what is given to one without scheduler would never be done."""

    def __init__(self, address: str, client: Any) -> None:
        self._address = address
        self._client = client
        self._seen = time.monotonic()

    def count(self) -> int:
        """How many pieces of work are done at a time.

        Raises:
            WorkersError: There are no workers, or they are no use.
        """
        try:
            versions = set(self._client.run(importlib.metadata.version, PACKAGE).values())
        except (ImportError, OSError) as error:
            self._close()
            raise WorkersError(f'workers of the Dask cluster at {self._address} lack {PACKAGE}: {error}') from None
        number = sum(self._client.nthreads().values())
        own = importlib.metadata.version(PACKAGE)
        if not number or versions != {own}:
            self._close()
            raise WorkersError(f'the Dask cluster at {self._address} has no workers' if not number else
                               f'workers of the Dask cluster at {self._address} have {PACKAGE} '
                               f'{", ".join(sorted(versions))}, but here it is {own}')
        return number

    @contextlib.contextmanager
    def executor(self) -> Iterator[Executor]:
        """Its executor; what was not begun is given back at the end, the connection stays for the next.

        Raises:
            WorkersError: The scheduler has not come back.
        """
        end = time.monotonic() + RETURN
        while self._client.status != 'running':
            if self._client.status == 'closed' or time.monotonic() > end:
                self._close()
                raise WorkersError(f'the Dask scheduler at {self._address} does not answer any more')
            time.sleep(LOOK / 10)
        self._seen = time.monotonic()
        executor = self._client.get_executor(pure=False)
        try:
            yield executor
        finally:
            with contextlib.suppress(Exception):  # there may be nobody any more to give it back to
                executor.shutdown(wait=False)

    def look(self) -> None:
        """See that there is a scheduler, and workers.

        Raises:
            BrokenExecutor: There is no scheduler at present.
            WorkersError: The workers are gone, and no others came.
        """
        if self._client.status != 'running':
            raise BrokenExecutor
        if self._client.nthreads():
            self._seen = time.monotonic()
        elif time.monotonic() > self._seen + REPLACEMENT:
            self._close()
            raise WorkersError(f'the Dask cluster at {self._address} has had no workers for {REPLACEMENT:g} s')

    def _close(self) -> None:
        with contextlib.suppress(Exception):  # it may have closed itself meanwhile
            self._client.close(timeout=1)


def in_order(
    workers: Workers, work: Callable[..., bytes], pieces: Iterable[Piece],
    more: Callable[[Piece, bytes], list[Piece]] = lambda *_: [],
) -> Generator[bytes, None, None]:
    """Results of the work on each piece, in the order of the pieces; only so many at a time as keep the workers busy.

    Args:
        workers: Who does it.
        work: A function that can be sent to another process.
        pieces: Its arguments.
        more: What pieces a piece leaves to be done right after it, from its result.

    Raises:
        WorkersError: Those who work on a piece die again and again.
        Exception: What the work raised.
    """
    remaining = deque(pieces)
    attempts = 0
    while remaining:
        attempts += 1
        with contextlib.suppress(*workers.broken), workers.make() as executor:
            for result in _results(executor, work, remaining, more, workers):
                attempts = 0
                yield result
        if attempts == ATTEMPTS:
            raise WorkersError(KILLED)


def _results(
    executor: Executor, work: Callable[..., bytes], remaining: 'deque[Piece]',
    more: Callable[[Piece, bytes], list[Piece]], workers: Workers,
) -> Iterator[bytes]:
    """Take from what remains piece by piece, as each is done; the others are under way."""
    ahead = 2 * workers.count
    under_way: deque[Future[bytes]] = deque(executor.submit(work, *piece) for piece in list(remaining)[:ahead])
    while under_way:
        result = _result(under_way.popleft(), workers.look)
        left = more(remaining.popleft(), result)
        remaining.extendleft(reversed(left))
        yield result  # before anything that fails when workers died, or it would be lost
        under_way.extendleft(reversed([executor.submit(work, *piece) for piece in left]))
        while len(under_way) < min(ahead, len(remaining)):
            under_way.append(executor.submit(work, *remaining[len(under_way)]))


def _result(future: 'Future[bytes]', look: Callable[[], None]) -> bytes:
    while not concurrent.futures.wait([future], LOOK).done:
        look()
    return future.result()
