"""The doors that inputs of the outside world come in by: how an input is made, and what must come of it."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from random import Random
from tempfile import TemporaryDirectory
from typing import Any

import pictures
import recorded
import settings

from line_feature_node import cli_bag, cli_options
from line_feature_node.core import LineFeatureExtractor

Input = dict[str, Any]


@dataclass(frozen=True)
class Door:
    """One door.

    Attributes:
        make: An input, by chance.
        check: Has the package take it, with a folder for files that is empty but for what it left there itself; returns
            the bytes of the image that there was, 0 where there was none, and -1 where it was refused.
        share: How many inputs of a whole campaign are for this door.
        multiple: Memory that may be taken for each byte of the image.
        prepare: Called once before, as compiling takes time and memory.
    """

    make: Callable[[Random], Input]
    check: Callable[[Input, Path], int]
    share: int
    multiple: float = 0.0
    prepare: Callable[[], None] = lambda: None


def without_folder(check: Callable[[Input], int]) -> Callable[[Input, Path], int]:
    """For doors that have to do with no files."""
    return lambda fields, _: check(fields)


def load_kernels() -> None:
    """Compile what all profiles need, or load it."""
    for profile in pictures.PROFILES:
        LineFeatureExtractor(pictures.Parameters.profile(profile)).warm_up()
    draw = Random('kernels')
    for _ in range(500):
        fields = pictures.extractor_input(draw)
        try:
            pictures.check_extractor(fields)
        except (TypeError, ValueError):
            continue


def load_recordings() -> None:
    """Have one that is good processed, in the folder of nobody."""
    mute()
    fields = recorded.recording(Random('recording'))
    with TemporaryDirectory() as folder:
        recorded.check_recording({**fields, 'files': recorded.seeds()['mcap-storage'], 'alone': False}, Path(folder))


def mute() -> None:
    """What commands say of bad inputs would be millions of lines."""
    for console in (cli_options.errors, cli_options.console, cli_bag.errors, cli_bag.console):
        console.quiet = True


DOORS = {
    'image': Door(pictures.image_message, without_folder(pictures.check_image), 500_000, multiple=4),
    'compressed': Door(pictures.compressed_message, without_folder(pictures.check_compressed), 100_000, multiple=8),
    'segments': Door(pictures.segments_message, without_folder(pictures.check_segments), 340_000, multiple=4),
    'extractor': Door(pictures.extractor_input, without_folder(pictures.check_extractor), 100_000, multiple=200,
                      prepare=load_kernels),
    'parameters': Door(settings.parameter_file, settings.check_parameter_file, 6_000, prepare=mute),
    'arguments': Door(settings.arguments, settings.check_arguments, 1_000, prepare=mute),
    'remains': Door(recorded.damaged_file, recorded.check_remains, 20_000),
    'recording': Door(recorded.recording, recorded.check_recording, 3_000, prepare=load_recordings),
}
