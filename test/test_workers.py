"""Workers that are processes of this machine, or of a Dask cluster, and what becomes of the work when they die."""

import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections import Counter
from concurrent.futures import BrokenExecutor, ThreadPoolExecutor
from multiprocessing import connection
from pathlib import Path

import pytest

from line_feature_node import workers
from line_feature_node.workers import ATTEMPTS, Workers, WorkersError, cluster, in_order, inline, local

#: Seconds after which something that a test waits for will not come any more.
DEADLINE = 30.0
HERE = Path(__file__).parent
#: For other processes, which find what this one finds.
ENVIRONMENT = {**os.environ, 'PYTHONPATH': os.pathsep.join([str(HERE), *filter(None, sys.path)])}


def until(condition, what, deadline=DEADLINE):
    end = time.monotonic() + deadline
    while not condition():
        assert time.monotonic() < end, f'{what}: waited {deadline:g} s for it'
        time.sleep(0.01)


# Work, which other processes find by its name

def double(number):
    return str(2 * number).encode()


def slow_first(number):
    time.sleep(0.2 if number == 0 else 0)
    return double(number)


def fail(number):
    if number == 3:
        raise KeyError('the work itself')
    return double(number)


def mark(number, folder):
    """Leave a file of one's own for each time the work is done."""
    done = len(list(folder.glob(f'{number}-*')))
    (folder / f'{number}-{done}-{os.getpid()}').touch()
    return done


def die_once(number, folder):
    """The second piece of work kills who does it, the first time."""
    if mark(number, folder) == 0 and number == 1:
        os.kill(os.getpid(), signal.SIGKILL)
    return double(number)


def die_always(number, folder):
    mark(number, folder)
    if number == 2:
        os.kill(os.getpid(), signal.SIGKILL)
    return double(number)


def sleep(number, folder):
    mark(number, folder)
    time.sleep(60)
    return double(number)


def who(number):
    return str(os.getpid()).encode()


def ignores_interrupts(number):
    os.kill(os.getpid(), signal.SIGINT)
    return double(number)


def times(folder):
    """How often each piece of work was begun."""
    return Counter(int(path.name.split('-')[0]) for path in folder.iterdir())


def processes(folder):
    return {int(path.name.split('-')[2]) for path in folder.iterdir()}


def alive(pid):
    try:
        return Path(f'/proc/{pid}/stat').read_text().rpartition(')')[2].split()[0] not in 'ZX'
    except OSError:
        return False


def pieces(count, *more):
    return [(number, *more) for number in range(count)]


def doubles(count):
    return [double(number) for number in range(count)]


def threads(count):
    return Workers(count, lambda: ThreadPoolExecutor(count))


# Order, and how much is under way

@pytest.mark.parametrize('crew', [inline(), threads(3)], ids=['inline', 'threads'])
@pytest.mark.parametrize('count', [0, 1, 2, 50])
def test_results_come_in_the_order_of_the_pieces(crew, count):
    assert list(in_order(crew, slow_first, pieces(count))) == doubles(count)


def test_pieces_may_be_any_iterable_and_have_any_number_of_arguments():
    assert list(in_order(inline(), lambda *numbers: bytes(numbers), iter([(), (1,), (1, 2)]))) == [b'', b'\1', b'\1\2']


def test_only_so_many_are_under_way_as_keep_the_workers_busy():
    begun = []

    def work(number):
        begun.append(number)
        return b''

    for count in (1, 3):
        begun.clear()
        for done, _ in enumerate(in_order(threads(count), work, pieces(40)), 1):
            time.sleep(0.001)
            assert len(begun) <= done + 2 * count
        assert sorted(begun) == list(range(40))


def test_workers_are_all_busy_at_a_time():
    together = threading.Barrier(3, timeout=DEADLINE)

    def work(number):
        together.wait()
        return double(number)

    assert list(in_order(threads(3), work, pieces(6))) == doubles(6)


def test_an_exception_of_the_work_passes_through_after_the_results_before_it():
    results = in_order(threads(2), fail, pieces(9))
    assert [next(results) for _ in range(3)] == doubles(3)
    with pytest.raises(KeyError, match='the work itself'):
        next(results)


def leaves(piece, result):
    """What is left of a number: all that are half of it or less, halved again and again."""
    [number] = piece
    return [(number // 2,), (number // 3,)] if number else []


def expected(number):
    return [double(number), *(each for [part] in leaves((number,), b'') for each in expected(part))]


@pytest.mark.parametrize('crew', [inline(), threads(3)], ids=['inline', 'threads'])
def test_what_a_piece_leaves_to_be_done_comes_right_after_it(crew):
    found = list(in_order(crew, double, pieces(20), leaves))
    assert found == [each for number in range(20) for each in expected(number)]


def test_what_a_piece_leaves_to_be_done_is_done_when_workers_die(tmp_path):
    results = in_order(local(2), die_and_leave, [(tmp_path, 9), (tmp_path, 5)],
                       lambda piece, _: [(tmp_path, each) for [each] in leaves(piece[1:], b'')])
    assert list(results) == [*expected(9), *expected(5)]


def die_and_leave(folder, number):
    return die_once(number, folder)


def test_who_stops_early_does_not_have_the_rest_done():
    begun = []

    def work(number):
        begun.append(number)
        return b''

    before = set(threading.enumerate())
    results = in_order(inline(), work, pieces(100))
    next(results)
    results.close()
    assert len(begun) <= 4
    assert len(set(threading.enumerate()) - before) < 4


def test_inline_is_this_process():
    assert list(in_order(inline(), who, pieces(3))) == [str(os.getpid()).encode()] * 3
    assert inline().count == 1


def test_there_are_as_many_workers_as_processors_unless_a_number_is_given():
    assert local().count == len(os.sched_getaffinity(0))
    assert local(7).count == 7


# Processes

def test_processes_do_the_work_in_order_and_leave_interrupts_to_their_parent():
    assert list(in_order(local(2), ignores_interrupts, pieces(9))) == doubles(9)
    [pid] = set(in_order(local(1), who, pieces(4)))
    assert int(pid) != os.getpid()
    until(lambda: not alive(int(pid)), 'end of the worker')


def test_an_exception_in_another_process_passes_through():
    with pytest.raises(KeyError, match='the work itself'):
        list(in_order(local(1), fail, pieces(9)))


def test_the_work_of_a_killed_worker_is_done_again(tmp_path):
    assert list(in_order(local(2), die_once, pieces(12, tmp_path))) == doubles(12)
    assert times(tmp_path) == {number: 2 if number == 1 else 1 for number in range(12)}


def test_a_worker_that_is_killed_from_outside_costs_only_what_was_under_way(tmp_path):
    results = in_order(local(1), mark_and_double, pieces(30, tmp_path))
    found = [next(results) for _ in range(10)]
    [pid] = processes(tmp_path)
    os.kill(pid, signal.SIGKILL)
    found += results
    assert found == doubles(30)
    assert max(times(tmp_path).values()) <= 2
    assert all(count == 1 for number, count in times(tmp_path).items() if number < 10)


def mark_and_double(number, folder):
    mark(number, folder)
    time.sleep(0.005)
    return double(number)


def half(self, data, write=None):
    """Sends a part of what is to be sent, and dies."""
    os.write(self.fileno(), bytes(data)[:len(data) // 2])
    os.kill(os.getpid(), signal.SIGKILL)


def die_amid_the_result(number, folder):
    if mark(number, folder) == 0 and number == 1:
        connection.Connection._send = half
    return double(number) * 50_000


@pytest.mark.parametrize('count', [1, 2])
def test_a_worker_that_dies_amid_sending_its_result_is_not_waited_for(tmp_path, count):
    found = list(in_order(local(count), die_amid_the_result, pieces(12, tmp_path)))
    assert found == [double(number) * 50_000 for number in range(12)]


def long_result(number, folder):
    mark(number, folder)
    time.sleep(60 if number == 2 else 0)
    return bytes(1_000_000)


def test_who_stops_early_does_not_wait_for_the_rest(tmp_path):
    results = in_order(local(2), long_result, pieces(20, tmp_path))
    next(results)
    until(lambda: times(tmp_path)[2], 'work that takes long')
    begin = time.monotonic()
    results.close()
    assert time.monotonic() < begin + 30
    assert not any(map(alive, processes(tmp_path)))


def test_workers_that_die_each_time_are_an_error(tmp_path):
    results = in_order(local(1), die_always, pieces(5, tmp_path))
    assert [next(results) for _ in range(2)] == doubles(2)
    with pytest.raises(WorkersError, match=f'killed {ATTEMPTS} times in a row') as error:
        next(results)
    assert ATTEMPTS <= times(tmp_path)[2] <= ATTEMPTS + 1
    assert '\n' not in str(error.value)


def test_attempts_are_counted_anew_when_something_was_done():
    left = list(range(10))

    class Dying(ThreadPoolExecutor):
        """Does one piece of work and breaks."""

        def submit(self, work, *arguments):
            future = super().submit(work, *arguments)
            if arguments[0] != left[0]:
                future = super().submit(broken)
            return future

    def broken():
        raise BrokenExecutor

    found = []
    for result in in_order(Workers(1, lambda: Dying(1)), double, pieces(10)):
        found.append(result)
        left.pop(0)
    assert found == doubles(10)


@pytest.mark.parametrize('last', [2, 3, 5, 9])
def test_no_result_is_lost_when_workers_are_found_dead_as_work_is_given_out(last):
    calls = []

    class Dead(ThreadPoolExecutor):
        """Takes so many pieces of work and no more, once."""

        def submit(self, work, *arguments):
            calls.append(arguments)
            if len(calls) == last + 1:
                raise BrokenExecutor
            return super().submit(work, *arguments)

    assert list(in_order(Workers(1, lambda: Dead(1)), double, pieces(12))) == doubles(12)


def run(folder, code):
    """Another Python that has this module."""
    script = folder / 'parent.py'
    script.write_text(f'import sys\nsys.path.insert(0, {str(HERE)!r})\nfrom test_workers import *\n'
                      f'folder = Path({str(folder / "marks")!r})\nif __name__ == "__main__":\n    {code}\n')
    (folder / 'marks').mkdir()
    return subprocess.Popen([sys.executable, script], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
                            env=ENVIRONMENT)


def test_workers_end_when_their_parent_is_killed(tmp_path):
    parent = run(tmp_path, 'list(in_order(local(2), sleep, pieces(8, folder)))')
    try:
        until(lambda: len(processes(tmp_path / 'marks')) == 2 or parent.poll() is not None, 'two workers')
        children = processes(tmp_path / 'marks')
        assert parent.pid not in children
        assert all(map(alive, children))
    finally:
        parent.kill()
        parent.communicate(timeout=DEADLINE)
    until(lambda: not any(map(alive, children)), 'end of the workers', 5)
    before = times(tmp_path / 'marks')
    time.sleep(0.2)
    assert times(tmp_path / 'marks') == before


# Dask

def test_without_dask_the_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, 'distributed', None)
    with pytest.raises(WorkersError, match='fleet'):
        cluster('tcp://127.0.0.1:8786')


@pytest.mark.filterwarnings('default')
@pytest.mark.parametrize('address', ['tcp://127.0.0.1:9', '127.0.0.1:9', 'http://127.0.0.1:9', 'udp://x:9'])
def test_an_address_without_a_scheduler_is_a_sentence(distributed, address):
    with pytest.raises(WorkersError) as error:
        cluster(address)
    assert address in str(error.value)
    assert '\n' not in str(error.value)


class Fleet:
    """A cluster of Dask: a scheduler and workers that are processes of their own; nobody starts them anew."""

    def __init__(self, client, folder, count, **environment):
        self._place = folder / 'scheduler.json'
        self._environment = {**ENVIRONMENT, **environment}
        self.scheduler = self._start('scheduler', '--host', '127.0.0.1', '--port', '0')
        self.workers = []
        until(lambda: self._place.exists() and self._place.read_text().endswith('}'), 'scheduler of Dask')
        self.address = json.loads(self._place.read_text())['address']
        self._client = client
        self.add(count)

    def add(self, count):
        self.workers += [self._start('worker', '--nthreads', '1', '--no-nanny') for _ in range(count)]
        if self.workers:
            with self._client(self.address, timeout='10s') as client:
                client.wait_for_workers(count, timeout=DEADLINE)

    def _start(self, part, *more):
        return subprocess.Popen(
            [sys.executable, '-m', f'distributed.cli.dask_{part}', '--scheduler-file', self._place, '--no-dashboard',
             *more], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, env=self._environment,
            cwd=self._place.parent)

    def close(self):
        for process in (*self.workers, self.scheduler):
            process.kill()
            process.wait()


def test_a_cluster_does_the_work_in_order(fleet):
    fleet = fleet(2)
    crew = cluster(fleet.address)
    assert crew.count == 2
    assert list(in_order(crew, slow_first, pieces(20))) == doubles(20)
    assert set(in_order(crew, who, pieces(20))) <= {str(worker.pid).encode() for worker in fleet.workers}


def test_an_exception_in_a_cluster_passes_through(fleet):
    results = in_order(cluster(fleet(1).address), fail, pieces(9))
    assert [next(results) for _ in range(3)] == doubles(3)
    with pytest.raises(KeyError, match='the work itself'):
        next(results)


def test_a_cluster_that_loses_a_worker_has_the_same_results(fleet, tmp_path):
    fleet = fleet(2)
    (tmp_path / 'marks').mkdir()
    results = in_order(cluster(fleet.address), mark_and_double, pieces(100, tmp_path / 'marks'))
    found = [next(results) for _ in range(10)]
    assert len(processes(tmp_path / 'marks')) == 2
    fleet.workers[0].kill()
    found += results
    assert found == doubles(100)
    assert sum(count > 1 for count in times(tmp_path / 'marks').values()) <= 4


def exhaust(results, errors):
    try:
        list(results)
    except WorkersError as error:
        errors.append(error)


def error_of(results):
    """What the results end with; waited for by another thread, lest results that never end hold up the tests."""
    errors = []
    threading.Thread(target=exhaust, args=(results, errors), daemon=True).start()
    until(lambda: errors, 'error', 10)
    message = str(errors[0])
    assert '\n' not in message
    return message


def test_a_cluster_whose_workers_die_each_time_is_an_error(fleet, tmp_path):
    fleet = fleet(ATTEMPTS + 1, DASK_DISTRIBUTED__SCHEDULER__ALLOWED_FAILURES='0')
    (tmp_path / 'marks').mkdir()
    results = in_order(cluster(fleet.address), die_always, pieces(5, tmp_path / 'marks'))
    assert [next(results) for _ in range(2)] == doubles(2)
    assert f'killed {ATTEMPTS} times in a row' in error_of(results)


@pytest.fixture
def hasty(monkeypatch):
    """Nobody is waited for longer than a second."""
    monkeypatch.setattr(workers, 'RETURN', 1.0)
    monkeypatch.setattr(workers, 'REPLACEMENT', 1.0)


def test_a_cluster_whose_scheduler_ends_is_an_error(fleet, tmp_path, hasty):
    fleet = fleet(1)
    (tmp_path / 'marks').mkdir()
    crew = cluster(fleet.address)
    results = in_order(crew, mark_and_double, pieces(1000, tmp_path / 'marks'))
    next(results)
    fleet.scheduler.kill()
    assert error_of(results) == f'the Dask scheduler at {fleet.address} does not answer any more'
    assert 'does not answer any more' in error_of(in_order(crew, double, pieces(3)))


def test_a_cluster_whose_workers_have_all_ended_is_an_error(fleet, tmp_path, hasty):
    fleet = fleet(2)
    (tmp_path / 'marks').mkdir()
    results = in_order(cluster(fleet.address), mark_and_double, pieces(1000, tmp_path / 'marks'))
    next(results)
    for worker in fleet.workers:
        worker.kill()
    assert error_of(results) == f'the Dask cluster at {fleet.address} has had no workers for 1 s'


def test_new_workers_go_on_for_those_that_have_all_ended(fleet, tmp_path):
    fleet = fleet(1)
    (tmp_path / 'marks').mkdir()
    results = in_order(cluster(fleet.address), mark_and_double, pieces(50, tmp_path / 'marks'))
    found = [next(results) for _ in range(5)]
    fleet.workers[0].kill()
    fleet.add(1)
    assert found + list(results) == doubles(50)


def test_a_cluster_without_workers_is_a_sentence(fleet):
    with pytest.raises(WorkersError, match='has no workers'):
        cluster(fleet(0).address)


def test_workers_of_another_version_are_a_sentence(fleet, tmp_path):
    other = tmp_path / 'other' / 'line_feature_node-0.0.1.dist-info'
    other.mkdir(parents=True)
    (other / 'METADATA').write_text('Metadata-Version: 2.1\nName: line_feature_node\nVersion: 0.0.1\n')
    path = os.pathsep.join([str(other.parent), ENVIRONMENT['PYTHONPATH']])
    with pytest.raises(WorkersError, match=r'have line_feature_node 0\.0\.1, but here it is'):
        cluster(fleet(1, PYTHONPATH=path).address)


def test_workers_that_lack_the_package_are_a_sentence(fleet, monkeypatch):
    monkeypatch.setattr(workers, 'PACKAGE', 'no_such_package')
    with pytest.raises(WorkersError, match='lack no_such_package'):
        cluster(fleet(1).address)
