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
    'paper': Profile('The six steps of the paper and nothing more.', {
        'alpha': (1.0, 'One width for all pictures; the paper has none that depends on the noise.'),
        'T1': (8.0, 'A step of 35 grey levels starts an edge.'),
        'T2': (3.0, 'An edge is followed down to a step of 13 grey levels.'),
        'noise_T1': (0.0, 'The thresholds are the same for all pictures.'),
        'noise_T2': (0.0, 'The lower threshold does not depend on the noise either.'),
        'clutter': (1.0, 'Nor does either on texture.'),
        'grouping': ('codes', 'Line-blobs are connected pixels of one code.'),
        'refine': (False, 'Lines are fitted to their blobs, and linked.'),
    }),
    'corridor': Profile('For a mobile robot indoors: doors, skirting boards, lamps and notice boards.', {
        'T1': (5.0, 'A sharp step of 13 grey levels starts a line: weaker ones are mostly plaster and floor.'),
        'min_length': (12.0, 'Shorter ones are letters, door handles and texture.'),
    }),
    'lane_tracking': Profile('For a car that keeps to its lane: painted marks and kerbs, both borders of each.', {
        'roi': ((0.0, 0.4, 1.0, 0.6), (
            'Lanes are below the horizon: if yours is not at 0.4 of the height, set the second number to where it is '
            'and the fourth to the rest.')),
        'T1': (5.0, 'A sharp step of 13 grey levels starts a line, which worn paint on pale concrete still is.'),
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
