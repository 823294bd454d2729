"""The command `line_features`."""

import importlib.metadata
from pathlib import Path
from typing import Annotated, Any, Optional

import cv2
import numpy as np
import typer
from rich.progress import Progress
from rich.table import Table

from line_feature_node import files, scenes, section3, truth
from line_feature_node.cli_bag import bag
from line_feature_node.cli_options import console, errors, fail, path_of, with_parameters
from line_feature_node.core import STEPS, Parameters, end_points
from line_feature_node.figures import sheet
from line_feature_node.images import decode, displayable
from line_feature_node.overlay import SECTIONS

app = typer.Typer(
    no_args_is_help=True, add_completion=False, pretty_exceptions_enable=False, rich_markup_mode=None)

Out = Annotated[Path, typer.Option(metavar='PATH', parser=path_of, help='Folder for the overlays and tables.')]


def _print_version(wanted: bool) -> None:
    if wanted:
        console.print(importlib.metadata.version('line_feature_node'))
        raise typer.Exit


@app.callback()
def _options(
    _version: Annotated[bool, typer.Option(
        '--version', help='Print the version.', is_eager=True, callback=_print_version)] = False,
) -> None:
    """Line segments from images, after "Extraction of line features in a noisy image" (1997)."""


@app.command()
@with_parameters
def image(
    paths: Annotated[list[Path], typer.Argument(
        metavar='PATH', parser=path_of, help='Image files, or folders of them.')],
    parameters: Parameters,
    out: Out = Path('line_features'),
    stages: Annotated[bool, typer.Option('--stages', help='Write a picture of what each step made, too.')] = False,
) -> None:
    """Extract the segments of image files: an overlay picture (PNG) and a table (CSV) of each.

    Ends with status 0 when all went well, 1 when some files failed and 2 when all did.
    """
    try:
        found = files.find_images(paths)
    except OSError as error:
        fail(f'{error.filename}: {error.strerror}')
    outcomes = _process(found, out, parameters, stages=stages)
    done = [outcome for outcome in outcomes if not outcome.error]
    if done:
        console.print(_table_of_steps(done))
        console.print(f'{len(done)} of {len(outcomes)} files done; overlays and tables are in {out}', markup=False)
    raise typer.Exit(0 if len(done) == len(outcomes) else 1 if done else 2)


def _process(paths: list[Path], out: Path, parameters: Parameters, *, stages: bool = False) -> list[files.Outcome]:
    """Process files with a progress bar on a terminal, a line for each, and errors on standard error."""
    outcomes = []
    try:
        with Progress(console=console, transient=True, disable=not console.is_terminal) as progress:
            run = files.process(paths, out, parameters, stages=stages)
            for outcome in progress.track(run, total=len(paths), description=''):
                outcomes.append(outcome)
                if outcome.error:
                    errors.print(f'{outcome.path}: {outcome.error}', markup=False)
                else:
                    console.print(_line_of(outcome), markup=False)
                if outcome.hint:
                    errors.print(f'{outcome.path}: nothing found; {outcome.hint}', markup=False)
    except OSError as error:
        fail(f'cannot write to {out}: {error.strerror}')
    return outcomes


def _line_of(outcome: files.Outcome) -> str:
    linked = 0 if outcome.segments is None else len(outcome.segments)
    return (f'{outcome.path}: {outcome.width}x{outcome.height}, {outcome.unlinked} segments, '
            f'{linked} after linking or refinement, {sum(outcome.times.values()) * 1e3:.1f} ms')


def _table_of_steps(outcomes: list[files.Outcome]) -> Table:
    table = Table('step', 'ms' if len(outcomes) == 1 else 'ms (median)')
    table.columns[1].justify = 'right'
    for step in STEPS:
        table.add_row(step, f'{np.median([outcome.times[step] for outcome in outcomes]) * 1e3:.2f}')
    table.add_section()
    table.add_row('all', f'{np.median([sum(outcome.times.values()) for outcome in outcomes]) * 1e3:.2f}')
    return table


@app.command()
@with_parameters
def compare(
    parameters: Parameters,
    path: Annotated[Optional[Path], typer.Argument(
        metavar='IMAGE', readable=False, help='Image file; a rendered corridor without.')] = None,
    noise: Annotated[float, typer.Option(
        min=0.0, max=100.0, help='Noise of the rendered corridors, in grey levels.')] = 4.0,
    out: Out = Path('line_features'),
) -> None:
    """Compare ways of thinning edges and of fitting lines, as section 3 of the paper does: the six panels of Fig. 5.

    Without an image, on rendered corridors, the errors of each combination are measured against the ground truth.
    """
    try:
        image = scenes.corridor(noise=noise).image if path is None else decode(path.read_bytes())
        panels = section3.compare_pictures(displayable(image, parameters), parameters)
        target = out / f'{"corridor" if path is None else path.stem}-section3.png'
        out.mkdir(parents=True, exist_ok=True)
        files.write_picture(target, sheet(panels, columns=2))
    except OSError as error:
        fail(f'{error.filename}: {error.strerror}' if error.filename == str(path)
             else f'cannot write to {out}: {error.strerror}')
    except (TypeError, ValueError) as error:
        fail(str(error) if path is None else f'{path}: {error}')
    if path is None:
        console.print(_table_of_errors(section3.measure_errors(parameters, noise)))
    console.print(f'panels: {target}', markup=False)


def _table_of_errors(rows: list[section3.Errors]) -> Table:
    table = Table('thinning', 'orientation', 'precision', 'recall', 'angle', 'offset')
    for row in rows:
        table.add_row(row.thinning, row.orientation, f'{row.precision:.3f}', f'{row.recall:.3f}',
                      f'{np.degrees(row.angle):.3f} deg', f'{row.offset:.3f} px')
    return table


@app.command()
@with_parameters
def demo(
    parameters: Parameters,
    frames: Annotated[int, typer.Option(min=2, max=1000, help='Frames of the drive.')] = 60,
    out: Out = Path('demo'),
) -> None:
    """Drive a camera down a rendered corridor: its images go through the node over ROS 2, beside the ground truth.

    Without ROS 2 one picture of the corridor is processed, without a node.
    """
    try:
        from line_feature_node.demo import play, render
    except ImportError as error:
        errors.print(f'ROS 2 is not there ({error}): one picture, without the node', markup=False)
        _demo_of_a_picture(parameters, out)
        return
    with console.status('rendering the corridor'):
        drive = render(frames)
    with console.status('the node compiles its kernels the first time, and gets the images'):
        try:
            outcome = play(drive, _ros_arguments(parameters))
        except RuntimeError as error:
            fail(str(error))
    console.print(_table_of_drive(outcome))
    if outcome.overlay is None:
        fail('no overlay came from the node')
    target = out / 'overlay.png'
    try:
        out.mkdir(parents=True, exist_ok=True)
        files.write_picture(target, outcome.overlay)
    except OSError as error:
        fail(f'cannot write to {out}: {error.strerror}')
    console.print(f'last overlay that came: {target}', markup=False)


def _ros_arguments(parameters: Parameters) -> list[str]:
    """What differs from the defaults, for the command line of the node."""
    arguments = []
    for name in Parameters.specs():
        value = getattr(parameters, name)
        if value == value and value != getattr(Parameters(), name):
            arguments += ['-p', f'{name}:={list(value) if isinstance(value, tuple) else value}']
    return arguments


def _table_of_drive(outcome: Any) -> Table:
    """What came of the drive."""
    table = Table('over ROS 2', '')
    table.columns[1].justify = 'right'
    table.add_row('images published, 30 a second', str(outcome.published))
    table.add_row('answered with segments', str(len(outcome.latencies)))
    if outcome.latencies:
        p50, p99 = np.percentile(outcome.latencies, (50, 99)) * 1e3
        table.add_row('latency, median and 99 %', f'{p50:.1f} ms, {p99:.1f} ms')
        table.add_row('segments an image (median)', f'{np.median(outcome.segments):.0f}')
    agreements = [agreement for agreement in outcome.agreements if agreement.recall > 0]
    if agreements:
        found = {name: np.median([getattr(agreement, name) for agreement in agreements])
                 for name in ('precision', 'recall', 'angle', 'offset')}
        table.add_row('precision and recall against the truth', f'{found["precision"]:.2f}, {found["recall"]:.2f}')
        table.add_row('error of orientation and position',
                      f'{np.degrees(found["angle"]):.2f} degrees, {found["offset"]:.2f} px')
    table.add_row('what the node says of itself', outcome.health)
    table.add_row('and of its images', outcome.counts)
    return table


def _demo_of_a_picture(parameters: Parameters, out: Path) -> None:
    """Render a corridor as a robot's camera sees it, extract its segments and hold them against the truth."""
    scene = scenes.corridor()
    picture = out / 'corridor.png'
    try:
        out.mkdir(parents=True, exist_ok=True)
        picture.write_bytes(cv2.imencode('.png', scene.image)[1].tobytes())
    except OSError as error:
        fail(f'cannot write to {out}: {error.strerror}')
    [outcome] = _process([picture], out, parameters)
    if outcome.segments is None:
        raise typer.Exit(2)
    console.print(_table_of_steps([outcome]), _table_of_segments(outcome.segments))
    agreement = truth.compare(end_points(outcome.segments), scene.truth, scene.weak)
    if agreement.recall > 0:
        console.print(f'against the ground truth: precision {agreement.precision:.2f}, recall {agreement.recall:.2f}, '
                      f'orientation within {np.degrees(agreement.angle):.2f} degrees and position within '
                      f'{agreement.offset:.2f} px (medians)')
    else:
        console.print('against the ground truth: nothing of it was found')
    console.print(f'table:   {outcome.table}\noverlay: {outcome.overlay}', markup=False)


def _table_of_segments(segments: Any) -> Table:
    table = Table('code', 'edges', 'segments', 'total length', 'longest')
    for column in table.columns[2:]:
        column.justify = 'right'
    for code, name in SECTIONS.items():
        length = segments['length'][segments['code'] == code]
        table.add_row(str(code), name, str(length.size), f'{length.sum():.0f} px', f'{length.max(initial=0):.0f} px')
    return table


app.command('bag')(with_parameters(bag))
