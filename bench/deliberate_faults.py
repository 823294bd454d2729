"""Put deliberate faults into a copy of the core, one at a time, and say which test finds each; Markdown.

    python bench/deliberate_faults.py [--module edges --module noise] [--text 'T1'] [--seconds 600]

For each fault the tests of its module run until one fails: first without the compiler, as to compile takes longer than
most of them do, then all. Where none fails, those of the pipeline and of equivariance do. It exits with 1
where a fault goes unnoticed, or a test that found one fails without it, too, and with 2 where a fault is not about what
is written today.
"""

import argparse
import os
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
#: What the tests of the core read.
PARTS = ('bags', 'config', 'docs', 'line_feature_node', 'test', 'pyproject.toml')
#: Text of each module that stands there once, and what is wrong in its place.
FAULTS = {
    'blobs': [
        ('(pixel + 1, pixel + stride - 1, pixel + stride, ', '(pixel + 1, pixel + stride, '),
        ('is_alike(marks, below + one, own))', '0)'),
        ('labels[run] = labels[labels[run]]', 'labels[run] = labels[run]'),
        ("max(blob['max_row'], part['max_row'])", "max(blob['max_row'], part['max_col'])"),
        ('top, bottom = min(top, rows[k]), max(bottom, rows[k])', 'top, bottom = min(top, rows[k]), rows[k]'),
        ('sxy + there * x * y', 'sxy + there * x * x'),
        ('np.int64(1) - bridged[k]', 'np.int64(1)'),
    ],
    'buffers': [
        ('size + size // 4', 'size - size // 4'),
        ('image.shape != (height, width)', 'image.size < height * width'),
        ('            image.fill(0)', '            pass'),
    ],
    'compiling': [
        ("glob('*.py')", "glob('c*.py')"),
        ('except RuntimeError:', 'except ValueError:'),
    ],
    'edges': [
        ('start_weights(q, 2)', 'start_weights(q, 1)'),
        ('tail = 2 * r / (1 - r)', 'tail = r / (1 - r)'),
        ('along[i] = below[i] - above[i]', 'along[i] = above[i] - below[i]'),
        ('kept[row + 1, 2 * first', 'kept[row + 2, 2 * first'),
        ('HALO = 2', 'HALO = 1'),
        ('if end == height:', 'if first == 0:'),
        ('CODE_2 if same else CODE_4', 'CODE_4 if same else CODE_2'),
        ('slack if code_1 | code_3 else -slack', 'slack'),
        ('target[width + PAD - 1]', 'target[width + PAD - 2]'),
        ('marks[:, MARGIN + width:] = 0', 'marks[:, MARGIN + width + 1:] = 0'),
        ('scale = 255.0 / (high - low)', 'scale = 255.0 / high'),
        ('STRONG_MARK if norm > T1', 'STRONG_MARK if norm >= T1'),
    ],
    'features': [
        ("line['sxy'] - line['sx'] * line['sy']", "line['sxy'] + line['sx'] * line['sy']"),
        ('sin = np.sqrt((r - difference) / (2 * r))', 'sin = np.sqrt((r + difference) / (2 * r))'),
        ('(size - 0.5 - start) / step', '(size + 0.5 - start) / step'),
        ('return 0.0, 1.0', 'return 0.0, -1.0'),
        ('moments[label, 0] < min_size', 'moments[label, 0] <= min_size'),
        ("line['y'] * cos - line['x'] * sin", "line['x'] * cos - line['y'] * sin"),
    ],
    'indices': [
        ('stride - 1 <= step <= stride + 1', 'stride - 1 <= step <= stride'),
        ('(pixel + 0.5) * inverse', 'pixel * inverse'),
    ],
    'linking': [
        ('max(distance(first, second), distance(second, first))',
         'min(distance(first, second), distance(second, first))'),
        ('falls_on(first, second) or falls_on(second, first)', 'falls_on(first, second)'),
        ('2 if c == gap else 3', '3 if c == gap else 2'),
        ("max(first['max_row'], second['max_row'])", "min(first['max_row'], second['max_row'])"),
        ('if child + 1 < size - 1 and', 'if child + 2 < size - 1 and'),
        ('max(int(down + 0.5) - 1, 0)', 'max(int(down + 0.5), 0)'),
        ('return order < 0', 'return order > 0'),
    ],
    'noise': [
        ('quantile(sums, (1 - share) * total)', 'quantile(sums, share * total)'),
        ('+ 4 * np.float32(middle[here])', '+ 2 * np.float32(middle[here])'),
        ('keep[row, i] and keep[row + 1, i]\n', 'keep[row, i]\n'),
        ('np.interp(noise, ALPHA_NOISE, ALPHA)', 'np.interp(noise, ALPHA_NOISE, ALPHA[::-1])'),
        ('gradient**2 - of_noise**2', 'gradient**2 + of_noise**2'),
        ('[1, 0, -1]) * (2 * side + centre)', '[1, 0, -1]) * (side + centre)'),
    ],
    'normalization': [
        ('m1 * size_after > m2 *', 'm1 * size_after >= m2 *'),
        ('range(1, min(n + 2, size))', 'range(1, min(n + 1, size))'),
        ('if k >= n:', 'if k > n:'),
        ('codes[(k - n + size) % size]', 'codes[max(k - n, 0)]'),
    ],
    'parameters': [
        ('if self.T2 >= self.T1:', 'if self.T2 > self.T1:'),
        (' or isinstance(value, bool):', ':'),
        ('if min(self.roi[2:]) <= 0:', 'if min(self.roi[2:]) < 0:'),
        ('tuple(None if value != value else value', 'tuple(value'),
    ],
    'pipeline': [
        ('cv2.COLOR_BGR2GRAY', 'cv2.COLOR_RGB2GRAY'),
        ('placed(segments, view.x, view.y,', 'placed(segments, view.y, view.x,'),
        ('height / grey.shape[0])', 'width / grey.shape[1])'),
        ('[keep == 0] = 0', '[keep != 0] = 0'),
        ('inner & (TAKEN | BRIDGED) == TAKEN', 'inner & TAKEN == TAKEN'),
        ('p.n if by_codes else 0', 'p.n'),
    ],
    'profiles': [
        ("'T1': (8.0, 'A step", "'T1': (2.0, 'A step"),
    ],
    'refinement': [
        ('(total(sd) - total(slant) / second) / n', '(total(sd) + total(slant) / second) / n'),
        ('r - q - first / where', 'r - q + first / where'),
        ('shift - turn * middle', 'shift + turn * middle'),
        ('(low, high) if way == 1 else (-high, -low)', '(low, high) if way == 1 else (-low, -high)'),
        ("(0.0 if line['sign'] > 0 else math.pi) - angle", "(0.0 if line['sign'] > 0 else math.pi) + angle"),
        ('direction + SAME_DIRECTION) & DIRECTIONS - 1', 'direction + SAME_DIRECTION)'),
        ('low + CELL * at_first - CLAIM', 'low + CELL * at_first + CLAIM'),
        ('at_first += hits > count', 'at_first += hits >= count'),
        ("-line['sign'] if line['steep'] and not turned", "-line['sign'] if line['steep']"),
        ('(np.pi / 4) + 2.5)', '(np.pi / 4) + 1.5)'),
        ('KEYS - 1 - (int(bits) >> KEY_SHIFT & KEYS - 1)', '(int(bits) >> KEY_SHIFT & KEYS - 1)'),
        ('counts[k] != count', 'counts[k] == count'),
        ('* scale * scale', '* scale'),
        ('(most - intercept) / slope', '(most + intercept) / slope'),
        ('range(counts.size - 2, -1, -1)', 'range(counts.size - 2, 0, -1)'),
        ('min(last, size_p - 1.0)', 'min(last, size_p - 2.0)'),
        ('numbers < size', 'numbers <= size'),
        ('floats(s * stride) - half', 'floats(s * stride) + half'),
        ('numbers <= farthest - known', 'numbers < farthest - known'),
        ('upper * second + lower * across', 'lower * second + upper * across'),
        ('deviations(line, correlation)[0] <= sigma_theta', 'deviations(line, correlation)[1] <= sigma_theta'),
    ],
    'scanning': [
        ('back = -1 if right else 1', 'back = 1 if right else -1'),
        ('offsets[before:count + 1]', 'offsets[before + 1:count + 1]'),
        ('(mask & (mask - 1)) != 0', 'mask > 128'),
        ('direction = (np.int64(code) + 1) % 4', 'direction = (np.int64(code) + 1) % 5'),
        ('(marks, beside, stride) >> direction', '(marks, beside, stride)'),
        ('np.int64(mark & OPEN) >> 7 - direction', 'np.int64(mark & OPEN) >> 6 - direction'),
        ('(2 * span_y * k + steps)', '(2 * span_y * k)'),
        ('and between != 2', 'and between != 3'),
        ('fan_offsets[max_gap + 1]', 'fan_offsets[max_gap]'),
        ('row - inner_row + REACH, column - inner_column + REACH',
         'column - inner_column + REACH, row - inner_row + REACH'),
        ('0 <= pixel % stride + step < stride', '0 <= pixel % stride + step'),
        ('length - first >= 4', 'length - first >= 3'),
        ('for gap in range(max_gap + 1):', 'for gap in range(max_gap):'),
    ],
    'selection': [
        ('for value in (x, x + w))', 'for value in (x, w))'),
        ('masked > 0', 'masked >= 1'),
        ('(segments[name] + 0.5) * factor - 0.5 + start', 'segments[name] * factor + start'),
        ('cos * across / norm, sin * down / norm', 'cos * down / norm, sin * across / norm'),
        ('above & below if p.theta_min', 'above | below if p.theta_min'),
        ('2 * REACH + 1, 2 * REACH + 1', '2 * REACH - 1, 2 * REACH - 1'),
    ],
    'splitting': [
        ('longer > cost + LEFT_OUT', 'longer > LEFT_OUT'),
        ('first + min(end * UNIT, size)', 'first + end * UNIT'),
        ('end - unit < LONGEST', 'end - unit <= LONGEST'),
        ('stop - start < min_size', 'stop - start <= min_size'),
        ('UNIT * unit, UNIT * unit + UNIT', 'UNIT * unit, UNIT * unit + UNIT - 1'),
        ('+ (NOISE_DEVIATION', '- (NOISE_DEVIATION'),
    ],
    'team': [
        ('[results[number] for number in range(len(results))]', 'list(results.values())'),
        ('tools[thread:thread + 1]', 'tools[0:1]'),
        ('tools[:1]', 'tools[1:2]'),
        ('if not all(helper.done() for helper in helpers):', 'if False:'),
        ('if first < end]', 'if first <= end]'),
        ('not all(thread.is_alive() for thread in self._threads)', 'False'),
    ],
    'thinning': [
        ('for turn in range(4)', 'for turn in range(3)'),
        ('connectivity=8', 'connectivity=4'),
        ('flat[pixels] & np.uint8(CODE)', 'flat[pixels]'),
    ],
    'vectors': [
        ('k + distance if not k & distance else TILE + k', 'k if not k & distance else TILE + k'),
        ('builder.fadd(', 'builder.fsub('),
        ("_comparison('<='), compares", "_comparison('<'), compares"),
        ('list(range(STEPS))', 'list(range(1, STEPS + 1))'),
        ('ir.Constant(both.type, [bits] * STEPS)', 'ir.Constant(both.type, [bits - 1] * STEPS)'),
        ('target_start + column * target_step + row', 'target_start + row * target_step + column'),
    ],
}
#: How tests run without the compiler, as for `make coverage`: arithmetic that overflows warns there.
PLAIN = ['-m', 'not compiled', '-W', 'ignore::RuntimeWarning']
#: What pytest ends with where all tests are left out.
NO_TESTS = 5
#: What is tested as well, and sooner, in the file of another module: region, mask and scale.
QUICKER = {'pipeline': ['test_selection']}
#: What runs where nothing failed before.
FALLBACK = ['test_pipeline', 'test_equivariance']
#: Tests that find their examples: the first one that fails is as good as the smallest.
PLUGIN = """
from hypothesis import Phase, settings
settings.register_profile('faults', phases=[Phase.explicit, Phase.generate], database=None)
settings.load_profile('faults')
"""


class Copy:
    """A copy of the package and of its tests.

    Attributes:
        core: Where the modules are.
        found: The tests that found a fault, as pytest calls them, without the compiler and with it.
    """

    def __init__(self, place: Path, seconds: float) -> None:
        self.core = place / 'line_feature_node' / 'core'
        self.found: dict[bool, set[str]] = {True: set(), False: set()}
        self._place, self._seconds = place, seconds
        for part in PARTS:
            (shutil.copytree if (ROOT / part).is_dir() else shutil.copy)(ROOT / part, place / part)
        (place / 'plugin.py').write_text(PLUGIN, encoding='utf-8')

    def first_failure(self, *tests: str, plain: bool) -> str:
        """What of these tests fails first, '' where all pass."""
        command = [sys.executable, '-m', 'pytest', '-p', 'plugin', '-p', 'no:cacheprovider', '-x', '-q', *tests]
        environment = os.environ | {
            'PYTHONPATH': str(self._place), 'NUMBA_CACHE_DIR': str(self._place / 'cache')}
        if plain:
            command += PLAIN
            environment['NUMBA_DISABLE_JIT'] = '1'
        try:
            done = subprocess.run(command, cwd=self._place, env=environment, capture_output=True, text=True,
                                  timeout=self._seconds, check=False)
        except subprocess.TimeoutExpired:
            return f'{tests[0]} (hangs)'
        if done.returncode in {0, NO_TESTS}:
            return ''
        found = re.search(r'^(?:FAILED|ERROR) (test/\w+\.py::\w+)', done.stdout, re.MULTILINE)
        if not found:
            return f'{tests[0]} (ends with {done.returncode})'
        self.found[plain].add(found[1])
        return found[1]

    def finder(self, module: str) -> str:
        """The test that finds the fault that is in a module now, '' where none does."""
        test = f'test_{module}'
        text = (self.core / f'{module}.py').read_text(encoding='utf-8')
        has_kernels = re.search(r'^@(kernel|inlined)$', text, re.MULTILINE)
        found = self.first_failure(f'test/{test}.py', plain=True) if has_kernels else ''
        for compiled in dict.fromkeys((*QUICKER.get(module, ()), test, *FALLBACK)):
            found = found or self.first_failure(f'test/{compiled}.py', plain=False)
        return found.partition('::')[2] or found

    def at_fault(self) -> list[str]:
        """Those of the tests that found a fault that fail where there is none."""
        failures = (self.first_failure(*sorted(tests), plain=plain) for plain, tests in self.found.items() if tests)
        return [failure for failure in failures if failure]


def dependent(core: Path, module: str) -> set[str]:
    """The modules of the core into which something of a module may be compiled, that one included."""
    texts = {path.stem: path.read_text(encoding='utf-8') for path in core.glob('*.py')}
    found: set[str] = set()
    more = {module}
    while more:
        found |= more
        more = {name for name, text in texts.items() for other in found
                if f'from line_feature_node.core.{other} import' in text} - found
    return found


def try_module(copy: Copy, module: str, part: str) -> Iterator[tuple[str, str, str]]:
    """Each fault of a module in a text with this part: the text, what takes its place, and the test that finds it.

    That is '' where none does.
    """
    path, compiling = copy.core / f'{module}.py', copy.core / 'compiling.py'
    text, how = path.read_text(encoding='utf-8'), compiling.read_text(encoding='utf-8')
    changed = {f'line_feature_node.core.{name}' for name in dependent(copy.core, module)}
    for number, (old, new) in enumerate(FAULTS[module]):
        if part not in old:
            continue
        if module != 'compiling':
            # What the fault is not in need not be compiled anew.
            stamp = f"'{module} {number}' if function.__module__ in {changed} else ''"
            compiling.write_text(how.replace('_source_stamp = SOURCES', f'_source_stamp = {stamp}'), encoding='utf-8')
        path.write_text(text.replace(old, new), encoding='utf-8')
        yield old, new, copy.finder(module)
    compiling.write_text(how, encoding='utf-8')
    path.write_text(text, encoding='utf-8')


def shown(text: str) -> str:
    """Text as code in a cell of a table."""
    return f'`{text.strip()}`'.replace('|', '\\|') if text.strip() else 'nothing'


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--module', action='append', choices=FAULTS, help='only the faults of this module')
    parser.add_argument('--text', default='', help='only the faults in texts that have this in them')
    parser.add_argument('--seconds', type=float, default=600, help='a file of tests that takes longer hangs')
    arguments = parser.parse_args()
    chosen = arguments.module or list(FAULTS)
    for module in chosen:
        text = (ROOT / 'line_feature_node' / 'core' / f'{module}.py').read_text(encoding='utf-8')
        for old, _ in FAULTS[module]:
            if text.count(old) != 1:
                print(f'{module}.py has {text.count(old)} times, not once: {old}', file=sys.stderr)
                return 2
    unnoticed = 0
    with tempfile.TemporaryDirectory() as folder:
        copy = Copy(Path(folder), arguments.seconds)
        print('| Module | Instead of | Fault | Found by |\n|---|---|---|---|')
        for module in chosen:
            for old, new, test in try_module(copy, module, arguments.text):
                unnoticed += not test
                print('|', ' | '.join((module, shown(old), shown(new), shown(test))), '|', flush=True)
        at_fault = copy.at_fault()
    for test in at_fault:
        print(f'{test} fails without a fault, too', file=sys.stderr)
    return 1 if unnoticed or at_fault else 0


if __name__ == '__main__':
    sys.exit(main())
