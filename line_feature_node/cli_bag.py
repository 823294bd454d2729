"""The command `line_features bag`: recordings in, bags with segments out."""

import dataclasses
import json
import math
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any, Optional

import numpy as np
import typer
from numpy.typing import NDArray
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn
from rich.table import Table

from line_feature_node.bag import NO_IMAGES, Outcome, Run, TargetError, partial_folder, process_recording
from line_feature_node.cli_options import console, errors, fail, path_of
from line_feature_node.command import INTERRUPTED
from line_feature_node.core import Parameters
from line_feature_node.files import read_mask, unique_names
from line_feature_node.options import Options
from line_feature_node.recordings import OUTPUTS, DamagedError, RecordingError, find_recordings
from line_feature_node.report import check_report, write_report
from line_feature_node.slices import TRUTH, Frame, Job
from line_feature_node.workers import Workers, WorkersError, cluster, local

#: Status of a process that SIGINT or SIGTERM ended, as shells have it.
STATUS = {signal.SIGINT: INTERRUPTED, signal.SIGTERM: 143}


class _Interrupted(BaseException):
    """A signal asked for the end."""

    def __init__(self, number: int) -> None:
        super().__init__()
        self.number = signal.Signals(number)


def bag(
    recordings: Annotated[list[Path], typer.Argument(
        metavar='IN', parser=path_of, help='Recordings (.bag, .mcap, .db3, folders of ROS 2), or folders of them.')],
    parameters: Parameters,
    profile: str,
    options: Options,
    out: Annotated[Path, typer.Option(
        metavar='PATH', parser=path_of, help='The new bag; of several recordings, or a folder of them, their folder.')],
    topic: Annotated[Optional[list[str]], typer.Option(help='Topic of images; all of them unless given.')] = None,
    start: Annotated[Optional[float], typer.Option(min=0, help='Seconds from the beginning to start at.')] = None,
    end: Annotated[Optional[float], typer.Option(min=0, help='Seconds from the beginning to end at.')] = None,
    every: Annotated[int, typer.Option(min=1, help='Process one of so many frames of each topic.')] = 1,
    storage: Annotated[str, typer.Option(help='Format of the new bag: mcap or sqlite3.')] = 'mcap',
    copy: Annotated[bool, typer.Option('--copy', help='Copy everything of the input, too.')] = False,
    csv: Annotated[bool, typer.Option('--csv', help='Write segments.csv into the new bag, one row a segment.')] = False,
    only_segments: Annotated[bool, typer.Option('--only-segments', help='Neither markers nor overlays.')] = False,
    mask_file: Annotated[Optional[Path], typer.Option(help='Image file, black where no edges are wanted.')] = None,
    truth: Annotated[bool, typer.Option('--truth', help='Compare with true segments on TOPIC/truth.')] = False,
    report: Annotated[Optional[Path], typer.Option(help='Write a page (HTML) about the run.')] = None,
    workers: Annotated[Optional[int], typer.Option(min=1, help='Processes; as many as processors.')] = None,
    scheduler: Annotated[Optional[str], typer.Option(help='Dask scheduler instead, tcp://host:port.')] = None,
    salvage: Annotated[bool, typer.Option('--salvage', help='Process what precedes a cut or damage.')] = False,
    resume: Annotated[bool, typer.Option('--resume', help='Go on from what an interrupted run left.')] = False,
    overwrite: Annotated[bool, typer.Option('--overwrite', help='Replace a bag that is there.')] = False,
    quiet: Annotated[bool, typer.Option('--quiet', help='Only errors are printed.')] = False,
    as_json: Annotated[bool, typer.Option('--json', help='Print one line of JSON at the end.')] = False,
) -> None:
    """Extract the segments of recordings into new bags: segments, markers and overlays beside the stamps of the images.

    Ends with status 0 when all went well, 1 when some frames, copies or recordings failed or part of one was salvaged,
    and 2 when nothing could be read.
    """
    if storage not in ('mcap', 'sqlite3'):
        raise typer.BadParameter(f'storage must be mcap or sqlite3, got {storage!r}')
    try:
        pairs = list(_targets(recordings, find_recordings(recordings), out))
        # Where several frames are worked on at the same time, threads on each would only stand in line.
        job = Job(parameters if workers == 1 and not scheduler else dataclasses.replace(parameters, threads=1),
                  _mask(mask_file, options), outputs=('segments',) if only_segments else tuple(OUTPUTS),
                  truth=truth, csv=csv, jpeg_quality=options.jpeg_quality)
        run = Run(job, tuple(topic or ()), start, end, every, storage, copy=copy, overwrite=overwrite, resume=resume)
        if report:
            check_report(report, pairs, overwrite=overwrite)
        crew = cluster(scheduler) if scheduler else local(workers)
    except (RecordingError, TargetError, WorkersError, ValueError) as error:
        if as_json:
            print(json.dumps({'recordings': [], 'error': str(error)}))
        fail(str(error))
    outcomes = _process_all(pairs, run, crew, quiet=quiet or as_json, salvage=salvage)
    status = _status(outcomes)
    if report and not _reported(report, outcomes, run, profile):
        status = max(status, 1)
    if as_json:
        print(json.dumps({'recordings': [_summary(outcome) for outcome in outcomes]}))
    elif not quiet:
        _show(outcomes)
    raise typer.Exit(status)


def _mask(mask_file: Path | None, options: Options) -> NDArray[np.uint8] | None:
    """The mask that was given; as in the node, a path in a file of options is relative to the folder that one is in."""
    path = mask_file or (Path(options.mask_file) if options.mask_file else None)
    return read_mask(path) if path else None


def _targets(recordings: list[Path], sources: list[Path], out: Path) -> Iterator[tuple[Path, Path]]:
    """Each recording with its bag: one that was named itself, and no other, has `out`; all others are in that folder.

    Names that come twice are numbered.
    """
    if sources == recordings and len(sources) == 1:
        yield sources[0], out
        return
    names = unique_names(source.name if source.is_dir() else source.stem for source in sources)
    for source, name in zip(sources, names, strict=True):
        yield source, out / name


def _process_all(
    pairs: list[tuple[Path, Path]], run: Run, crew: Workers, *, quiet: bool, salvage: bool,
) -> list[Outcome]:
    """Process one recording after the other; a signal ends it with a line on standard error."""
    outcomes: list[Outcome] = []
    try:
        with _interruptible():
            for source, target in pairs:
                outcomes.append(_process(source, target, run, crew, quiet=quiet, salvage=salvage))
    except _Interrupted as error:
        errors.print(f'{error.number.name}: ended before all was done; --resume goes on from there', markup=False)
        raise typer.Exit(STATUS[error.number]) from None
    return outcomes


def _reported(report: Path, outcomes: list[Outcome], run: Run, profile: str) -> bool:
    """Write the page; where it cannot be, that is a line on standard error."""
    try:
        write_report(report, outcomes, run, profile, overwrite=run.overwrite)
    except TargetError as error:
        errors.print(str(error), markup=False)
        return False
    return True


def _process(source: Path, target: Path, run: Run, crew: Workers, *, quiet: bool, salvage: bool) -> Outcome:
    """Process a recording with a progress bar; what goes wrong with all of it is a line on standard error."""
    try:
        outcome = _read(source, target, run, crew, quiet=quiet, salvage=salvage)
    except (RecordingError, TargetError, WorkersError) as error:
        # Workers call the recording by its whole path.
        reason = str(error).removeprefix(f'{source}: ').removeprefix(f'{source.absolute()}: ')
        outcome = Outcome(source, target, error=reason)
    if outcome.error:
        errors.print(f'{source}: {outcome.error}', markup=False)
    if outcome.salvaged:
        errors.print(f'{source}: {outcome.salvaged}', markup=False)
    for reason, count in outcome.failed.most_common():
        errors.print(f'{source}: {count} frames failed: {reason}', markup=False)
    if run.job.truth and len(outcome.frames.good) and not outcome.frames.table['compared'].any():
        places = ', '.join(f'{topic}/{TRUTH}' for topic in sorted({frame.topic for frame in outcome.frames}))
        errors.print(f'{source}: no frame had a truth on {places}', markup=False)
    if outcome.uncopied:
        errors.print(f'{source}: not copied, for want of their types: {", ".join(outcome.uncopied)}', markup=False)
    for reason, count in outcome.spoilt.most_common():
        errors.print(f'{source}: {count} messages not copied: {reason}', markup=False)
    return outcome


def _read(source: Path, target: Path, run: Run, crew: Workers, *, quiet: bool, salvage: bool) -> Outcome:
    """Process a recording as it is or, if that cannot be and is asked for, what can be salvaged of it."""
    def say(sentence: str) -> None:
        errors.print(f'{source}: {sentence}', markup=False)

    try:
        from line_feature_node.salvage import may_help, salvaged, was_salvaged
    except ImportError:
        if salvage:
            fail('--salvage needs the Python packages lz4, mcap and zstandard: pip install lz4 mcap zstandard')
        with _progress(source.name, quiet=quiet) as watch:
            return process_recording(source, target, run, crew, watch, say=say)
    place = partial_folder(target)
    if not (salvage and run.resume and was_salvaged(place)):
        try:
            with _progress(source.name, quiet=quiet) as watch:
                return process_recording(source, target, run, crew, watch, say=say)
        except DamagedError as error:
            if not may_help(source):
                raise
            if not salvage:
                raise RecordingError(f'{error}: --salvage processes what can still be read') from error
    with salvaged(source, place) as found, _progress(source.name, quiet=quiet) as watch:
        try:
            outcome = process_recording(source, target, run, crew, watch, found.path, say)
        except RecordingError as error:
            raise RecordingError(str(error).replace(str(found.path), str(source))) from error
    outcome.salvaged = found
    return outcome


@contextmanager
def _progress(name: str, *, quiet: bool) -> Iterator[Any]:
    """A bar with frames a second, time left and segments, on a terminal."""
    columns = (TextColumn('{task.description}'), BarColumn(), TaskProgressColumn(), TimeRemainingColumn(),
               TextColumn('{task.fields[frames]} frames, {task.fields[rate]}/s, {task.fields[segments]} segments'))
    with Progress(*columns, console=console, transient=True, disable=quiet or not console.is_terminal) as progress:
        task = progress.add_task(name, total=None, frames=0, rate=0, segments=0)
        frames, segments = 0, 0

        def watch(done: int, slices: int, frame: Frame | None) -> None:
            nonlocal frames, segments
            if frame is not None:
                frames, segments = frames + 1, segments + frame.segments
                return
            elapsed = progress.tasks[0].elapsed or 1.0
            progress.update(task, completed=done, total=slices, frames=frames, segments=segments,
                            rate=round(frames / elapsed))

        yield watch


@contextmanager
def _interruptible() -> Iterator[None]:
    """Signals end what is under way as an exception does, so that it is cleared up; from then on they are ignored."""
    interrupted = False

    def interrupt(number: int, _: Any) -> None:
        nonlocal interrupted
        interrupted = True
        for each in STATUS:
            signal.signal(each, signal.SIG_IGN)
        raise _Interrupted(number)

    before = {number: signal.signal(number, interrupt) for number in STATUS}
    try:
        yield
    finally:
        for number, handler in before.items():
            if not interrupted:
                signal.signal(number, handler)


def _status(outcomes: list[Outcome]) -> int:
    """Nothing could be read: 2; something failed: 1; a recording without images is none that failed."""
    unread = [outcome for outcome in outcomes if outcome.error and not _empty(outcome)]
    if len(unread) == len(outcomes):
        return 2
    failed = sum(outcome.failed.total() for outcome in outcomes)
    if failed and failed == sum(len(outcome.frames) for outcome in outcomes):
        return 2
    partly = any(outcome.uncopied or outcome.spoilt or outcome.salvaged for outcome in outcomes)
    return 1 if unread or failed or partly else 0


def _empty(outcome: Outcome) -> bool:
    return outcome.error == NO_IMAGES


def _summary(outcome: Outcome) -> dict[str, Any]:
    """What became of a recording, in plain types."""
    summary: dict[str, Any] = {
        'source': str(outcome.source), 'target': str(outcome.target), 'error': outcome.error,
        'frames': len(outcome.frames), 'failed': dict(outcome.failed), 'segments': outcome.segments,
    }
    if outcome.salvaged:
        summary['salvaged'] = {'messages': outcome.salvaged.messages, 'until': outcome.salvaged.until,
                               'damage': list(outcome.salvaged.damage)}
    if outcome.uncopied or outcome.spoilt:
        summary['uncopied'] = {'topics': outcome.uncopied, 'messages': dict(outcome.spoilt)}
    compared = outcome.frames.table[outcome.frames.table['compared']]
    if len(compared):
        precision, recall, angle, offset = map(_median, compared['agreement'].T)
        summary['truth'] = {
            'frames': len(compared), 'precision': precision, 'recall': recall,
            'angle_degrees': None if angle is None else math.degrees(angle), 'offset_pixels': offset}
    return summary


def _median(values: NDArray[np.floating]) -> float | None:
    """Of those that are numbers; None where none is."""
    known = values[~np.isnan(values)]
    return float(np.median(known)) if len(known) else None


def _show(outcomes: list[Outcome]) -> None:
    """Print what became of recordings that had images."""
    for outcome in outcomes:
        if outcome.frames:
            console.print(f'{outcome.source}: written to {outcome.target}', markup=False)
            console.print(_table(outcome))


def _table(outcome: Outcome) -> Table:
    """What became of a recording, for people."""
    table = Table(show_header=False)
    table.add_column()
    table.add_column(justify='right')
    good = outcome.frames.good
    table.add_row('frames', str(len(outcome.frames)))
    table.add_row('of them failed', str(len(outcome.frames) - len(good)))
    table.add_row('segments', str(outcome.segments))
    if outcome.salvaged:
        table.add_row('messages salvaged', str(outcome.salvaged.messages))
    if len(good):
        table.add_row('extraction of a frame (median)', f'{np.median(good["seconds"]) * 1e3:.2f} ms')
    agreement = _summary(outcome).get('truth')
    if agreement:
        table.add_row('precision (median)', _shown(agreement['precision']))
        table.add_row('recall (median)', _shown(agreement['recall']))
        table.add_row('off by (median)', f'{_shown(agreement["angle_degrees"])} degrees, '
                                         f'{_shown(agreement["offset_pixels"])} pixels')
    return table


def _shown(value: float | None) -> str:
    return '-' if value is None else f'{value:.2f}'
