"""The report of an offline run: one page of HTML about its recordings, which needs nothing else."""

import base64
import contextlib
import importlib.metadata
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from datetime import datetime, timedelta, timezone
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from line_feature_node.bag import Outcome, Run, TargetError
from line_feature_node.core import Parameters
from line_feature_node.markup import Markup, joined, tag
from line_feature_node.overlay import encode_jpeg
from line_feature_node.plots import Plot, Values, clock, colour_key, number, rose, time_plot, with_unit
from line_feature_node.recordings import OUTPUTS, RecordingError, deserialize, opened
from line_feature_node.slices import BANDS, Frame

STYLE = Path(__file__).with_name('report.css')
#: Columns of all plots of a page together, and the most and the fewest that one gets.
COLUMNS, MOST_COLUMNS, FEWEST_COLUMNS = 60_000, 400, 50
#: Pictures on a page, and of one topic.
PICTURES, PICTURES_OF_TOPIC = 60, 6
#: Longest side of a picture, and its quality where it had to be made smaller.
SIDE, QUALITY = 960, 80
#: Reasons of failures that are listed for one recording.
REASONS = 20
#: A header's stamp that is farther than this from that of the recording, in seconds, is of another clock.
SAME_CLOCK = 60.0
#: Stamps before this are of a clock that starts at 0, as that of a simulation does: one year, in nanoseconds.
CALENDAR = 365 * 86400 * 10**9
NONE = '\u2013'


@dataclass(frozen=True)
class Topic:
    """What became of the frames of a topic.

    Attributes:
        name: Of the topic of images.
        frames: All of them, in the order of time.
        times: Seconds since the first frame of the recording, of all frames.
        good: Which frames did not fail.
        segments, milliseconds: Of all frames; NaN where one failed.
        latency: Milliseconds from the stamp of the header to that of the recording; NaN where there are not both.
        agreement: N×4, NaN where there is no truth.
        lengths: Of the segments of good frames, by bands of orientation.
    """

    name: str
    frames: list[Frame]
    times: Values
    good: Any
    segments: Values
    milliseconds: Values
    latency: Values
    agreement: Values
    lengths: Values


@dataclass(frozen=True)
class Recording:
    """What became of a recording.

    Attributes:
        outcome: As the run had it.
        anchor: Its place in the page.
        begin: Stamp of the first frame, nanoseconds; None where there is none.
        duration: Seconds from the first frame to the last.
        topics: Those that have frames, by name.
    """

    outcome: Outcome
    anchor: str
    begin: int | None
    duration: float
    topics: list[Topic]


def check_report(path: Path, pairs: list[tuple[Path, Path]], *, overwrite: bool) -> None:
    """See before a run whether its report can be written after it.

    Args:
        path: The page.
        pairs: Recordings and the bags that are to be made of them.
        overwrite: Whether a file that exists is replaced.

    Raises:
        TargetError: It cannot; the message is a sentence.
    """
    place = path.resolve()
    for source, target in pairs:
        for taken, what in ((source, 'the recording'), (target, 'the new bag')):
            if taken.resolve() in (place, *place.parents):
                raise TargetError(f'the report {path} would be in the place of {what} {taken}')
    if not path.parent.is_dir() and not any(path.parent.resolve() in target.resolve().parents for _, target in pairs):
        raise TargetError(f'cannot write {path}: there is no folder {path.parent}')
    with _told(path):
        if path.is_dir() or (path.exists() and not path.is_file()):
            raise TargetError(f'the report {path} cannot be written: it is there, and no file')
        if path.exists() and not overwrite:
            raise TargetError(f'the report {path} exists: --overwrite replaces it')
        if path.parent.is_dir():
            beside = _beside(path)
            if not beside.exists():  # permissions do not tell all: it is tried
                beside.touch()
                beside.unlink()


def write_report(path: Path, outcomes: list[Outcome], run: Run, profile: str, *, overwrite: bool) -> None:
    """Write the page; it is there when it is whole.

    Args:
        path: The page.
        outcomes: What became of the recordings.
        run: What was asked for.
        profile: Name of the set of parameters that those of the run started from.
        overwrite: Whether a file that exists is replaced.

    Raises:
        TargetError: It cannot be written; the message is a sentence.
    """
    # Paths may have bytes that are no text.
    data = page(outcomes, run, profile).encode('utf-8', 'backslashreplace')
    beside = _beside(path)
    with _told(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            beside.write_bytes(data)
            if not overwrite:
                path.touch(exist_ok=False)  # the name is ours from here on, or it is another's already
            beside.replace(path)
        finally:
            beside.unlink(missing_ok=True)


def _beside(path: Path) -> Path:
    """What a page is written to until it is whole."""
    return path.with_name(f'{path.name}.partial')


@contextlib.contextmanager
def _told(path: Path) -> Iterator[None]:
    """Make a sentence of what the file system says."""
    try:
        yield
    except TargetError:
        raise
    except FileExistsError:
        raise TargetError(f'the report {path} exists: --overwrite replaces it') from None
    except OSError as error:
        raise TargetError(f'cannot write {path}: {error.strerror or error}') from error


def page(outcomes: list[Outcome], run: Run, profile: str) -> str:
    """The page about a run; see :func:`write_report`."""
    recordings = [_recording(outcome, f'recording-{k}') for k, outcome in enumerate(outcomes, 1)]
    topics = [topic for recording in recordings for topic in recording.topics]
    # Of those without frames the table of several says all that there is.
    sections = [recording for recording in recordings if recording.topics or len(recordings) == 1]
    shares = _Shares(len(topics))
    name = outcomes[0].source.name if len(outcomes) == 1 else f'{len(outcomes)} recordings'
    version = importlib.metadata.version('line_feature_node')
    written = datetime.now(timezone.utc).strftime('%Y-%m-%d %H:%M UTC')
    head = tag(
        'head', tag('meta', charset='utf-8'),
        tag('meta', name='viewport', content='width=device-width, initial-scale=1'),
        tag('meta', http_equiv='Content-Security-Policy',
            content="default-src 'none'; img-src data:; style-src 'unsafe-inline'"),
        tag('meta', name='color-scheme', content='light dark'), tag('title', f'Line features of {name}'),
        tag('style', Markup(STYLE.read_text(encoding='utf-8'))))
    body = tag(
        'body',
        tag('header', tag('h1', f'Line features of {name}'),
            tag('p', f'line_feature_node {version}, written {written}', class_='muted')),
        tag('main', _summary(recordings, topics), _settings(run, profile),
            *(_section(recording, run, shares) for recording in sections)))
    return joined(Markup('<!DOCTYPE html>\n'), tag('html', head, body, lang='en'), Markup('\n'))


class _Shares:
    """How much of the page each topic gets, so that a page about many recordings stays one that can be opened."""

    def __init__(self, topics: int) -> None:
        each = max(topics, 1)
        self.columns = min(MOST_COLUMNS, max(FEWEST_COLUMNS, COLUMNS // (4 * each)))
        self._each = min(PICTURES_OF_TOPIC, max(1, PICTURES // each))
        self._left = PICTURES

    def pictures(self) -> int:
        """How many the next topic gets."""
        share = min(self._each, self._left)
        self._left -= share
        return share


def _recording(outcome: Outcome, anchor: str) -> Recording:
    frames = sorted(outcome.frames, key=lambda frame: frame.stamp)
    begin = frames[0].stamp if frames else None
    duration = (frames[-1].stamp - frames[0].stamp) / 1e9 if frames else 0.0
    of_topics: dict[str, list[Frame]] = {}
    for frame in frames:
        of_topics.setdefault(frame.topic, []).append(frame)
    topics = [_topic(name, of_topics[name], frames[0].stamp) for name in sorted(of_topics)]
    return Recording(outcome, anchor, begin, duration, topics)


def _topic(name: str, frames: list[Frame], begin: int) -> Topic:
    good = np.array([not frame.error for frame in frames])

    def of_good(value: Callable[[Frame], float]) -> Values:
        return np.array([value(frame) if not frame.error else math.nan for frame in frames], float)

    unknown = [math.nan] * 4
    agreement = np.array([frame.agreement or unknown for frame in frames], float)
    return Topic(
        name, frames, np.array([(frame.stamp - begin) / 1e9 for frame in frames]), good,
        of_good(lambda frame: frame.segments), of_good(lambda frame: frame.seconds * 1e3),
        of_good(lambda frame: (frame.stamp - frame.header_stamp) / 1e6 if frame.header_stamp else math.nan), agreement,
        np.sum([[0.0] * BANDS, *(frame.orientations for frame in frames if not frame.error)], axis=0))


def _median(values: Values) -> float:
    """Of those that are known; NaN where none is."""
    known = values[np.isfinite(values)]
    return float(np.median(known)) if len(known) else math.nan


def _high(values: Values) -> float:
    """The 95th percentile of those that are known; NaN where none is."""
    known = values[np.isfinite(values)]
    return float(np.quantile(known, 0.95)) if len(known) else math.nan


def _shown(value: float, unit: str = '') -> str:
    return with_unit(value, unit) if math.isfinite(value) else NONE


def _count(value: int) -> str:
    return number(value, 15)


@dataclass(frozen=True)
class _Figures:
    """What topics have in common, in figures."""

    frames: int
    failed: int
    segments: int
    median: float
    high: float
    precision: float
    recall: float
    angle: float
    offset: float

    @staticmethod
    def of(topics: list[Topic]) -> '_Figures':
        frames = sum(len(topic.frames) for topic in topics)
        milliseconds = np.concatenate([np.empty(0), *(topic.milliseconds for topic in topics)])
        agreement = np.concatenate([np.empty((0, 4)), *(topic.agreement for topic in topics)])
        precision, recall, angle, offset = (_median(agreement[:, k]) for k in range(4))
        return _Figures(
            frames, frames - sum(int(topic.good.sum()) for topic in topics),
            sum(frame.segments for topic in topics for frame in topic.frames),
            _median(milliseconds), _high(milliseconds), precision, recall, math.degrees(angle), offset)

    def cells(self, *, truth: bool) -> list[Markup]:
        """Of a row in a table, under the heads that :func:`_heads` gives."""
        rate = self.segments / (self.frames - self.failed) if self.frames > self.failed else math.nan
        texts = [_count(self.frames), _count(self.failed), _shown(rate), _shown(self.median, 'ms'),
                 _shown(self.high, 'ms'), *([_shown(self.precision), _shown(self.recall)] if truth else [])]
        return [tag('td', text, class_='bad' if k == 1 and self.failed else '') for k, text in enumerate(texts)]


def _heads(*, truth: bool) -> list[str]:
    heads = ['frames', 'failed', 'segments a frame', 'extraction', '95 % within']
    return [*heads, 'precision', 'recall'] if truth else heads


def _summary(recordings: list[Recording], topics: list[Topic]) -> Markup:
    """The figures of all, and a table where there are several recordings."""
    figures = _Figures.of(topics)
    unread = sum(bool(recording.outcome.error) for recording in recordings)
    duration = _duration(sum(recording.duration for recording in recordings))
    tiles = [('recordings', _count(len(recordings)), f'{_count(unread)} without result' if unread else duration)]
    if len(recordings) == 1 and topics:
        tiles = [('duration', duration, f'{len(topics)} topic{"s" if len(topics) > 1 else ""}')]
    tiles += [('frames', _count(figures.frames), f'{_count(figures.failed)} failed')] if topics else []
    if figures.frames > figures.failed:
        each = figures.segments / (figures.frames - figures.failed)
        tiles += [('segments', _count(figures.segments), f'{number(each)} a frame'),
                  ('extraction, median', _shown(figures.median, 'ms'), f'95 % within {_shown(figures.high, "ms")}')]
    if math.isfinite(figures.recall):
        tiles += [('precision', _shown(figures.precision), 'median, by length'),
                  ('recall', _shown(figures.recall), 'median, by length')]
    if math.isfinite(figures.angle):
        tiles.append(('error of angle', _shown(figures.angle, '°'), f'offset {_shown(figures.offset, "px")}'))
    return tag(
        'section', tag('h2', 'Summary', id='summary'),
        tag('dl', *(tag('div', tag('dt', name), tag('dd', value), tag('dd', more, class_='muted'))
                    for name, value, more in tiles), class_='tiles'),
        _table_of_recordings(recordings) if len(recordings) > 1 else Markup())


def _table_of_recordings(recordings: list[Recording]) -> Markup:
    truth = any(_has_truth(recording) for recording in recordings)
    heads = ['topics', 'duration', *_heads(truth=truth)]
    rows = []
    for recording in recordings:
        source = recording.outcome.source
        if recording.topics:
            rows.append(tag(
                'tr', tag('th', tag('a', source.name, href=f'#{recording.anchor}', title=str(source)), scope='row'),
                tag('td', _count(len(recording.topics))), tag('td', _duration(recording.duration)),
                *_Figures.of(recording.topics).cells(truth=truth)))
        else:
            rows.append(tag(
                'tr', tag('th', source.name, scope='row'),
                tag('td', tag('span', _why(recording.outcome), class_='bad'), tag('br'),
                    tag('span', str(source), class_='muted'), colspan=len(heads), class_='words')))
    return _table(['recording', *heads], rows, 'Recordings')


def _has_truth(recording: Recording) -> bool:
    return any(np.isfinite(topic.agreement).any() for topic in recording.topics)


def _why(outcome: Outcome) -> str:
    """Why nothing came of a recording, without its name before it."""
    return outcome.error or 'no frames'


def _table(heads: list[str], rows: list[Markup], name: str, class_: str = '') -> Markup:
    """A table that can be scrolled where the screen is too narrow for it."""
    head = tag('thead', tag('tr', *(tag('th', text, scope='col') for text in heads)))
    return tag('div', tag('table', tag('caption', name, class_='hidden'), head, tag('tbody', *rows), class_=class_),
               class_='scroll', role='region', aria_label=name, tabindex='0')


def _settings(run: Run, profile: str) -> Markup:
    """What was asked for, as far as it is not what everybody gets."""
    job = run.job
    chosen = [f'topics {", ".join(run.topics)}'] if run.topics else []
    chosen += [f'one of {run.every} frames'] if run.every > 1 else []
    chosen += [f'from {run.start:g} s'] if run.start is not None else []
    chosen += [f'to {run.end:g} s'] if run.end is not None else []
    chosen += ['with a mask'] if job.mask is not None else []
    default, start, specs = Parameters(), Parameters.profile(profile), Parameters.specs()
    rows = []
    for name, spec in specs.items():
        value, of_profile, of_default = (_value(getattr(each, name)) for each in (job.parameters, start, default))
        if value != of_default or value != of_profile:
            rows.append(tag('tr', tag('th', tag('code', name), scope='row'), tag('td', tag('strong', value)),
                            tag('td', of_profile), tag('td', of_default), tag('td', spec.unit),
                            tag('td', spec.description, class_='words')))
    heads = ['parameter', 'value', f'profile {profile}', 'default', 'unit', 'what it is']
    return tag(
        'section', tag('h2', 'Settings', id='settings'),
        tag('p', f'Profile {profile}. Frames: {", ".join(chosen) or "all"}.'),
        _table(heads, rows, 'Parameters that differ from the default or from the profile', 'settings') if rows
        else tag('p', 'Every parameter has its default.'))


def _value(value: Any) -> str:
    if isinstance(value, tuple):
        return ', '.join(f'{each:g}' for each in value)
    if isinstance(value, float):
        return 'unset' if math.isnan(value) else f'{value:g}'
    return str(value)


def _duration(seconds: float) -> str:
    return clock(seconds, seconds, exact=True) if seconds >= 120 else with_unit(round(seconds, 2), 's')


def _date(stamp: int) -> str:
    """A stamp as a date, or as seconds where it can be none."""
    with contextlib.suppress(OverflowError):
        if stamp >= CALENDAR:
            moment = datetime(1970, 1, 1, tzinfo=timezone.utc) + timedelta(microseconds=stamp // 1000)
            return moment.strftime('%Y-%m-%d %H:%M:%S.%f')[:-3] + ' UTC'
    return f'{stamp / 1e9:.3f} s'


def _section(recording: Recording, run: Run, shares: _Shares) -> Markup:
    """All about one recording."""
    outcome = recording.outcome
    facts = [('recording', str(outcome.source))]
    if recording.begin is not None:
        facts += [('new bag', str(outcome.target)), ('first frame', _date(recording.begin)),
                  ('duration', _duration(recording.duration))]
    if outcome.salvaged:
        facts.append(('damaged', str(outcome.salvaged)))
    if outcome.uncopied:
        facts.append(('not copied', f'{", ".join(outcome.uncopied)}: their types are missing'))
    parts = [tag('h2', outcome.source.name, id=recording.anchor),
             tag('dl', *(tag('div', tag('dt', name), tag('dd', text)) for name, text in facts), class_='facts')]
    if outcome.error or not recording.topics:
        parts.append(tag('p', _why(outcome), class_='error'))
    if len(recording.topics) > 1:
        truth = _has_truth(recording)
        rows = [tag('tr', tag('th', topic.name, scope='row'), *_Figures.of([topic]).cells(truth=truth))
                for topic in recording.topics]
        parts.append(_table(['topic', *_heads(truth=truth)], rows, f'Topics of {outcome.source.name}'))
    parts.append(_failures(recording))
    wanted = {topic.name: _chosen(topic, shares.pictures()) for topic in recording.topics}
    made = 'overlay' in run.job.outputs
    pictures = _overlays(outcome, wanted) if made else {}
    for k, topic in enumerate(recording.topics, 1):
        parts += [tag('h3', topic.name), _about(topic, recording, shares.columns)]
        if not topic.good.any():
            continue
        figures = _pictures(topic, recording, wanted[topic.name], pictures, f'{recording.anchor}-{k}')
        why = ('the run made no overlays' if not made else 'those above are enough for a page' if not wanted[topic.name]
               else 'the overlays cannot be read from the new bag')
        parts.append(figures or tag('p', f'No pictures: {why}.', class_='muted'))
    return tag('section', *parts, class_='recording')


def _failures(recording: Recording) -> Markup:
    """Reasons with their counts and where each came first."""
    failed = recording.outcome.failed.most_common()
    if not failed:
        return Markup()
    first: dict[str, tuple[float, Frame]] = {}
    for topic in recording.topics:
        for k in np.flatnonzero(~topic.good):
            found = float(topic.times[k]), topic.frames[k]
            first[found[1].error] = min(found, first.get(found[1].error, found), key=lambda each: each[0])
    rows = []
    for reason, count in failed[:REASONS]:
        seconds, frame = first[reason]
        rows.append(tag(
            'tr', tag('th', reason, scope='row', class_='words'), tag('td', _count(count)),
            tag('td', clock(seconds, recording.duration, exact=True)), tag('td', _date(frame.stamp)),
            tag('td', f'{frame.topic}, frame {_count(frame.number)}')))
    rest = sum(count for _, count in failed[REASONS:])
    return joined(
        tag('h3', 'Failures'),
        _table(['reason', 'frames', 'first after', 'first at', 'first of'], rows,
               f'Failures in {recording.outcome.source.name}', 'failures'),
        tag('p', f'{_count(len(failed) - REASONS)} other reasons: {_count(rest)} frames.') if rest else Markup())


def _about(topic: Topic, recording: Recording, columns: int) -> Markup:
    """Plots of a topic; what has no data is left out with a word."""
    parts, words = [], []
    if not topic.good.any():
        words.append(f'All {_count(len(topic.frames))} frames failed: there is nothing to draw.')
    elif topic.good.sum() == 1 or recording.duration == 0:
        words.append('No plots over time: there are not two frames at two times.')
    else:
        latency, why = _latency(topic)
        words += why
        for name, unit, series, whole, high in (
                ('Segments a frame', '', {'segments': topic.segments}, True, None),
                ('Extraction time', 'ms', {'extraction': topic.milliseconds}, False, None),
                ('Latency', 'ms', {'latency': latency}, False, None),
                ('Agreement with the truth', '', {
                    'precision': topic.agreement[:, 0], 'recall': topic.agreement[:, 1]}, False, 1.0)):
            known = np.isfinite(np.stack(list(series.values()))).any(axis=0)
            if known.any():
                parts.append(time_plot(Plot(
                    name, unit, topic.times[known], {of: values[known] for of, values in series.items()},
                    recording.duration, topic.times[~topic.good], whole=whole, high=high), columns))
        if len(topic.frames) > columns:
            words.append(f'{_count(len(topic.frames))} frames are drawn as {columns} columns: a line through the means '
                         'in a band from the least to the largest value of each column.')
        if not topic.good.all():
            words.append('Red marks at the foot of the plots are frames that failed.')
    if topic.lengths.sum() > 0:
        parts.append(rose(topic.lengths))
    elif topic.good.any():
        words.append('No orientations: no segments were found.')
    return joined(tag('div', *parts, class_='plots') if parts else Markup(),
                  tag('p', ' '.join(words), class_='muted') if words else Markup())


def _latency(topic: Topic) -> tuple[Values, list[str]]:
    """Milliseconds from the header's stamp to the recording's; all NaN, and why, where they say nothing."""
    nothing = np.full_like(topic.latency, math.nan)
    middle = _median(topic.latency)
    if math.isnan(middle):
        return nothing, ['No latency: the headers have no stamps.']
    if not np.any(topic.latency[np.isfinite(topic.latency)]):
        return nothing, ['No latency: the recording has the stamps of the headers.']
    if abs(middle) > SAME_CLOCK * 1e3:
        apart = _duration(abs(middle) / 1e3)
        return nothing, [f"No latency: the stamps of the headers are of another clock, {apart} from the recording's."]
    return topic.latency, []


def _chosen(topic: Topic, count: int) -> list[Frame]:
    """Frames for pictures, spread evenly over those that did not fail."""
    places = np.flatnonzero(topic.good)
    spread = np.linspace(0, max(len(places) - 1, 0), min(count, len(places))).round().astype(int)
    return [topic.frames[place] for place in places[spread].tolist()]


def _overlays(outcome: Outcome, wanted: dict[str, list[Frame]]) -> dict[tuple[str, int], Any]:
    """Overlays as the new bag has them, JPEGs by topic and stamp; those that cannot be read are left out."""
    found: dict[tuple[str, int], Any] = {}
    with contextlib.suppress(RecordingError), opened(outcome.target) as reader:
        for topic, frames in wanted.items():
            connections = [connection for connection in reader.connections if connection.topic == f'{topic}/overlay']
            for frame in frames if connections else ():
                for _, stamp, data in reader.messages(connections, frame.stamp, frame.stamp + 1):
                    with contextlib.suppress(ValueError):
                        message = deserialize(outcome.target, data, OUTPUTS['overlay'])
                        found.setdefault((topic, stamp), message.data)
    return found


def _pictures(
    topic: Topic, recording: Recording, wanted: list[Frame], found: dict[tuple[str, int], Any], anchor: str,
) -> Markup:
    """Pictures with the segments over them, each of which fills the screen when it is clicked; '' for none."""
    figures = []
    for k, frame in enumerate(wanted, 1):
        if (topic.name, frame.stamp) not in found:
            continue
        data, width, height = _fitted(found[topic.name, frame.stamp])
        time = clock((frame.stamp - (recording.begin or 0)) / 1e9, recording.duration, exact=True)
        text = f'{time}, frame {_count(frame.number)}: {_count(frame.segments)} segments'
        picture = tag('img', src=f'data:image/jpeg;base64,{base64.b64encode(data).decode()}', width=width,
                      height=height, alt=f'{topic.name} with its segments drawn over it, {text}')
        name = f'{anchor}-picture-{k}'
        figures.append(tag(
            'figure', tag('a', picture, href=f'#{name}', title='Enlarge', class_='enlarge'),
            tag('figcaption', tag('span', topic.name, class_='muted'), tag('br'), text,
                tag('a', 'Close', href=f'#{anchor}-pictures', class_='close')), id=name, class_='picture'))
    if not figures:
        return Markup()
    return tag('div', tag('div', *figures, class_='pictures'), colour_key(), id=f'{anchor}-pictures')


def _fitted(jpeg: Any) -> tuple[bytes, int, int]:
    """A JPEG of at most SIDE pixels a side, its width and its height."""
    picture = np.asarray(cv2.imdecode(jpeg, cv2.IMREAD_COLOR), np.uint8)
    height, width = picture.shape[:2]
    if max(height, width) <= SIDE:
        return bytes(jpeg), width, height
    scale = SIDE / max(height, width)
    size = max(1, round(width * scale)), max(1, round(height * scale))
    smaller = np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA), np.uint8)
    return encode_jpeg(smaller, QUALITY).tobytes(), *size
