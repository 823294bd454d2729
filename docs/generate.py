"""Write what the README shows: the table of parameters, and the picture of the demo's corridor.

    python docs/generate.py
"""

import re
from pathlib import Path

import cv2

from line_feature_node.core import Parameters, extract
from line_feature_node.overlay import draw_overlay
from line_feature_node.scenes import corridor

ROOT = Path(__file__).resolve().parents[1]
BEGIN, END = '<!-- parameters: written by docs/generate.py -->', '<!-- end of parameters -->'


def parameter_table() -> str:
    """Every parameter with default, range, unit and description, as Markdown."""
    defaults = Parameters()
    rows = ['| parameter | default | range | unit | what it does |', '|---|---|---|---|---|']
    for name, spec in Parameters.specs().items():
        default = getattr(defaults, name)
        rows.append(f'| `{name}` | {default} | {spec.range} | {spec.unit} | {spec.description} |')
    return '\n'.join(rows)


def with_table(readme: str) -> str:
    """The README with its table as it should be."""
    pattern = re.compile(f'{re.escape(BEGIN)}.*{re.escape(END)}', re.DOTALL)
    return pattern.sub(lambda _: f'{BEGIN}\n{parameter_table()}\n{END}', readme)


def picture() -> bytes:
    """The segments of the demo's corridor, as a PNG."""
    image = corridor().image
    return cv2.imencode('.png', draw_overlay(image, extract(image, profile='paper')))[1].tobytes()


def main() -> None:
    readme = ROOT / 'README.md'
    readme.write_text(with_table(readme.read_text(encoding='utf-8')), encoding='utf-8')
    (ROOT / 'docs' / 'corridor.png').write_bytes(picture())


if __name__ == '__main__':
    main()
