"""The named sets of parameters: what each changes of the defaults, and why."""

from dataclasses import dataclass, field
from typing import Any


@dataclass(frozen=True)
class Profile:
    """A named set of parameters.

    Attributes:
        description: One sentence: for which pictures it is.
        settings: Value of each parameter that differs from its default, with the reason, one sentence.
    """

    description: str
    settings: dict[str, tuple[Any, str]] = field(default_factory=dict)

    @property
    def values(self) -> dict[str, Any]:
        """The values without their reasons."""
        return {name: value for name, (value, _) in self.settings.items()}


#: The named sets.
PROFILES = {
    'default': Profile('For any camera: every parameter has its default.'),
    'paper': Profile('The six steps of the paper and nothing more.'),
    'corridor': Profile('For a mobile robot indoors: doors, skirting boards, lamps and notice boards.', {
        'T1': (5.0, 'Painted walls differ little from each other: a step of 22 grey levels is enough to start a line.'),
        'T2': (2.0, 'Far down the corridor the edges fade, and lines are followed there to 9 grey levels.'),
        'n': (2, 'A wider window swallows the short sides of frames and signs, and their corners with them.'),
        'min_length': (10.0, 'Shorter ones are mostly texture and noise, which low thresholds let through.'),
    }),
    'lane_tracking': Profile('For a car that keeps to its lane: painted marks and kerbs, both borders of each.', {
        'roi': ((0.0, 0.4, 1.0, 0.6), (
            'Lanes are below the horizon: if yours is not at 0.4 of the height, set the second number to where it is '
            'and the fourth to the rest.')),
        'T1': (5.0, 'A step of 22 grey levels is enough: worn paint on pale concrete or a dim road has hardly more.'),
        'T2': (2.0, 'Marks fade with the distance and are followed to 9 grey levels.'),
        'theta_min': (0.15, (
            'Within 9 degrees of the horizontal there are stop lines, shadows and cars, and lanes only in a bend far '
            'ahead.')),
        'theta_max': (-0.15, 'The other end of the band: below theta_min, it goes through the vertical.'),
        'min_length': (20.0, 'Lane marks are long; gravel, leaves and most letters on the road are not.'),
    }),
    'car_following': Profile('For a car that follows another: its roof, windows, bumper and the shadow under it.', {
        'roi': ((0.0, 0.35, 1.0, 0.55), (
            'Cars ahead stand around the horizon: the sky with its trees and the own bonnet are left out.')),
        'min_length': (15.0, 'Leaves, cobbles and reflections give shorter lines than a bumper or a roof does.'),
    }),
    'welding_panel': Profile('For a camera over plates to be welded: their edges and the gap between them.', {
        'alpha': (0.5, 'Close up, edges of plates are soft, and a wide operator averages the noise of a dark picture.'),
        'T1': (2.0, 'At this alpha it stands for a step of 16 grey levels, which a gap in the dark still has.'),
        'T2': (1.0, 'The gap is followed to where the light hardly reaches, a step of 8 grey levels.'),
        'min_length': (30.0, 'Scratches, torn edges and sparks give shorter lines than a gap or a plate does.'),
    }),
}
