"""Write what follows from the code: the tables of the README, the files of config/, and pictures in docs/.

    python docs/generate.py
"""

import math
import re
import textwrap
from pathlib import Path
from typing import Any

import cv2

from line_feature_node.core import PROFILES, LineFeatureExtractor, Parameters
from line_feature_node.core.parameters import ParameterSet
from line_feature_node.figures import sheet, stage_pictures
from line_feature_node.options import Options
from line_feature_node.overlay import draw_overlay
from line_feature_node.scenes import corridor
from line_feature_node.section3 import compare_pictures

ROOT = Path(__file__).resolve().parents[1]
#: Each table by the name that its comments in the README have.
TABLES: dict[str, ParameterSet] = {'parameters': Parameters(), 'options': Options()}
WIDTH = 120


def parameter_table(table: ParameterSet) -> str:
    """Every parameter with default, range, unit and description, as Markdown."""
    rows = ['| parameter | default | range | unit | what it does |', '|---|---|---|---|---|']
    for name, spec in table.specs().items():
        value = yaml_value(getattr(table, name))
        rows.append(f'| `{name}` | {value} | {spec.range} | {spec.unit} | {spec.description} |')
    return '\n'.join(rows)


def with_tables(readme: str) -> str:
    """The README with its tables as they should be."""
    for name, table in TABLES.items():
        begin, end = f'<!-- {name}: written by docs/generate.py -->', f'<!-- end of {name} -->'
        text = f'{begin}\n{parameter_table(table)}\n{end}'
        readme = re.sub(f'{re.escape(begin)}.*{re.escape(end)}', lambda _, text=text: text, readme, flags=re.DOTALL)
    return readme


def config_files() -> dict[str, str]:
    """Parameter files for the node, by name: one for each named set, and that of the defaults with every parameter."""
    return {f'{name}.yaml': (default_file() if name == 'default' else profile_file(name)) for name in PROFILES}


def default_file() -> str:
    """Every parameter with its default, its description and its range."""
    lines = []
    for table in (Options(), Parameters()):
        for name, spec in table.specs().items():
            lines += comment(f'{spec.description} {", ".join(filter(None, (spec.range, spec.unit)))}'.strip())
            lines.append(f'    {name}: {yaml_value(getattr(table, name))}')
    head = f'{PROFILES["default"].description} Beside this file `profile` has no effect when the node starts.'
    return parameter_file(head, lines)


def profile_file(name: str) -> str:
    """What a named set changes, with its reasons."""
    lines = [*comment('What is not here has the value that this set gives it, the default where it gives none.'),
             f'    profile: {name}']
    for key, (value, reason) in PROFILES[name].settings.items():
        lines += [*comment(reason), f'    {key}: {yaml_value(value)}']
    return parameter_file(PROFILES[name].description, lines)


def parameter_file(head: str, lines: list[str]) -> str:
    """A parameter file for nodes of any name."""
    made = textwrap.wrap(f'{head} Written by docs/generate.py.', WIDTH - 2)
    return '\n'.join([*(f'# {line}' for line in made), '/**:', '  ros__parameters:', *lines]) + '\n'


def comment(text: str) -> list[str]:
    """A comment among parameters."""
    return [f'    # {line}' for line in textwrap.wrap(text, WIDTH - 6)]


def yaml_value(value: Any) -> str:
    """A value as YAML has it."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, tuple):
        return f'[{", ".join(map(yaml_value, value))}]'
    if isinstance(value, float) and math.isnan(value):
        return '.nan'
    return repr(value) if value == '' or not isinstance(value, str) else value


def write_pictures(folder: Path) -> None:
    """The segments of the demo's corridor; what each step of the paper makes of it, and the panels of its Fig. 5."""
    image, parameters = corridor().image, Parameters.paper()
    stages = LineFeatureExtractor(parameters).stages(image)
    panels = sheet(compare_pictures(image, parameters), columns=2)
    for name, picture in {
        'corridor': draw_overlay(image, LineFeatureExtractor().extract(image)),
        'stages': sheet(stage_pictures(image, stages, scale=1), columns=2),
        'section3': cv2.resize(panels, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA),
    }.items():
        (folder / f'{name}.jpg').write_bytes(cv2.imencode('.jpg', picture, [cv2.IMWRITE_JPEG_QUALITY, 88])[1].tobytes())


def main() -> None:
    readme = ROOT / 'README.md'
    readme.write_text(with_tables(readme.read_text(encoding='utf-8')), encoding='utf-8')
    for name, text in config_files().items():
        (ROOT / 'config' / name).write_text(text, encoding='utf-8')
    write_pictures(ROOT / 'docs')


if __name__ == '__main__':
    main()
