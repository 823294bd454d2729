"""Threads that share the work on one frame."""

import contextlib
import threading
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, wait
from itertools import pairwise
from typing import Any, TypeVar

T = TypeVar('T')
#: Pieces of work for each thread.
PIECES = 2


class Team:
    """Some threads, of which the calling one is the first.

    The others wait for work and end with the team. As kernels run without the GIL, they work at the same time.

    Attributes:
        size: How many there are.
    """

    def __init__(self, size: int) -> None:
        self.size = size
        self._others: ThreadPoolExecutor | None = None
        self._threads: list[threading.Thread] = []

    def each(self, work: Callable[..., T], pieces: Iterable[tuple[Any, ...]], tools: Sequence[Any] = ()) -> list[T]:
        """Do each piece of work, as many at the same time as there are threads; none may touch what others write.

        Args:
            work: Is called with the arguments of each piece.
            pieces: Arguments.
            tools: If given, one for each thread, which it passes to `work` after the arguments.

        Returns:
            The results, in the order of the pieces.

        Raises:
            What `work` raises: of several errors one.
        """
        if self.size == 1:
            return [work(*piece, *tools[:1]) for piece in pieces]
        todo = deque(enumerate(pieces))
        results: dict[int, T] = {}

        def help_out(thread: int) -> None:
            tool = tools[thread:thread + 1]
            while todo:
                try:
                    number, piece = todo.popleft()
                except IndexError:  # another thread took the last one
                    return
                results[number] = work(*piece, *tool)

        helpers: list[Future[None]] = []
        try:
            for thread in range(1, min(self.size, len(todo))):
                helpers += self._begin(help_out, thread)
            help_out(0)
        finally:
            todo.clear()
            errors = _ended(helpers)
        for error in errors:
            raise error
        return [results[number] for number in range(len(results))]

    def pipe(self, work: Callable[..., T], pieces: Iterable[tuple[Any, ...]]) -> list[T]:
        """Do each piece of work while the calling thread, which helps afterwards, makes the next ones.

        Args:
            work: Is called with the arguments of each piece; it must not touch what others write.
            pieces: Arguments, as an iterator makes them.

        Returns:
            The results, in the order of the pieces.

        Raises:
            What `work` or `pieces` raises: of several errors one.
        """
        if self.size == 1:
            return [work(*piece) for piece in pieces]
        made: list[tuple[Any, ...]] = []
        helpers: dict[int, Future[T]] = {}
        own: dict[int, T] = {}
        try:
            for number, piece in enumerate(pieces):
                made.append(piece)
                for helper in self._begin(work, *piece):
                    helpers[number] = helper
            for number, piece in enumerate(made):
                if number not in helpers or helpers[number].cancel():
                    own[number] = work(*piece)
        finally:
            errors = _ended([*helpers.values()])
        for error in errors:
            raise error
        return [own[number] if number in own else helpers[number].result() for number in range(len(made))]

    def shares(self, size: int, unit: int = 1) -> list[tuple[int, int]]:
        """Divide a list, of whole units and a rest, into pieces: where each begins and ends. None is empty.

        There are more pieces than threads, as these may be differently fast; one thread has one piece.
        """
        count = 1 if self.size == 1 else PIECES * self.size
        bounds = [k * (size // unit) // count * unit for k in range(count)] + [size]
        return [(first, end) for first, end in pairwise(bounds) if first < end]

    def _begin(self, work: Callable[..., T], *arguments: Any) -> 'list[Future[T]]':
        """Have another thread do a piece of work; none where there are no others, or no more as the process ends."""
        # A process that was forked off has none of the threads of its parent.
        if self._others is None or not all(thread.is_alive() for thread in self._threads):
            self._threads = []
            self._others = _started(self.size - 1, self._threads)
        with contextlib.suppress(RuntimeError):
            return [self._others.submit(work, *arguments)] if self._threads else []
        return []


def _started(count: int, threads: list[threading.Thread]) -> ThreadPoolExecutor:
    """So many threads, which are put on the list; none where the system has not so many."""
    pool, all_there = ThreadPoolExecutor(count, 'extractor'), threading.Event()

    def appear() -> None:
        all_there.wait()
        threads.append(threading.current_thread())

    try:
        waiting = [pool.submit(appear) for _ in range(count)]
    except RuntimeError:
        pool.shutdown(wait=False, cancel_futures=True)
        waiting = []
    all_there.set()
    wait(waiting)
    return pool


def _ended(helpers: 'list[Future[Any]]') -> list[BaseException]:
    """Wait until nobody works any more, as the memory is used again; what has not begun is left. Return the errors."""
    busy = [helper for helper in helpers if not helper.cancel()]
    _wait_for_all(busy)
    return [error for error in (helper.exception() for helper in busy) if error is not None]


def _wait_for_all(helpers: 'list[Future[Any]]') -> None:
    """Wait for their end, however often somebody presses Ctrl-C meanwhile; the interrupt is raised then."""
    try:
        wait(helpers)
    finally:
        if not all(helper.done() for helper in helpers):
            _wait_for_all(helpers)


#: The calling thread and no other.
ALONE = Team(1)
