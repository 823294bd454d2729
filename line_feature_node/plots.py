"""Plots for pages, as SVG made of text: values over time, and lengths by orientation.

A plot over time is as wide as the page lets it be, and its letters stay as large as those of the page: positions on the
axes are shares of the width, and only what is drawn of the data is stretched.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from line_feature_node.markup import Markup, joined, tag
from line_feature_node.overlay import COLOURS, SECTIONS

Values = NDArray[np.float64]

#: Width and height of what is stretched.
SIDE = 1000
#: Points are drawn as dots up to this many.
DOTS = 120
#: A line is interrupted where frames are missing for so many times their usual distance.
GAP = 5
#: Values above so many times the usual largest are marked at the upper border, so that the others can be seen.
OUTLIER = 4
#: Seconds between the ticks of time from one second on.
TIMES = (1, 2, 5, 10, 15, 30, 60, 120, 300, 600, 900, 1800, 3600, 7200, 14400, 21600, 43200, 86400)
#: Radius of the rose, and how far from the centre what is around it is written.
RADIUS, AROUND = 100, 112
#: What is written there, by the angle that is drawn.
LABELS = {0: '0°', 30: '\u221230°', 60: '\u221260°', 90: '±90°', 120: '60°', 150: '30°', 180: '0°'}
#: Space that groups digits: narrow, and no place for a line to break.
NARROW = '\u202f'
MINUS = '\u2212'


@dataclass(frozen=True)
class Columns:
    """Values over time, those that are too near to each other to be told apart taken together.

    Attributes:
        time: Of each column, the mean.
        low, mean, high: S×N, of each series; NaN where it has no value.
        count: Points in each column.
    """

    time: Values
    low: Values
    mean: Values
    high: Values
    count: NDArray[np.int64]


@dataclass(frozen=True)
class Plot:
    """What is drawn over time.

    Attributes:
        name: What the values are.
        unit: Of the values; '' for a pure number.
        times: Seconds, growing.
        series: Values by name, NaN where there is none; one or two.
        span: Seconds that the axis shows, more than 0.
        failed: Seconds at which a frame failed.
        whole: Whether values are counts.
        high: Upper end of the axis; None for what the values ask for.
    """

    name: str
    unit: str
    times: Values
    series: Mapping[str, Values]
    span: float
    failed: Values
    whole: bool = False
    high: float | None = None


def number(value: float, digits: int = 3) -> str:
    """A number for people: so many significant digits, all those before the point, in groups of three."""
    if value == 0 or not math.isfinite(value):
        return '0' if value == 0 else 'none'
    decimals = max(0, digits - 1 - math.floor(math.log10(abs(value))))
    text = f'{value:,.{decimals}f}'.replace(',', NARROW).replace('-', MINUS)
    return text.rstrip('0').rstrip('.') if '.' in text else text


def with_unit(value: float, unit: str) -> str:
    """A number with its unit, which stay on one line."""
    return f'{number(value)}{unit}' if unit in ('', '°') else f'{number(value)}\u00a0{unit}'


def ticks(low: float, high: float, count: int = 5, *, whole: bool = False) -> list[float]:
    """Round numbers, evenly spaced: about so many, the first not above `low` and the last not below `high`."""
    size = (high - low) or abs(high) or 1.0
    power = 10.0 ** math.floor(math.log10(size / count))
    step = next(power * factor for factor in (1, 2, 5, 10) if power * factor * (1 + 1e-9) >= size / count)
    step = max(step, 1.0) if whole else step
    first, last = math.floor(low / step + 1e-9), math.ceil(high / step - 1e-9)
    return [k * step for k in range(first, max(last, first + 1) + 1)]


def time_ticks(span: float, count: int = 6) -> list[float]:
    """Round times from 0 to at most the end of a span, in seconds."""
    if span < count:
        return [time for time in ticks(0, span, count) if time <= span * (1 + 1e-9)]
    step = next((step for step in TIMES if span / step <= count), 0) or 86400 * math.ceil(span / 86400 / count)
    return [float(k * step) for k in range(int(span / step + 1e-9) + 1)]


def clock(seconds: float, span: float, *, exact: bool = False) -> str:
    """A time of a span as its axis has it: seconds, min:s, or h:min; exact ones have more digits and the unit."""
    if span < 120:
        return f'{seconds:.2f}\u00a0s' if exact else number(seconds)
    tenths = round(seconds * 10)
    minutes, rest = divmod(tenths, 600)
    if span < 7200:
        return f'{minutes}:{rest / 10:04.1f}\u00a0min' if exact else f'{minutes}:{rest // 10:02d}'
    hours, minutes = divmod(minutes, 60)
    return f'{hours}:{minutes:02d}:{rest // 10:02d}\u00a0h' if exact else f'{hours}:{minutes:02d}'


def time_unit(span: float) -> str:
    """What the numbers on an axis of time are."""
    return 's' if span < 120 else 'min:s' if span < 7200 else 'h:min'


def decimated(times: Values, series: Values, span: float, count: int) -> Columns:
    """Take values together, so that there are at most so many columns; those that are few enough stay as they are.

    Args:
        times: N, seconds, growing.
        series: S×N, NaN where there is no value.
        span: Seconds that the columns share.
        count: How many columns.
    """
    numbers = (np.arange(len(times)) if len(times) <= count
               else np.clip(times / span * count, 0, count - 1).astype(np.int64))
    starts = np.flatnonzero(np.diff(numbers, prepend=-1))
    sizes = np.diff(starts, append=len(times))
    known = np.isfinite(series)
    sums = np.add.reduceat(np.where(known, series, 0.0), starts, axis=1)
    counts = np.add.reduceat(known.astype(np.int64), starts, axis=1)
    return Columns(
        time=np.add.reduceat(times, starts) / sizes, count=sizes,
        low=np.fmin.reduceat(series, starts, axis=1), high=np.fmax.reduceat(series, starts, axis=1),
        mean=np.where(counts, sums / np.maximum(counts, 1), np.nan))


def described(values: Values, unit: str) -> str:
    """What can be said of values in a line."""
    known = values[np.isfinite(values)]
    if not len(known):
        return 'none'
    low, high = number(float(known.min())), with_unit(float(known.max()), unit)
    return f'median {with_unit(float(np.median(known)), unit)}, from {low} to {high}'


def time_plot(plot: Plot, columns: int) -> Markup:
    """A figure with values over time: lines, what failed at the foot, and values to be read under the pointer.

    Args:
        plot: What is drawn, with a value at least.
        columns: So many points at most are drawn; of more, each column has its mean and the range of its values.
    """
    values = np.stack(list(plot.series.values()))
    marks, above = _marks(plot, values)
    drawn = decimated(plot.times, values, plot.span, columns)
    words = {name: described(of, plot.unit) for name, of in plot.series.items()}
    notes = [f'{name}: {text}' for name, text in words.items()] if len(plot.series) > 1 else list(words.values())
    if above:
        notes.append(f'{above} above the upper border, marked there')
    label = f'{plot.name} over time: {"; ".join(notes)}'
    body = tag('svg', *_data(plot, drawn, marks[0], marks[-1]), viewBox=f'0 0 {SIDE} {SIDE}',
               preserveAspectRatio='none', width='100%', height='100%')
    return _figure(
        plot.name, _legend(words) if len(plot.series) > 1 else tag('p', '; '.join(notes)),
        tag('div', tag('svg', *_axes(plot, marks), body, class_='over-time', role='img', aria_label=label),
            class_='axes'))


def _figure(name: str, words: Markup, drawing: Markup) -> Markup:
    return tag('figure', tag('figcaption', tag('h4', name), words), drawing, class_='plot')


def _legend(words: Mapping[str, str]) -> Markup:
    return tag('ul', *(tag('li', tag('i', class_=f'key s{k}'), f'{name}: {text}')
                       for k, (name, text) in enumerate(words.items())), class_='legend')


def _marks(plot: Plot, values: Values) -> tuple[list[float], int]:
    """Ticks of the values, the first and last of which are the ends of the axis; how many values are above."""
    known = values[np.isfinite(values)]
    low, high = min(0.0, float(known.min())), float(known.max())
    usual = float(np.quantile(known, 0.98, method='lower'))
    if plot.high is not None:
        high = plot.high
    elif high > OUTLIER * usual > 0:
        high = 1.5 * usual
    marks = ticks(low, high, whole=plot.whole)
    return marks, int((known > marks[-1]).sum())


def _axes(plot: Plot, marks: list[float]) -> list[Markup]:
    """Lines and numbers, at shares of the width and height."""
    size = marks[-1] - marks[0]
    parts = []
    for mark in marks:
        y = f'{100 * (marks[-1] - mark) / size:.6g}%'
        parts += [tag('line', x1='0', x2='100%', y1=y, y2=y, class_='zero' if mark == 0 else 'grid'),
                  tag('text', number(mark), x='0', y=y, dx=-8, dy='.35em', class_='left')]
    for time in time_ticks(plot.span):
        x = f'{100 * time / plot.span:.6g}%'
        parts += [tag('line', x1=x, x2=x, y1='100%', y2='100%', class_='tick'),
                  tag('text', clock(time, plot.span), x=x, y='100%', dy=18, class_='middle')]
    unit = 'count' if plot.whole else plot.unit or 'share'
    return [*parts, tag('text', unit, x='0', y='0', dy=-10, class_='unit'),
            tag('text', f'time, {time_unit(plot.span)}', x='100%', y='100%', dy=34, class_='right unit')]


def _data(plot: Plot, drawn: Columns, low: float, high: float) -> list[Markup]:
    """What is stretched: bands, lines and dots of each series, marks of what is beyond, and where the pointer reads."""
    def across(times: Values) -> list[str]:
        return [f'{x:.6g}' for x in np.round(times / plot.span * SIDE, 1)]

    def down(values: Values) -> list[str]:
        return [f'{y:.6g}' for y in np.round((high - np.clip(values, low, high)) / (high - low) * SIDE, 1)]

    parts = []
    spread = len(drawn.time) < len(plot.times)
    gap = max(GAP * float(np.median(np.diff(plot.times))) if len(plot.times) > 1 else 0.0,
              2.5 * plot.span / len(drawn.time) if spread else 0.0)
    for k in range(len(plot.series)):
        known = np.flatnonzero(np.isfinite(drawn.mean[k]))
        if not len(known):
            continue
        x, y = across(drawn.time[known]), down(drawn.mean[k][known])
        breaks = [0, *(np.flatnonzero(np.diff(drawn.time[known]) > gap) + 1).tolist(), len(known)]
        runs = [slice(*ends) for ends in pairwise(breaks)]
        if spread:
            bottom, top = down(drawn.low[k][known]), down(drawn.high[k][known])
            parts.append(tag('path', class_=f'band s{k}', d=''.join(
                _path([*x[run], *x[run][::-1]], [*top[run], *bottom[run][::-1]]) + 'Z' for run in runs)))
        parts.append(tag('path', class_=f'line s{k}', d=''.join(_path(x[run], y[run]) for run in runs)))
        dots = [place for run in runs for place in zip(x[run], y[run], strict=True)
                if len(known) <= DOTS or run.stop - run.start == 1]
        if dots:
            parts.append(tag('path', class_=f'dots s{k}', d=''.join(f'M{a},{b}h0' for a, b in dots)))
    beyond = drawn.time[np.fmax.reduce(drawn.high, axis=0) > high]
    if len(beyond):
        parts.append(tag('path', class_='beyond', d=''.join(f'M{x},0h0' for x in across(beyond))))
    if len(plot.failed):
        places = dict.fromkeys(across(np.round(plot.failed / plot.span, 3) * plot.span))
        parts.append(tag('path', class_='failed', d=''.join(f'M{x},{SIDE}v-60' for x in places)))
    return [*parts, _readings(plot, drawn)]


def _path(x: list[str], y: list[str]) -> str:
    return 'M' + 'L'.join(f'{a},{b}' for a, b in zip(x, y, strict=True))


def _readings(plot: Plot, drawn: Columns) -> Markup:
    """A strip around each column that says its values; the strips of neighbours meet half-way."""
    middles = (drawn.time[1:] + drawn.time[:-1]) / 2
    edges = np.concatenate([[0.0], middles, [plot.span]]) / plot.span * SIDE
    strips = []
    for k, time in enumerate(drawn.time):
        values = [f'{name if len(plot.series) > 1 else ""} {_reading(drawn, row, k, plot.unit)}'.strip()
                  for row, name in enumerate(plot.series) if np.isfinite(drawn.mean[row, k])]
        many = f' ({number(int(drawn.count[k]), 9)} frames)' if drawn.count[k] > 1 else ''
        words = f'{clock(float(time), plot.span, exact=True)}: {", ".join(values)}{many}'
        strips.append(tag('rect', tag('title', words), x=round(float(edges[k]), 1), y=0, height=SIDE,
                          width=round(float(edges[k + 1] - edges[k]), 1)))
    return tag('g', *strips, class_='readings')


def _reading(drawn: Columns, row: int, column: int, unit: str) -> str:
    low, mean, high = (float(values[row, column]) for values in (drawn.low, drawn.mean, drawn.high))
    if low == high:
        return with_unit(mean, unit)
    return f'mean {with_unit(mean, unit)}, {number(low)} to {with_unit(high, unit)}'


def code_of(degrees: float) -> int:
    """The direction code of segments of an orientation: their gradient is at right angles to them."""
    return 1 + round((degrees + 90) / 45) % 4


def css_colour(code: int) -> str:
    """The colour of a direction code in overlays, as pages have it."""
    blue, green, red = COLOURS[code]
    return f'#{red:02x}{green:02x}{blue:02x}'


def rose(lengths: Values) -> Markup:
    """A figure with a half rose of orientations: petals point as the segments lie in the picture.

    Args:
        lengths: Of segments in bands of equal width from -90 to 90 degrees, y growing downwards; not all 0.
    """
    shares = lengths / lengths.sum()
    rings = ticks(0, float(shares.max()), 3)[1:]
    width = 180 / len(shares)
    parts = [tag('path', d=f'M{-r:.2f},0A{r:.2f},{r:.2f} 0 0 1 {r:.2f},0', class_='grid')
             for r in (_radius(ring, rings[-1]) for ring in rings)]
    parts += [tag('line', x1=0, y1=0, x2=RADIUS * math.cos(angle), y2=-RADIUS * math.sin(angle), class_='grid')
              for angle in np.radians([30, 60, 90, 120, 150]).tolist()]
    parts.append(tag('line', x1=-RADIUS, y1=0, x2=RADIUS, y2=0, class_='zero'))
    for k, share in enumerate(shares.tolist()):
        low = -90 + k * width
        words = (f'{_degrees(low)} to {_degrees(low + width)}: {with_unit(100 * share, "%")} of the length, '
                 f'{with_unit(float(lengths[k]), "px")}')
        if share:
            parts.append(tag('path', tag('title', words), d=_petal(low, width, _radius(share, rings[-1])),
                             class_='petal', fill=css_colour(code_of(low + width / 2))))
    parts += [tag('text', with_unit(100 * ring, '%' if ring == rings[-1] else ''), x=_radius(ring, rings[-1]), y=0,
                  dy=10, class_='ring') for ring in rings]
    parts += [tag('text', words, x=AROUND * math.cos(math.radians(angle)), y=-AROUND * math.sin(math.radians(angle)),
                  dy='.35em', class_='middle') for angle, words in LABELS.items()]
    largest = int(shares.argmax())
    low = -90 + largest * width
    words = (f'Largest band: {_degrees(low)} to {_degrees(low + width)}, with '
             f'{with_unit(100 * float(shares[largest]), "%")} of the length.')
    note = tag('p', f'{words} Petals point as the segments lie in the picture; their area is the share of the length.')
    drawing = tag('svg', *parts, viewBox='-132 -122 264 138', class_='rose', role='img',
                  aria_label=f'Orientations, weighted by length: {words}')
    return _figure('Orientations, by length', note, joined(drawing, colour_key()))


def colour_key() -> Markup:
    """What the colours of segments stand for."""
    return tag('ul', *(tag('li', tag('i', class_='patch', style=f'background:{css_colour(code)}'), name)
                       for code, name in SECTIONS.items()), class_='legend')


def _degrees(angle: float) -> str:
    return f'{angle:.0f}°'.replace('-', MINUS)


def _radius(share: float, outermost: float) -> float:
    """Areas, not radii, are as large as the shares."""
    return RADIUS * math.sqrt(share / outermost)


def _petal(low: float, width: float, radius: float) -> str:
    """A sector; what rises to the right in the picture has a negative angle there, and is drawn so."""
    first, last = (math.radians(-angle if low < 0 else 180 - angle) for angle in (low, low + width))
    return (f'M0,0L{radius * math.cos(first):.2f},{-radius * math.sin(first):.2f}'
            f'A{radius:.2f},{radius:.2f} 0 0 1 {radius * math.cos(last):.2f},{-radius * math.sin(last):.2f}Z')
