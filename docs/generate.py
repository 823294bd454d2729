"""Write what the README and docs/ show: the table of parameters, and pictures of the demo's corridor.

    python docs/generate.py
"""

import re
from pathlib import Path

import cv2

from line_feature_node.core import LineFeatureExtractor, Parameters
from line_feature_node.figures import sheet, stage_pictures
from line_feature_node.overlay import draw_overlay
from line_feature_node.scenes import corridor
from line_feature_node.section3 import compare_pictures

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


def write_pictures(folder: Path) -> None:
    """The segments of the demo's corridor, what each step makes of it, and the panels of Fig. 5."""
    image, parameters = corridor().image, Parameters.paper()
    stages = LineFeatureExtractor(parameters).stages(image)
    panels = sheet(compare_pictures(image, parameters), columns=2)
    for name, picture in {
        'corridor': draw_overlay(image, stages.segments),
        'stages': sheet(stage_pictures(image, stages, scale=1), columns=2),
        'section3': cv2.resize(panels, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA),
    }.items():
        (folder / f'{name}.jpg').write_bytes(cv2.imencode('.jpg', picture, [cv2.IMWRITE_JPEG_QUALITY, 88])[1].tobytes())


def main() -> None:
    readme = ROOT / 'README.md'
    readme.write_text(with_table(readme.read_text(encoding='utf-8')), encoding='utf-8')
    write_pictures(ROOT / 'docs')


if __name__ == '__main__':
    main()
