"""The fuzzing campaign in its short form, and that it finds what it is for."""

import subprocess
import sys
from pathlib import Path

FUZZ = Path(__file__).resolve().parent / 'fuzz'
#: A campaign over a door that is broken, each input in a way of its own.
BROKEN = """
import os, signal, sys, time, warnings
sys.path.insert(0, {folder!r})
import campaign
from doors import Door

def check(fields, folder):
    number = fields['number']
    if number == 2:
        raise KeyError('no documented error')
    if number == 3:
        os.kill(os.getpid(), signal.SIGSEGV)
    if number == 4:
        time.sleep(60)
    if number == 5:
        return len(b'x' * 200 * 2**20) * 0
    if number == 6:
        warnings.warn('told on the console')
    if number == 7:
        raise ValueError('said by the one who tries')
    return 0 if number % 2 else -1

campaign.PATIENCE = 1.0
campaign.DOORS.clear()
campaign.draw_of = lambda door, seed, number: number
campaign.DOORS['broken'] = Door(lambda number: {{'number': number, 'data': b'content'}}, check, 1)
sys.exit(campaign.main())
"""


def run(arguments, folder):
    return subprocess.run([sys.executable, *arguments, '--results', str(folder)],
                          capture_output=True, text=True, check=False, timeout=300)


def row(ended, name):
    [line] = [line for line in ended.stdout.splitlines() if line.startswith(f'| {name} |')]
    return [cell.strip() for cell in line.strip('|').split('|')]


def test_every_door_ends_as_documented(tmp_path):
    ended = run([str(FUZZ / 'campaign.py'), '--inputs', '5000', '--seed', '7'], tmp_path)
    assert ended.returncode == 0, ended.stdout + ended.stderr
    for door in ('image', 'compressed', 'segments', 'extractor', 'parameters', 'arguments', 'remains', 'recording'):
        tried, results, refused = map(int, row(ended, door)[1:4])
        assert tried == results + refused
        assert results > tried // 50, f'hardly an input of {door} is good enough to be taken'


def test_what_is_broken_is_found(tmp_path):
    ended = run(['-c', BROKEN.format(folder=str(FUZZ)), '--inputs', '10'], tmp_path)
    assert ended.returncode == 1, ended.stdout + ended.stderr
    assert row(ended, 'broken')[1:5] == ['10', '2', '2', '6']
    kinds = {(tmp_path / 'broken' / str(number) / 'finding.txt').read_text().splitlines()[0] for number in range(2, 8)}
    assert {kind.partition(' in ')[0] for kind in kinds} == {
        'KeyError', 'the process was ended by SIGSEGV', 'it hangs', 'memory', 'UserWarning', 'no sentence: ValueError'}
    assert (tmp_path / 'broken' / '3' / 'data.bin').read_bytes() == b'content'


def test_inputs_follow_from_the_seed(tmp_path):
    arguments = [str(FUZZ / 'campaign.py'), '--doors', 'image', '--number', '17', '--seed']
    first, again, other = (run([*arguments, seed], tmp_path).stdout for seed in ('1', '1', '2'))
    assert first == again != other
