"""Threads that share the work on one frame."""

import threading
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
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

        helpers = [self._pool().submit(help_out, thread) for thread in range(1, min(self.size, len(todo)))]
        try:
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
        helpers: list[Future[T]] = []
        own: dict[int, T] = {}
        try:
            for piece in pieces:
                made.append(piece)
                helpers.append(self._pool().submit(work, *piece))
            for number, helper in enumerate(helpers):
                if helper.cancel():
                    own[number] = work(*made[number])
        finally:
            errors = _ended(helpers)
        for error in errors:
            raise error
        return [own[number] if number in own else helper.result() for number, helper in enumerate(helpers)]

    def shares(self, size: int, unit: int = 1) -> list[tuple[int, int]]:
        """Divide a list, of whole units and a rest, into pieces: where each begins and ends. None is empty.

        There are more pieces than threads, as these may be differently fast; one thread has one piece.
        """
        count = 1 if self.size == 1 else PIECES * self.size
        bounds = [k * (size // unit) // count * unit for k in range(count)] + [size]
        return [(first, end) for first, end in pairwise(bounds) if first < end]

    def _pool(self) -> ThreadPoolExecutor:
        """The other threads; a process that was forked off has none of those of its parent, and gets its own."""
        if self._others is None or not all(thread.is_alive() for thread in self._threads):
            threads: list[threading.Thread] = []
            self._others = ThreadPoolExecutor(
                self.size - 1, 'extractor', lambda: threads.append(threading.current_thread()))
            self._threads = threads
        return self._others


def _ended(helpers: 'list[Future[Any]]') -> list[BaseException]:
    """Wait until nobody works any more, as the memory is used again; what has not begun is left. Return the errors."""
    errors = [helper.exception() for helper in helpers if not helper.cancel()]
    return [error for error in errors if error is not None]


#: The calling thread and no other.
ALONE = Team(1)
