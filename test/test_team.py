"""Threads that share the work on one frame: all pieces are done, in their order, at the same time, errors included."""

import gc
import multiprocessing
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from typing import Any

import pytest

from line_feature_node.core.team import ALONE, Team


@pytest.mark.parametrize('team', [ALONE, Team(2), Team(5)], ids=['1', '2', '5'])
def test_results_are_in_the_order_of_the_pieces(team: Team) -> None:
    def work(number: int, pause: float) -> int:
        time.sleep(pause)
        return number * number

    for count in (0, 1, 2, 3, 20):
        pieces = [(k, 0.002 * (k % 3)) for k in range(count)]
        assert team.each(work, pieces) == [k * k for k in range(count)]


def test_pieces_are_done_at_the_same_time() -> None:
    """Each waits for the others: one thread after the other would wait for ever."""
    barrier = threading.Barrier(3)
    names = Team(3).each(lambda: (barrier.wait(10), threading.current_thread())[1], [(), (), ()])
    assert len(set(names)) == 3
    assert threading.current_thread() in names


def test_one_thread_is_the_calling_one() -> None:
    assert ALONE.each(threading.current_thread, [(), ()]) == [threading.current_thread()] * 2


@pytest.mark.parametrize('bad', range(6))
def test_an_error_is_raised_when_all_is_quiet(bad: int) -> None:
    """What was begun has ended by then, and the team works on."""
    team, busy = Team(3), []

    def work(number: int) -> int:
        busy.append(number)
        try:
            time.sleep(0.01)
            if number == bad:
                raise ValueError(f'piece {number}')
            return number
        finally:
            busy.remove(number)

    with pytest.raises(ValueError, match=f'piece {bad}'):
        team.each(work, [(k,) for k in range(6)])
    assert not busy
    assert team.each(abs, [(-1,), (-2,)]) == [1, 2]


def test_each_thread_has_a_tool_of_its_own() -> None:
    """No two pieces have one at the same time."""
    tools, busy = [[], [], []], threading.Barrier(3)

    def work(number: int, tool: list[int]) -> int:
        if number < 3:
            busy.wait(10)
        tool.append(number)
        return id(tool)

    used = Team(3).each(work, [(k,) for k in range(12)], tools)
    assert len(set(used[:3])) == 3
    assert sorted(number for tool in tools for number in tool) == list(range(12))


@pytest.mark.parametrize('team', [ALONE, Team(2), Team(4)], ids=['1', '2', '4'])
@pytest.mark.parametrize('slow', [0, 0.003], ids=['made at once', 'made slowly'])
def test_what_is_piped_comes_in_order(team: Team, slow: float) -> None:
    def made() -> Iterator[tuple[int]]:
        for k in range(9):
            time.sleep(slow)
            yield (k,)

    def work(number: int) -> int:
        time.sleep(0.002 * (number % 3))
        return number * number

    assert team.pipe(work, made()) == [k * k for k in range(9)]
    assert team.pipe(work, iter(())) == []


def test_a_piece_is_worked_on_while_the_next_is_made() -> None:
    begun = threading.Event()

    def made() -> Iterator[tuple[threading.Event]]:
        yield (begun,)
        assert begun.wait(10)
        yield (threading.Event(),)

    Team(2).pipe(threading.Event.set, made())


@pytest.mark.parametrize('team', [ALONE, Team(3)], ids=['1', '3'])
@pytest.mark.parametrize('bad', [0, 4, 7])
def test_an_error_in_what_is_piped_is_raised(team: Team, bad: int) -> None:
    busy: list[int] = []

    def work(number: int) -> int:
        busy.append(number)
        try:
            time.sleep(0.005)
            return 1 // (number - bad)
        finally:
            busy.remove(number)

    with pytest.raises(ZeroDivisionError):
        team.pipe(work, ((k,) for k in range(8)))
    assert not busy
    with pytest.raises(ZeroDivisionError):
        team.pipe(work, ((k // (k - bad) + 100,) for k in range(8)))
    assert not busy
    assert team.pipe(abs, [(-1,), (-2,)]) == [1, 2]


@pytest.mark.parametrize('size', [0, 1, 15, 16, 100, 1000])
@pytest.mark.parametrize('unit', [1, 16])
def test_shares_are_whole_units_and_a_rest(size: int, unit: int) -> None:
    for team in (ALONE, Team(2), Team(7)):
        shares = team.shares(size, unit)
        assert [k for first, end in shares for k in range(first, end)] == list(range(size))
        assert all(first % unit == 0 and first < end for first, end in shares)
        assert all(end % unit == 0 for _, end in shares[:-1])
    assert ALONE.shares(size, unit) == ([(0, size)] if size else [])


def test_threads_end_with_their_team() -> None:
    team, barrier = Team(4), threading.Barrier(4)
    names = team.each(lambda: (barrier.wait(10), threading.current_thread())[1], [()] * 4)
    others = set(names) - {threading.current_thread()}
    assert len(others) == 3
    assert all(thread.is_alive() for thread in others)
    del team
    gc.collect()
    for thread in others:
        thread.join(10)
        assert not thread.is_alive()


def _in_child(team: Team, answers: Any) -> None:
    barrier = threading.Barrier(2)
    answers.put(len(set(team.each(lambda: (barrier.wait(10), threading.get_ident())[1], [(), ()]))))


@pytest.mark.filterwarnings('ignore:.*fork:DeprecationWarning')
def test_a_forked_process_has_threads_of_its_own() -> None:
    """Those of its parent do not exist in it; it would work alone."""
    team, context = Team(2), multiprocessing.get_context('fork')
    assert team.each(abs, [(-1,), (-2,)]) == [1, 2]
    answers = context.Queue()
    child = context.Process(target=_in_child, args=(team, answers))
    child.start()
    assert answers.get(timeout=20) == 2
    child.join(20)
    assert child.exitcode == 0


@pytest.mark.parametrize('there', [0, 2])
def test_where_no_more_threads_start_the_calling_one_works_alone(there: int, monkeypatch: pytest.MonkeyPatch) -> None:
    start, started = threading.Thread.start, []

    def refuse(thread: threading.Thread) -> None:
        if len(started) == there:
            raise RuntimeError("can't start new thread")
        started.append(thread)
        start(thread)

    monkeypatch.setattr(threading.Thread, 'start', refuse)
    team = Team(4)
    for _ in range(2):
        assert set(team.each(threading.current_thread, [()] * 6)) == {threading.current_thread()}
        assert team.pipe(abs, ((-k,) for k in range(6))) == [0, 1, 2, 3, 4, 5]
        started.clear()


def test_work_goes_on_when_the_main_thread_has_ended() -> None:
    """No thread can be asked for help then."""
    code = """
import threading, time
from line_feature_node.core.team import Team

team = Team(2)
print(team.each(abs, [(-1,), (-2,)]))

def late():
    threading.main_thread().join()
    time.sleep(0.2)
    print(team.each(abs, [(-3,), (-4,)]), team.pipe(abs, [(-5,), (-6,)]))

threading.Thread(target=late).start()
"""
    ended = subprocess.run([sys.executable, '-c', code], capture_output=True, text=True, timeout=60, check=True)
    assert (ended.stdout, ended.stderr) == ('[1, 2]\n[3, 4] [5, 6]\n', '')


@pytest.mark.parametrize('way', ['each', 'pipe'])
@pytest.mark.parametrize('pause', [0, 0.2], ids=['at work', 'while it waits'])
def test_an_interrupt_waits_for_the_others(way: str, pause: float) -> None:
    """They write into memory that the next frame uses."""
    team, began, quiet = Team(2), threading.Event(), threading.Event()
    main = threading.get_ident()

    def work(_: int) -> None:
        if threading.get_ident() == main:
            began.wait(10)
            return
        began.set()
        time.sleep(pause)
        signal.pthread_kill(main, signal.SIGINT)
        time.sleep(0.3)
        quiet.set()

    # Tests that run in the background do not heed interrupts unless told to.
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        with pytest.raises(KeyboardInterrupt):
            getattr(team, way)(work, [(1,), (2,)])
    finally:
        signal.signal(signal.SIGINT, before)
    assert quiet.is_set()
