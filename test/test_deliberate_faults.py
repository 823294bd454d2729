"""The deliberate faults of bench/deliberate_faults.py are about what is written today, and one of them is found."""

import importlib.util
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
CORE = ROOT / 'line_feature_node' / 'core'
SPEC = importlib.util.spec_from_file_location('deliberate_faults', ROOT / 'bench' / 'deliberate_faults.py')
faults = importlib.util.module_from_spec(SPEC)
SPEC.loader.exec_module(faults)


def run(monkeypatch, *arguments):
    monkeypatch.setattr(sys, 'argv', ['deliberate_faults.py', *arguments])
    return faults.main()


def test_every_module_of_the_core_has_faults():
    assert set(faults.FAULTS) == {path.stem for path in CORE.glob('*.py')} - {'__init__'}
    assert sum(map(len, faults.FAULTS.values())) >= 50


@pytest.mark.parametrize('module', faults.FAULTS)
def test_texts_stand_once_in_their_module(module):
    text = (CORE / f'{module}.py').read_text(encoding='utf-8')
    for old, new in faults.FAULTS[module]:
        assert text.count(old) == 1, old
        assert old != new


def test_a_fault_is_found_and_the_sources_are_left_alone(monkeypatch, capsys):
    before = (CORE / 'indices.py').read_bytes()
    assert run(monkeypatch, '--module', 'indices', '--text', 'stride + 1') == 0
    [row] = capsys.readouterr().out.splitlines()[2:]
    assert row.split(' | ')[1:] == [
        '`stride - 1 <= step <= stride + 1`', '`stride - 1 <= step <= stride`', '`test_a_pixel_touches_eight_others` |']
    assert (CORE / 'indices.py').read_bytes() == before


def test_what_is_no_fault_is_not_found(monkeypatch, capsys):
    monkeypatch.setitem(faults.FAULTS, 'buffers', [('from typing import Any', 'from typing import Any  # the same')])
    monkeypatch.setattr(faults, 'FALLBACK', [])
    assert run(monkeypatch, '--module', 'buffers') == 1
    assert '| nothing |' in capsys.readouterr().out


@pytest.mark.parametrize('text', ['what nobody wrote', 'stride'])
def test_a_text_that_is_not_there_once_is_refused(monkeypatch, capsys, text):
    times = (CORE / 'indices.py').read_text(encoding='utf-8').count(text)
    assert times != 1
    monkeypatch.setitem(faults.FAULTS, 'indices', [(text, '')])
    assert run(monkeypatch, '--module', 'indices') == 2
    assert capsys.readouterr().err == f'indices.py has {times} times, not once: {text}\n'


def test_the_table_in_the_documents_is_of_these_faults():
    text = (ROOT / 'docs' / 'reliability.md').read_text(encoding='utf-8')
    section = text.split('## Deliberate faults')[1].split('\n## ')[0]
    rows = [row.rpartition(' | ')[0] for row in section.splitlines() if row.startswith('| ') and '`' in row]
    assert rows == [f'| {module} | {faults.shown(old)} | {faults.shown(new)}'
                    for module, pairs in faults.FAULTS.items() for old, new in pairs]
    assert f'All {len(rows)} are found' in section
