import re

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from line_feature_node.plots import (
    MINUS,
    NARROW,
    Plot,
    clock,
    code_of,
    decimated,
    described,
    number,
    rose,
    ticks,
    time_plot,
    time_ticks,
    with_unit,
)
from line_feature_node.truth import segments_of_truth


@pytest.mark.parametrize(('value', 'text'), [
    (0, '0'), (0.2, '0.2'), (1.2345, '1.23'), (0.012345, '0.0123'), (123.4, '123'), (100.0, '100'),
    (1234567, f'1{NARROW}234{NARROW}567'), (-2.5, f'{MINUS}2.5'), (10, '10'), (float('nan'), 'none')])
def test_numbers_are_for_people(value, text):
    assert number(value) == text


def test_units_stay_with_their_numbers():
    assert with_unit(1.5, 'ms') == '1.5\u00a0ms'
    assert with_unit(1.5, '') == '1.5'
    assert with_unit(1.5, '°') == '1.5°'


@pytest.mark.parametrize(('low', 'high', 'expected'), [
    (0, 1, [0, 0.2, 0.4, 0.6, 0.8, 1]), (0, 179, [0, 50, 100, 150, 200]), (0, 5.2, [0, 2, 4, 6]),
    (-3, 12, [-5, 0, 5, 10, 15]), (0, 0, [0, 0.2])])
def test_ticks_are_round(low, high, expected):
    assert ticks(low, high) == pytest.approx(expected)


def test_counts_have_whole_ticks():
    assert ticks(0, 2, whole=True) == [0, 1, 2]
    assert ticks(0, 0, whole=True) == [0, 1]


@given(st.floats(-1e9, 1e9), st.floats(1e-3, 1e9))
def test_ticks_hold_what_they_are_for(low, size):
    made = ticks(low, low + size)
    slack = 1e-6 * max(abs(low), size)
    assert made[0] <= low + slack
    assert made[-1] >= low + size - slack
    assert 2 <= len(made) <= 8
    assert np.ptp(np.diff(made)) <= slack


@pytest.mark.parametrize(('span', 'expected'), [
    (0.5, ['0', '0.1', '0.2', '0.3', '0.4', '0.5']), (5.9, ['0', '1', '2', '3', '4', '5']),
    (60, ['0', '10', '20', '30', '40', '50', '60']),
    (300, ['0:00', '1:00', '2:00', '3:00', '4:00', '5:00']), (7200, ['0:00', '0:30', '1:00', '1:30', '2:00']),
    (3 * 86400, ['0:00', '12:00', '24:00', '36:00', '48:00', '60:00', '72:00'])])
def test_times_have_round_ticks(span, expected):
    assert [clock(time, span) for time in time_ticks(span)] == expected


@given(st.floats(1e-3, 1e8))
def test_ticks_of_time_are_few_and_in_the_span(span):
    made = time_ticks(span)
    assert 1 <= len(made) <= 7
    assert made[0] == 0
    assert made[-1] <= span * (1 + 1e-6)


@pytest.mark.parametrize(('seconds', 'span', 'text'), [
    (1.234, 5, '1.23\u00a0s'), (83.21, 600, '1:23.2\u00a0min'), (59.96, 600, '1:00.0\u00a0min'),
    (3723.4, 9000, '1:02:03\u00a0h')])
def test_exact_times_have_a_unit(seconds, span, text):
    assert clock(seconds, span, exact=True) == text


def test_few_points_stay_as_they_are():
    times, values = np.array([0.0, 0.1, 0.5]), np.array([[1.0, np.nan, 3.0]])
    made = decimated(times, values, 0.5, 3)
    np.testing.assert_array_equal(made.time, times)
    for drawn in (made.low, made.mean, made.high):
        np.testing.assert_array_equal(drawn, values)


def test_many_points_become_columns_with_their_range():
    rng = np.random.default_rng(1)
    times, values = np.sort(rng.uniform(0, 60, 5000)), rng.normal(size=(2, 5000))
    values[0, times < 6] = np.nan
    made = decimated(times, values, 60.0, 100)
    assert len(made.time) == 100
    assert made.count.sum() == 5000
    for k in (0, 9, 10, 57, 99):
        inside = values[:, (times >= 0.6 * k) & (times < 0.6 * (k + 1))]
        assert inside.shape[1] == made.count[k]
        np.testing.assert_array_equal(made.low[1, k], inside[1].min())
        np.testing.assert_array_equal(made.high[1, k], inside[1].max())
        np.testing.assert_allclose(made.mean[1, k], inside[1].mean())
        assert np.isnan(made.mean[0, k]) == (k < 10)


def test_a_gap_in_the_recording_makes_no_columns():
    times = np.concatenate([np.linspace(0, 1, 100), np.linspace(99, 100, 100)])
    made = decimated(times, times[None], 100.0, 50)
    assert len(made.time) == 2


def plot(values, times=None, unit='ms', **options):
    values = np.array(values, float)
    times = np.arange(len(values), dtype=float) if times is None else np.array(times, float)
    return str(time_plot(Plot('Time <b>', unit, times, {'time': values}, float(times[-1]), np.array(
        options.pop('failed', [])), **options), options.pop('columns', 400)))


def points(made, kind):
    """The places of what is drawn of a kind."""
    [path] = re.findall(rf'<path class="{kind}[^"]*" d="([^"]*)"', made)
    return [(float(x), float(y)) for x, y in re.findall(r'[ML]([\d.]+),([\d.]+)', path)]


def test_values_are_where_the_axes_say():
    made = plot([0, 5, 10])
    assert points(made, 'line s0') == [(0, 1000), (500, 500), (1000, 0)]
    assert points(made, 'dots s0') == points(made, 'line s0')
    assert '<title>1.00\u00a0s: 5\u00a0ms</title>' in made
    assert 'Time &lt;b&gt; over time: median 5\u00a0ms, from 0 to 10\u00a0ms' in made
    assert '<b>' not in made


def test_a_line_is_interrupted_where_the_recording_is():
    made = plot([1] * 22, times=[*range(20), 60, 61])
    [path] = re.findall(r'class="line s0" d="([^"]*)"', made)
    assert path.count('M') == 2


def test_one_outlier_does_not_hide_the_others():
    made = plot([*range(1, 100), 5000])
    assert '1 above the upper border' in made
    assert 'from 1 to 5\u202f000\u00a0ms' in made
    assert '<title>99.00\u00a0s: 5\u202f000\u00a0ms</title>' in made
    assert points(made, 'beyond') == [(1000, 0)]
    assert points(made, 'line s0')[49][1] < 700
    assert 'beyond' not in plot(range(100))


def test_failures_are_marks_at_the_foot():
    assert points(plot([1, 2, 3], failed=[1.0]), 'failed') == [(500, 1000)]
    assert 'class="failed"' not in plot([1, 2, 3])


def test_two_series_have_a_legend():
    times = np.arange(3.0)
    series = {'precision': np.array([0.5, np.nan, 1]), 'recall': np.array([0.25, 0.5, np.nan])}
    made = str(time_plot(Plot('Agreement', '', times, series, 2.0, np.empty(0), high=1.0), 100))
    assert points(made, 'line s0') == [(0, 500), (1000, 0)]
    assert points(made, 'line s1') == [(0, 750), (500, 500)]
    assert '<title>0.00\u00a0s: precision 0.5, recall 0.25</title>' in made
    assert '<title>1.00\u00a0s: recall 0.5</title>' in made
    assert made.count('<li>') == 2


def test_a_series_without_values_is_said_to_have_none():
    series = {'precision': np.full(3, np.nan), 'recall': np.zeros(3)}
    made = str(time_plot(Plot('Agreement', '', np.arange(3.0), series, 2.0, np.empty(0), high=1.0), 100))
    assert 'precision: none' in made
    assert 'line s0' not in made
    assert points(made, 'line s1') == [(0, 1000), (500, 1000), (1000, 1000)]


def test_described_leaves_out_what_is_not_known():
    assert described(np.array([1, np.nan, 3]), 'px') == 'median 2\u00a0px, from 1 to 3\u00a0px'


@pytest.mark.parametrize(('degrees', 'code'), [
    (-90, 1), (-70, 1), (-45, 2), (-20, 3), (0, 3), (20, 3), (25, 4), (45, 4), (70, 1), (90, 1)])
def test_codes_of_orientations_are_those_of_segments(degrees, code):
    x, y = 100 * np.cos(np.radians(degrees)), 100 * np.sin(np.radians(degrees))
    [segment] = segments_of_truth(np.array([[0.0, 0.0, x, y]]), np.empty((0, 4)))
    assert code_of(degrees) == segment['code'] == code


def petals(lengths):
    made = str(rose(np.array(lengths, float)))
    return made, re.findall(r'<path d="M0,0L([-\d.]+),([-\d.]+)A([\d.]+),[^"]*? ([-\d.]+),([-\d.]+)Z" class="petal" '
                            r'fill="(#\w+)"><title>([^<]*)', made)


def test_petals_point_as_segments_lie():
    # From -50 to -40 they rise to the right, from 0 to 10 they fall a little.
    made, drawn = petals([0] * 4 + [3] + [0] * 4 + [1] + [0] * 8)
    assert len(drawn) == 2
    for (*first, _, x2, y2, _, _), middle in zip(drawn, (45, 175), strict=True):
        x1, y1, x2, y2 = map(float, (*first, x2, y2))
        assert np.degrees(np.arctan2(-(y1 + y2), x1 + x2)) == pytest.approx(middle, abs=0.1)
    assert drawn[0][6] == f'{MINUS}50° to {MINUS}40°: 75\u00a0% of the length, 3\u00a0px'
    assert f'Largest band: {MINUS}50° to {MINUS}40°, with 75\u00a0% of the length.' in made


def test_areas_of_petals_are_the_shares():
    _, drawn = petals([0, 1, 0, 4] + [0] * 14)
    radii = [float(petal[2]) for petal in drawn]
    assert radii[1] == pytest.approx(2 * radii[0], rel=1e-3)
    assert radii[1] <= 100
