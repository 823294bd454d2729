import base64
import os
import re
from html.parser import HTMLParser
from pathlib import Path

import cv2
import numpy as np
import pytest
from browser import Browser, executable
from test_recordings import BEGIN, IMAGE, film, image, picture, stamp_of, write

from line_feature_node.bag import Outcome, Run, TargetError, process_recording
from line_feature_node.core import Parameters
from line_feature_node.frames import Frames
from line_feature_node.markup import VOID
from line_feature_node.report import PICTURES, PICTURES_OF_TOPIC, SIDE, check_report, page, write_report
from line_feature_node.slices import BANDS, Frame, Job
from line_feature_node.workers import inline

BAGS = Path(__file__).resolve().parents[1] / 'bags'
RUN = Run(Job(Parameters(), truth=True))
UNKNOWN = float('nan')
#: What no recording may do to a page.
EVIL = '<script>alert("1")</script><img src=x onerror=alert(1)>&amp;"\''


class Read(HTMLParser):
    """What a browser would make of a page: its elements, its text, and its tables as rows of text."""

    def __init__(self, text):
        super().__init__()
        self.open, self.elements, self.text, self.rows = [], [], '', []
        self.feed(text)
        self.close()
        assert self.open == []

    def handle_starttag(self, name, attributes):
        self.elements.append((name, dict(attributes)))
        if name not in VOID:
            self.open.append(name)
        if name == 'tr':
            self.rows.append([])
        if name in ('td', 'th'):
            self.rows[-1].append('')

    def handle_endtag(self, name):
        assert self.open.pop() == name

    def handle_data(self, data):
        if not {'style', 'title'} & set(self.open):
            self.text += data + ' '
        if {'td', 'th'} & set(self.open):
            self.rows[-1][-1] += data

    def all(self, name):
        return [attributes for tag, attributes in self.elements if tag == name]

    @property
    def plots(self):
        return [plot['aria-label'].split(' over time')[0].split(',')[0] for plot in self.all('svg') if 'role' in plot]


def process(source, folder, run=RUN):
    return process_recording(source, folder / f'{source.name}-lines', run, inline(), lambda *_: None)


def frames(count, topic='/camera', late=5, **changes):
    """Frames as a run leaves them."""
    return [Frame(**{
        'topic': topic, 'number': k, 'stamp': stamp_of(k), 'segments': 100 + k % 7, 'seconds': 1e-3 + k % 5 * 1e-4,
        'orientations': [1.0] * BANDS, 'header_stamp': stamp_of(k) - late * 10**6, **changes}) for k in range(count)]


def outcome(made, name='drive'):
    return Outcome(Path(f'/somewhere/{name}.bag'), Path('/somewhere/lines'), Frames(made))


def read(*outcomes, run=RUN, profile='default'):
    return Read(page(list(outcomes), run, profile))


@pytest.fixture(scope='module')
def corridor(tmp_path_factory):
    folder = tmp_path_factory.mktemp('corridor')
    return process(BAGS / 'corridor', folder, Run(Job(Parameters(), truth=True), end=2.0))


# What is in it

def test_a_page_is_about_its_run(corridor):
    made = read(corridor)
    assert made.plots == ['Segments a frame', 'Extraction time', 'Agreement with the truth', 'Orientations']
    assert 'No latency: the recording has the stamps of the headers.' in made.text
    assert f' {len(corridor.frames)} ' in made.text
    assert 'Every parameter has its default.' in made.text
    assert '2027-01-15 08:00:00.000 UTC' in made.text
    median = np.median([frame.agreement[1] for frame in corridor.frames])
    assert re.search(rf'recall {median:.3f}'.rstrip('0'), made.text)


def test_pictures_are_spread_over_the_recording_and_are_those_of_the_bag(corridor):
    made = read(corridor)
    pictures = made.all('img')
    assert len(pictures) == PICTURES_OF_TOPIC
    assert '0.00\u00a0s, frame 0' in pictures[0]['alt']
    assert f'frame {len(corridor.frames) - 1}:' in pictures[-1]['alt']
    for attributes in pictures:
        data = base64.b64decode(attributes['src'].removeprefix('data:image/jpeg;base64,'), validate=True)
        decoded = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
        assert decoded.shape == (int(attributes['height']), int(attributes['width']), 3) == (480, 640, 3)


def test_large_pictures_become_smaller(tmp_path):
    large = np.kron(picture(), np.ones((30, 30), np.uint8))
    made = read(process(write(tmp_path / 'rec', [('/camera', IMAGE, BEGIN, image(large))]), tmp_path))
    [attributes] = made.all('img')
    assert (attributes['width'], attributes['height']) == (str(SIDE), '720')


def test_every_topic_has_its_plots_and_pictures(tmp_path):
    entries = sorted([*film(8, '/left'), *film(6, '/right', offset=5)], key=lambda entry: entry[2])
    made = read(process(write(tmp_path / 'rec', entries), tmp_path))
    assert made.plots == 2 * ['Segments a frame', 'Extraction time', 'Latency', 'Orientations']
    assert [attributes['alt'].split()[0] for attributes in made.all('img')] == 6 * ['/left'] + 6 * ['/right']
    assert [row[:3] for row in made.rows if row[0].startswith('/')] == [['/left', '8', '0'], ['/right', '6', '0']]
    assert 'median 1\u00a0ms, from 1 to 1\u00a0ms' in made.text  # what the films' headers say


def test_failures_are_counted_by_reason_with_the_first_of_each(tmp_path):
    bad = {3: image(picture(), encoding=EVIL), 4: image(picture(), encoding=EVIL), 6: image(picture(), step=1)}
    entries = [(topic, kind, stamp, bad.get(k, message)) for k, (topic, kind, stamp, message) in enumerate(film(9))]
    made = read(process(write(tmp_path / 'rec', entries), tmp_path))
    encoding, step = [row for row in made.rows if row[-1].startswith('/camera, frame')]
    assert encoding[0].startswith('unknown encoding ')
    assert EVIL.split('"', maxsplit=1)[0] in encoding[0]
    assert encoding[1:] == ['2', '0.03\u00a0s', '2023-11-14 22:13:20.153 UTC', '/camera, frame 3']
    assert step[0].startswith('step is 1')
    assert step[1:] == ['1', '0.06\u00a0s', '2023-11-14 22:13:20.183 UTC', '/camera, frame 6']
    assert 'Red marks' in made.text


def test_many_reasons_are_summed_up():
    some = frames(50)
    for k, frame in enumerate(some):
        frame.error = f'reason {k}' if k < 30 else ''
    made = read(outcome(some))
    assert sum(row[0].startswith('reason') and row[0] != 'reason' for row in made.rows) == 20
    assert '10 other reasons: 10 frames.' in made.text


def test_parameters_that_differ_are_told():
    chosen = Parameters.profile('corridor', min_length=20.0, alpha=2.0)
    made = read(outcome(frames(3)), run=Run(Job(chosen), every=5, start=1.5), profile='corridor')
    rows = {row[0]: row[1:4] for row in made.rows}
    assert rows['T1'] == ['5', '5', '4']
    assert rows['min_length'] == ['20', '12', '0']
    assert rows['alpha'] == ['2', 'unset', 'unset']
    assert 'tau1' not in rows
    assert 'Profile corridor. Frames: one of 5 frames, from 1.5 s.' in made.text


def test_several_recordings_are_a_table_with_a_section_each(tmp_path):
    unread = Outcome(Path('/somewhere/cut.bag'), tmp_path, error='cannot be read (cut)')
    made = read(outcome(frames(5), 'one'), unread, outcome(frames(7, agreement=[0.5, 0.25, 0.1, 1.0]), 'two'))
    table = {row[0]: row[1:] for row in made.rows}
    assert table['one.bag'][1:3] == ['0.04\u00a0s', '5']
    assert table['two.bag'][-2:] == ['0.5', '0.25']
    assert table['cut.bag'] == ['cannot be read (cut)/somewhere/cut.bag']
    links = {attributes['href'] for attributes in made.all('a')}
    assert links == {f'#{attributes["id"]}' for attributes in made.all('h2') if 'recording' in attributes['id']}
    assert len(links) == 2


# What has no data is left out with a word

@pytest.mark.parametrize(('some', 'run', 'plots', 'word'), [
    (frames(0), RUN, [], 'no frames'),
    (frames(1), RUN, ['Orientations'], 'there are not two frames at two times'),
    (frames(3, stamp=BEGIN), RUN, ['Orientations'], 'there are not two frames at two times'),
    (frames(3, error='bad', segments=0, orientations=[]), RUN, [], 'All 3 frames failed'),
    (frames(3, segments=0, orientations=[0.0] * BANDS), RUN, ['Segments a frame', 'Extraction time', 'Latency'],
     'no segments were found'),
    (frames(3, header_stamp=0), RUN, ['Segments a frame', 'Extraction time', 'Orientations'],
     'the headers have no stamps'),
    (frames(3, header_stamp=BEGIN // 2), RUN, ['Segments a frame', 'Extraction time', 'Orientations'],
     'the stamps of the headers are of another clock'),
    (frames(3), Run(Job(Parameters(), outputs=('segments',))),
     ['Segments a frame', 'Extraction time', 'Latency', 'Orientations'], 'No pictures: the run made no overlays.'),
    (frames(3), RUN, ['Segments a frame', 'Extraction time', 'Latency', 'Orientations'],
     'the overlays cannot be read from the new bag'),
    (frames(3, agreement=[UNKNOWN] * 4), RUN, ['Segments a frame', 'Extraction time', 'Latency', 'Orientations'],
     'Every parameter has its default'),
    (frames(3, agreement=[UNKNOWN, 0.5, UNKNOWN, UNKNOWN]), RUN,
     ['Segments a frame', 'Extraction time', 'Latency', 'Agreement with the truth', 'Orientations'],
     'precision: none')])
def test_what_has_no_data_is_left_out_with_a_word(some, run, plots, word):
    made = read(outcome(some), run=run)
    assert made.plots == plots
    assert word in made.text
    assert 'nan' not in re.sub(r'[\w-]*nan[\w-]+|[\w-]+nan', '', made.text)


@pytest.mark.parametrize('stamps', [[0, 10**9], [5, 2**63 - 1], [2**63, 2**64 - 1]])
def test_stamps_may_be_any(stamps):
    some = frames(2)
    for frame, stamp in zip(some, stamps, strict=True):
        frame.stamp = stamp
    assert 'Segments a frame' in read(outcome(some)).plots


# What comes from a recording is text

def test_names_and_errors_with_markup_stay_text(tmp_path):
    some = [*frames(3, EVIL), *frames(1, EVIL, error=EVIL)]
    evil = Outcome(tmp_path / EVIL.replace('/', ' '), tmp_path / 'out', Frames(some), error=EVIL, uncopied=[EVIL])
    run = Run(Job(Parameters()), topics=(EVIL,))
    plain = read(outcome(frames(3)), run=run)
    for outcomes in ([evil], [evil, evil]):
        made = read(*outcomes, run=run)
        assert {name for name, _ in made.elements} <= {name for name, _ in plain.elements} | {
            'a', 'br', 'img', 'table', 'caption', 'thead', 'tbody', 'tr', 'th', 'td', 'code', 'strong'}
        assert made.all('img') == []
        assert not any(name.startswith('on') for _, attributes in made.elements for name in attributes)
        assert EVIL in made.text


# Size

def test_an_hour_is_a_small_page():
    made = page([outcome(frames(100_000, agreement=[0.9, 0.8, 0.01, 0.1]))], RUN, 'default')
    assert len(made) < 1e6
    assert '100\u202f000 frames are drawn as 400 columns' in made


def test_an_archive_is_no_huge_page():
    made = page([outcome(frames(120), f'drive{k}') for k in range(300)], RUN, 'default')
    assert len(made) < 20e6


def test_pictures_of_many_topics_are_few(tmp_path):
    topics = [f'/camera{k:02d}' for k in range(PICTURES + 2)]
    path = write(tmp_path / 'rec', [(topic, IMAGE, BEGIN, image(picture())) for topic in topics] + [
        (topic, IMAGE, BEGIN + 10**9, image(picture(1))) for topic in topics])
    made = read(process(path, tmp_path))
    assert len(made.all('img')) == PICTURES
    assert made.text.count('those above are enough for a page') == 2


# Writing

def test_a_page_that_exists_is_refused_or_replaced(tmp_path):
    path = tmp_path / 'report.html'
    path.write_text('mine')
    with pytest.raises(TargetError, match='--overwrite'):
        write_report(path, [outcome(frames(2))], RUN, 'default', overwrite=False)
    assert path.read_text() == 'mine'
    write_report(path, [outcome(frames(2))], RUN, 'default', overwrite=True)
    assert path.read_text(encoding='utf-8').startswith('<!DOCTYPE html>')
    assert [each.name for each in tmp_path.iterdir()] == ['report.html']


def test_a_page_is_written_whole_or_not_at_all(tmp_path, monkeypatch):
    def full(path, data):
        with path.open('wb') as file:
            file.write(data[:10])
        raise OSError(28, 'No space left on device')

    monkeypatch.setattr(Path, 'write_bytes', full)
    with pytest.raises(TargetError, match=r'report\.html: No space left on device'):
        write_report(tmp_path / 'report.html', [outcome(frames(2))], RUN, 'default', overwrite=False)
    assert list(tmp_path.iterdir()) == []


def test_names_that_are_no_text_can_be_written(tmp_path):
    strange = Outcome(Path(os.fsdecode(b'/a/b\xff.bag')), tmp_path, Frames(frames(2)))
    write_report(tmp_path / 'report.html', [strange], RUN, 'default', overwrite=False)
    assert 'b\\udcff.bag' in (tmp_path / 'report.html').read_text(encoding='utf-8')


@pytest.mark.parametrize(('name', 'reason'), [
    ('there.html', '--overwrite replaces it'), ('folder', 'it is there, and no file'), ('none/a.html', 'no folder'),
    ('there.html/a.html', 'no folder'), ('in/rec/a.html', 'in the place of the recording'),
    ('in/rec', 'in the place of the recording'), ('out/a.html', 'in the place of the new bag'),
    ('pipe', 'it is there, and no file'), ('x' * 300, 'File name too long'), ('x' * 250, 'File name too long')])
def test_what_cannot_be_written_is_told_before_the_run(tmp_path, name, reason):
    for folder in ('folder', 'in/rec'):
        (tmp_path / folder).mkdir(parents=True)
    (tmp_path / 'there.html').touch()
    os.mkfifo(tmp_path / 'pipe')
    pairs = [(tmp_path / 'in' / 'rec', tmp_path / 'out')]
    with pytest.raises(TargetError, match=reason):
        check_report(tmp_path / name, pairs, overwrite=False)
    assert sorted(path.name for path in tmp_path.iterdir()) == ['folder', 'in', 'pipe', 'there.html']
    if 'overwrite' not in reason:
        with pytest.raises(TargetError, match=reason):
            check_report(tmp_path / name, pairs, overwrite=True)


@pytest.mark.skipif(not Path('/proc/self').exists(), reason='no folder that even its owner cannot write to')
def test_a_folder_that_cannot_be_written_to_is_told_before_the_run_even_to_root(tmp_path):
    with pytest.raises(TargetError, match='^cannot write /proc/self/report.html: '):
        check_report(Path('/proc/self/report.html'), [(tmp_path / 'in', tmp_path / 'out')], overwrite=False)


def test_the_check_leaves_nothing_and_takes_nothing(tmp_path):
    (tmp_path / 'b.html.partial').write_text('mine')
    for name in ('a.html', 'b.html'):
        check_report(tmp_path / name, [(tmp_path / 'in', tmp_path / 'out')], overwrite=False)
    assert [path.name for path in tmp_path.iterdir()] == ['b.html.partial']


def test_a_page_may_be_beside_the_bags_in_a_folder_that_is_to_be_made(tmp_path):
    check_report(tmp_path / 'out' / 'a.html', [(tmp_path / 'in', tmp_path / 'out' / 'in')], overwrite=False)
    write_report(tmp_path / 'out' / 'a.html', [outcome(frames(2))], RUN, 'default', overwrite=False)
    assert (tmp_path / 'out' / 'a.html').exists()


# In a browser

@pytest.fixture(scope='module')
def browser(tmp_path_factory):
    if not executable():
        pytest.skip('there is no Chromium')
    browser = Browser(tmp_path_factory.mktemp('browser'))
    yield browser
    browser.close()


@pytest.fixture(scope='module')
def made(corridor, tmp_path_factory):
    """A page with everything: pictures, truth, latency, failures, parameters, two recordings, and one that is none."""
    folder = tmp_path_factory.mktemp('page')
    some = [*frames(2000, EVIL), *frames(40, f'/a/{"long/" * 30}name', error=f'{EVIL} {"reason" * 40}')]
    outcomes = [corridor, outcome(some, 'long' * 30), Outcome(Path('/a/cut.bag'), folder, error='cut')]
    run = Run(Job(Parameters.profile('lane_tracking', T1=6.0), truth=True))
    write_report(folder / 'report.html', outcomes, run, 'lane_tracking', overwrite=False)
    return folder / 'report.html'


@pytest.mark.parametrize('scheme', ['light', 'dark'])
@pytest.mark.parametrize('width', [1280, 390, 320])
def test_a_browser_shows_it(browser, made, width, scheme):
    browser.open(made, width, scheme=scheme)
    assert browser.complaints == []
    assert browser.requests == [made.as_uri()]
    assert browser.value('document.documentElement.scrollWidth <= innerWidth')
    assert browser.value('[...document.images].map(each => each.complete && each.naturalWidth)') == [640] * 6
    sizes = browser.value(
        "[...document.querySelectorAll('svg[role]')].map(each => [each.clientWidth, each.clientHeight])")
    assert len(sizes) == 8
    assert min(min(size) for size in sizes) > 100
    marks = browser.value("[...document.querySelectorAll('.line, .petal')].map(each => each.getBBox().width)")
    assert len(marks) > 20
    assert min(marks) > 0


@pytest.mark.parametrize('scheme', ['light', 'dark'])
def test_words_stand_out_from_their_ground(browser, made, scheme):
    """The contrast that WCAG 2 asks for, 4.5 to 1."""
    browser.open(made, scheme=scheme)
    ratios = browser.value("""(() => {
        const part = value => value <= 0.03928 ? value / 12.92 : ((value + 0.055) / 1.055) ** 2.4;
        const light = colour => { const [r, g, b] = colour.match(/[\\d.]+/g).map(value => part(value / 255));
                                  return 0.2126 * r + 0.7152 * g + 0.0722 * b; };
        const ground = each => { const colour = getComputedStyle(each).backgroundColor;
                                 return colour === 'rgba(0, 0, 0, 0)' ? ground(each.parentElement) : colour; };
        return [...document.querySelectorAll('main *, header *')].filter(each => [...each.childNodes].some(
            node => node.nodeType === 3 && node.data.trim()) && !each.closest('title')).map(each => {
            const style = getComputedStyle(each), svg = each.closest('svg');
            const pair = [light(svg ? style.fill : style.color), light(ground(svg ? svg.parentElement : each))];
            return (Math.max(...pair) + 0.05) / (Math.min(...pair) + 0.05); });
    })()""")
    assert len(ratios) > 100
    assert min(ratios) >= 4.5


def test_a_picture_fills_the_screen_and_goes_back(browser, made):
    browser.open(made)
    widths = '[...document.images].map(each => Math.round(each.getBoundingClientRect().width))'
    small = browser.value(widths)
    browser.value("document.querySelectorAll('.enlarge')[1].click()")
    large = browser.value(widths)
    assert large[1] > 1000 > 2 * small[1]
    assert large[0] == small[0]
    browser.value("document.querySelector('.picture:target .close').click()")
    assert browser.value(widths) == small
