"""Inputs of what reads parameters, from files and the command line, and what must come of them."""

from pathlib import Path
from random import Random
from typing import Any

import yaml
from mutations import mutated
from typer.testing import CliRunner

from line_feature_node import cli_options
from line_feature_node.cli import app
from line_feature_node.core import Parameters
from line_feature_node.options import Options

CONFIG = [path.read_bytes() for path in sorted((Path(__file__).parents[2] / 'config').glob('*.yaml'))]
NAMES = [*Parameters.specs(), *Options.specs()]
#: Scalars as YAML has them, with the tags and the notations that are seldom used.
SCALARS = (
    '1', '1.0', '-0.0', '.nan', '.inf', '-.inf', 'nan', '1e400', '9' * 400, '9' * 5000, '0x' + 'f' * 5000, '0b1', '017',
    '1_000', '1:30', '1:' * 200 + '30', '1:' * 200 + '30.5', '~', '', 'yes', 'true', 'No', 'deriche', '"deriche"',
    'paper', '"\\ud800"', '"\\0"', "'x'", '2001-01-01', '2001-99-99', '2001-01-01T25:00:00Z', '!!int ""', '!!int x',
    '!!float ""', '!!float x', '!!bool x', '!!timestamp x', '!!binary "ü"', '!!binary "AAA"', '!!null x', '!!set {a}',
    '!!omap [a: 1]', '!!pairs [a]', '!!str 5', '!!python/object:os.system x', '!x y', '<<', '=', '*a', '&a 1', '[]',
    '[1, 2, 3, 4]', '[0.0, 0.0, 0.5, 0.5]', '[.nan, 0, 1, 1]', '[*a, *a]', '{}', '{a: 1}', '{<<: *a}', '{[1]: 2}',
    '? [1]', '|\n  text', '>\n  text', '%', '@', '`', '\t', '\x07', '🚗', '#', '!!map [1]', '!!seq {1: 2}')
KEYS = ('ros__parameters', '/**', 'node', '<<', '1', '~', '', '.nan', '[a]', 'qos_overrides', '&a k', '*a', '!!int ""')


def parameter_file(draw: Random) -> dict[str, Any]:
    """The content of a parameter file."""
    kind = draw.random()
    if kind < 0.4:
        text = mutated(draw.choice(CONFIG), draw)
    elif kind < 0.9:
        text = _settings(draw).encode('utf-8', 'surrogatepass')
    elif kind < 0.95:
        text = _nested(draw).encode()
    else:
        text = draw.randbytes(draw.randint(0, 60))
    if draw.random() < 0.1:
        text = mutated(text, draw)
    return {'text': text}


def _settings(draw: Random) -> str:
    """A file with some parameters in it, in blocks."""
    anchor = draw.choice(('', '', '&a ', '&a &b '))
    lines = [f'{draw.choice(("/**", "node", draw.choice(KEYS)))}: {anchor}',
             f'  {"ros__parameters" if draw.random() < 0.9 else draw.choice(KEYS)}:']
    for _ in range(draw.randint(0, 4)):
        name = draw.choice(NAMES if draw.random() < 0.9 else KEYS)
        lines.append(f'    {name}: {draw.choice(SCALARS) if draw.random() < 0.8 else _plain(draw)}')
    if draw.random() < 0.2:
        lines.append(draw.choice(('---', '...', '%YAML 1.1', '<<: *a', 'other: *a', '/b:\n  ros__parameters: 5')))
    return '\n'.join(lines)


def _plain(draw: Random) -> str:
    return yaml.safe_dump(draw.choice((draw.uniform(-10, 10), draw.randint(-10, 10), draw.random() * 10.0**draw.randint(
        -300, 300), draw.getrandbits(80)))).split('\n')[0]


def _nested(draw: Random) -> str:
    """Much of little: what stands in itself, in many places at once, or very deep."""
    depth = draw.choice((3, 30, 300, 2000))
    kind = draw.randrange(5)
    if kind == 0:
        return '{a: ' * depth + '1' + '}' * depth
    if kind == 1:
        return '[' * depth + ']' * depth
    if kind == 2:
        return '/**:\n  ros__parameters:\n' + ''.join(f'{"  " * (2 + level)}a:\n' for level in range(min(depth, 300)))
    start = 'a0: &a0 {ros__parameters: {alpha: 1.0}}' if kind == 3 else 'a0: &a0 [x, x]'
    both = '{{x: *a{0}, y: *a{0}}}' if kind == 3 else '[*a{0}, *a{0}]'
    lines = [start, *(f'a{level}: &a{level} {both.format(level - 1)}' for level in range(1, min(depth, 60)))]
    return '\n'.join([*lines, f'/**: {{ros__parameters: {{roi: *a{len(lines) - 1}}}}}'])


def check_parameter_file(fields: dict[str, Any], folder: Path) -> int:
    """What becomes of a parameter file."""
    path = folder / 'parameters.yaml'
    path.write_bytes(fields['text'])
    given, profile, options = cli_options._parameters(path, None, {})
    assert isinstance(given, Parameters)
    assert isinstance(options, Options)
    assert profile == options.profile
    return 0


WORDS = ('1', '-1', '0', 'nan', 'inf', '-inf', '1e400', '9' * 400, '1_000', '0x10', 'true', 'yes', '', ' ', 'deriche',
         'paper', '--', '-', '\udcff', 'ü', '\n', '[1, 2]', '1,2', '0.5', '--alpha', '--help', '٣', '1e-320')


def arguments(draw: Random) -> dict[str, Any]:
    """A command line of `line_features image`, whose image is not there."""
    words = ['image', 'missing.png', '--out', 'missing']
    for _ in range(draw.randint(0, 4)):
        name = draw.choice([*Parameters.specs(), 'profile', 'params-file', 'nothing', 'no-refine'])
        option = f'--{name}{draw.choice(("", "", "="))}'
        count = draw.choice((0, 1, 1, 1, 4)) if name != 'roi' else draw.choice((0, 1, 4, 4, 4))
        values = [draw.choice(WORDS) if draw.random() < 0.5 else str(draw.uniform(-2, 9)) for _ in range(count)]
        words += [option + values[0], *values[1:]] if option.endswith('=') and values else [option, *values]
    return {'words': words}


def check_arguments(fields: dict[str, Any], folder: Path) -> int:
    """How the command ends: by a status, never by an exception."""
    (folder / 'missing.png').unlink(missing_ok=True)
    outcome = CliRunner().invoke(app, fields['words'])
    if outcome.exception is not None and not isinstance(outcome.exception, SystemExit):
        raise AssertionError(f'the command ended with {outcome.exception!r}') from outcome.exception
    assert outcome.exit_code in (0, 2)
    assert 'Traceback' not in outcome.output
    return 0
