import re

import cv2
import pytest
from typer.testing import CliRunner

from line_feature_node import demo
from line_feature_node.cli import app


def test_every_frame_of_the_drive_comes_back_with_what_is_true(tmp_path):
    arguments = ['demo', '--frames', '8', '--T1', '7', '--out', str(tmp_path)]
    result = CliRunner().invoke(app, arguments, env={'COLUMNS': '200'})
    assert result.exit_code == 0, result.output
    cells = dict(re.findall(r'│ (.*?) +│ +(.*?) │', result.output))
    assert cells['images published, 30 a second'] == cells['answered with segments'] == '8'
    precision, recall = map(float, cells['precision and recall against the truth'].split(', '))
    assert precision > 0.7
    assert recall > 0.6
    overlay = cv2.imread(str(tmp_path / 'overlay.png'))
    assert overlay.shape == (480, 640, 3)
    assert len(set(map(tuple, overlay.reshape(-1, 3)[::7].tolist()))) > 1000


def test_a_node_that_cannot_start_is_a_sentence():
    with pytest.raises(RuntimeError, match='cannot start: T2 must be less than T1'):
        demo.play([], ['-p', 'T2:=500.0'])


def test_the_camera_moves():
    first, last = demo.render(2)
    assert first.image.shape == last.image.shape == (480, 640, 3)
    assert abs(first.image.astype(int) - last.image).mean() > 5
