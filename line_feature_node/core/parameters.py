"""The one table of parameters: name, default, range, unit and description of each."""

import array
import dataclasses
import math
import numbers
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, TypeVar

import numpy as np

from line_feature_node.core.profiles import PROFILES

Self = TypeVar('Self', bound='ParameterSet')  # typing has it from Python 3.11 only

#: Just beyond a right angle, so that what is rounded to four digits is in range.
RIGHT_ANGLE = 1.5708
#: Characters of a wrong value that a message has.
LONGEST = 200


@dataclass(frozen=True)
class Spec:
    """What is known of one parameter besides its default.

    Attributes:
        description: One sentence for people.
        low: Smallest value allowed, of a number.
        high: Largest value allowed, of a number.
        unit: Unit of measure, '' for a pure number or a choice.
        choices: The values allowed, of a choice.
        unset: Whether NaN is allowed, and means "not given".
        constant: Whether a running node keeps the value that it was started with.
    """

    description: str
    low: float = -math.inf
    high: float = math.inf
    unit: str = ''
    choices: tuple[str, ...] = ()
    unset: bool = False
    constant: bool = False

    @property
    def range(self) -> str:
        """The allowed values, in words: '0.1 to 5' or 'deriche, sobel'; '' where every one is."""
        if self.choices:
            return ', '.join(self.choices)
        if self.low == -math.inf:
            return ''
        return f'{self.low:g} to {self.high:g}' + (', or nan for unset' if self.unset else '')


def parameter(default: Any, description: str, **spec: Any) -> Any:
    """A field of a :class:`ParameterSet`, its type that of the default; `spec` is the rest of its :class:`Spec`."""
    return dataclasses.field(default=default, metadata={'spec': Spec(description, **spec)})


class ParameterSet:
    """What tables of parameters have in common: values are checked when made, compared and listed.

    Subclasses are frozen dataclasses whose fields are made by :func:`parameter`.
    """

    def __post_init__(self) -> None:
        for field in _fields(self):
            object.__setattr__(self, field.name, _checked(field, getattr(self, field.name)))

    def __eq__(self, other: object) -> bool:
        return self is other or (isinstance(other, type(self)) and self._key == other._key)

    def __hash__(self) -> int:
        return self._hash

    def __getstate__(self) -> dict[str, Any]:
        """The values alone: hashes differ between processes."""
        return {field.name: getattr(self, field.name) for field in _fields(self)}

    @cached_property
    def _hash(self) -> int:
        """Taken once, as every frame looks up several times what was made for its parameters."""
        return hash(self._key)

    @cached_property
    def _key(self) -> tuple[Any, ...]:
        """All values; None for unset ones, since NaN is not equal to itself."""
        values = (getattr(self, field.name) for field in _fields(self))
        return tuple(None if value != value else value for value in values)

    @classmethod
    def of(cls: type[Self], values: Mapping[str, Any]) -> Self:
        """Parameters from a mapping; an unknown name is a TypeError that says which names there are."""
        names = list(cls.specs())
        for name in values:
            if name not in names:
                raise TypeError(f'unknown parameter {name!r}: the parameters are {", ".join(names)}')
        return cls(**values)

    @classmethod
    def specs(cls) -> dict[str, Spec]:
        """Name of every parameter, in order, with its range, unit and description."""
        return {field.name: field.metadata['spec'] for field in _fields(cls)}


def _fields(table: Any) -> 'tuple[dataclasses.Field[Any], ...]':
    return dataclasses.fields(table)


@dataclass(frozen=True, kw_only=True, eq=False)
class Parameters(ParameterSet):
    """Every parameter of the pipeline, checked when made and never changed after.

    The names alpha, T1, T2, n, tau1 and tau2 are the paper's. :meth:`specs` gives range, unit and description of each.

    Raises:
        TypeError: A name is unknown or a value has the wrong type.
        ValueError: A value is outside its range, or the values contradict each other.
    """

    operator: str = parameter(
        'deriche', 'Edge operator; dog is the derivative of a Gaussian.',
        choices=('deriche', 'sobel', 'prewitt', 'scharr', 'dog'))
    alpha: float = parameter(
        math.nan, "Width of Deriche's operator: smaller smooths more; unset: chosen from the noise of the picture.",
        low=0.2, high=5.0, unit='1/pixel', unset=True)
    sigma: float = parameter(
        1.0, 'Standard deviation of the Gaussian, for the operator dog: larger smooths more.',
        low=0.3, high=10.0, unit='pixels')
    T1: float = parameter(
        4.0, 'Upper threshold of the hysteresis: a stronger gradient is an edge.',
        low=0.0, high=1000.0, unit='grey levels/pixel')
    T2: float = parameter(
        2.0, 'Lower threshold of the hysteresis, less than T1: a stronger gradient is an edge where connected to one.',
        low=0.0, high=1000.0, unit='grey levels/pixel')
    noise_T1: float = parameter(
        4.0, "T1 is raised to so many standard deviations of the gradient's noise, which is measured in the picture.",
        low=0.0, high=100.0)
    noise_T2: float = parameter(
        2.0, "T2 is raised to so many standard deviations of the gradient's noise.", low=0.0, high=100.0)
    clutter: float = parameter(
        2.0, 'Where texture fills half of a picture, T1 and T2 are raised to what that has, by this factor at most; 1 '
        'turns it off.', low=1.0, high=100.0)
    intensity_min: float = parameter(
        math.nan, 'Pixel value that counts as grey level 0; unset: 0.', low=-1e9, high=1e9, unset=True)
    intensity_max: float = parameter(
        math.nan, 'Pixel value that counts as grey level 255; unset: the largest of the integer type, 255 for floats.',
        low=-1e9, high=1e9, unset=True)
    thinning: str = parameter(
        'suppression', 'How edges are thinned: by suppressing what is no maximum of the gradient, by morphology after '
        'the hysteresis, or not at all (then there are no chains).', choices=('suppression', 'morphological', 'none'))
    max_gap: int = parameter(2, 'Longest gap in a broken edge that is bridged.', low=0, high=8, unit='pixels')
    min_chain: int = parameter(8, 'Shorter edge chains are dropped.', low=1, high=100000, unit='pixels')
    n: int = parameter(
        4, 'Window of the edge normalisation, before and after; 0 turns it off.', low=0, high=10000, unit='pixels')
    grouping: str = parameter(
        'straightness', 'What makes a line-blob of edge pixels: one code after the edge normalisation, or a straight '
        'stretch of a chain.', choices=('codes', 'straightness'))
    min_size: int = parameter(5, 'Smaller line-blobs give no segment.', low=2, high=100000, unit='pixels')
    orientation: str = parameter(
        'principal_axis', 'How the orientation of a line-blob is computed.',
        choices=('principal_axis', 'least_squares'))
    tau1: float = parameter(
        1.0, 'Linked segments have their mid-points nearer than this to the line of the other.',
        low=0.0, high=20.0, unit='pixels')
    tau2: float = parameter(
        6.0, 'Linked segments have two end points nearer than this to each other.',
        low=0.0, high=100.0, unit='pixels')
    refine: bool = parameter(
        True, 'Lines are laid along the ridge of the gradient, grown as far as it goes, and dropped where they may be '
        'there by chance; there is no linking then.')
    min_snr: float = parameter(
        25.0, 'Refined segments are kept from this ratio of signal to noise: gradient by root of length, in standard '
        "deviations of the gradient's noise.", low=0.0, high=1000.0)
    false_alarms: float = parameter(
        0.1, 'Refined segments are dropped where so many as clear as they are expected by chance in a picture whose '
        'gradients have no order.', low=1e-30, high=1e30)
    max_sigma_theta: float = parameter(
        0.0175, 'Refined segments are dropped where the standard deviation of their orientation is more than this: by '
        'default a degree.',
        low=0.0, high=10.0, unit='radians')
    min_length: float = parameter(
        0.0, 'Shorter segments are dropped in the end.', low=0.0, high=100000.0, unit='pixels')
    max_segments: int = parameter(
        0, 'At most this many segments, the longest, are kept; 0 keeps all.', low=0, high=1000000)
    theta_min: float = parameter(
        -RIGHT_ANGLE, 'Segments are kept from this orientation, growing, to theta_max: with theta_min above theta_max, '
        'through the vertical.', low=-RIGHT_ANGLE, high=RIGHT_ANGLE, unit='radians')
    theta_max: float = parameter(
        RIGHT_ANGLE, 'Last orientation of the band that is kept.', low=-RIGHT_ANGLE, high=RIGHT_ANGLE, unit='radians')
    roi: tuple[float, float, float, float] = parameter(
        (0.0, 0.0, 1.0, 1.0), 'Region of interest: x, y, width and height, in shares of the picture where none of them '
        'exceeds 1, else in whole pixels.', low=0.0, high=1e6)
    scale: float = parameter(
        1.0, 'The picture is made smaller by this factor first; segments come in pixels of the full size, while '
        'parameters in pixels, but for min_length and roi, are in those of the smaller picture.', low=0.05, high=1.0)
    threads: int = parameter(
        1, 'So many threads work on one frame, from half a megapixel on; the segments are the same.', low=1, high=64)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.T2 >= self.T1:
            raise ValueError(f'T2 must be less than T1, got T2 = {self.T2:g} and T1 = {self.T1:g}')
        if self.intensity_min >= self.intensity_max:
            raise ValueError('intensity_min must be less than intensity_max, got '
                             f'{self.intensity_min:g} and {self.intensity_max:g}')
        if min(self.roi[2:]) <= 0:
            raise ValueError(f'roi must have a width and a height above 0, got {list(self.roi)}')
        if max(self.roi) > 1 and not all(value.is_integer() for value in self.roi):
            raise ValueError(f'roi must be shares of 0 to 1 or whole pixels, got {list(self.roi)}')

    @property
    def adaptive(self) -> bool:
        """Whether alpha or the thresholds depend on the noise."""
        return math.isnan(self.alpha) or self.noise_T1 > 0 or self.noise_T2 > 0 or self.clutter > 1

    @classmethod
    def paper(cls) -> 'Parameters':
        """The six steps of the paper and nothing more."""
        return cls.profile('paper')

    @classmethod
    def profile(cls, name: str, **parameters: Any) -> 'Parameters':
        """A named set of values, with those given in their place.

        Args:
            name: One of :data:`PROFILES`.
            **parameters: Values that replace those of the set.

        Raises:
            ValueError: There is no such set, or as the class raises.
            TypeError: As the class raises.
        """
        if not isinstance(name, str) or name not in PROFILES:
            raise ValueError(f'profile must be one of {", ".join(PROFILES)}, got {shown(name)}')
        return cls.of({**PROFILES[name].values, **parameters})


def shown(value: Any) -> str:
    """A value that is wrong, as a message names it; it may be of any size."""
    try:
        text = repr(value).replace('\n', ' ')
    except (RecursionError, ValueError):  # nor does Python write a number of thousands of digits
        return f'{type(value).__name__} beyond all measure'
    return text if len(text) <= LONGEST else f'{text[:LONGEST]}... ({len(text)} characters)'


def _checked(field: 'dataclasses.Field[Any]', value: Any) -> Any:
    """The value as the type of its field, or the error that says what is wrong with it."""
    spec: Spec = field.metadata['spec']
    if isinstance(field.default, tuple):
        return _checked_list(field.name, spec, value, len(field.default))
    if isinstance(field.default, str):
        return _checked_text(field.name, spec, value)
    if isinstance(field.default, bool):
        if not isinstance(value, bool | np.bool_):
            raise TypeError(f'{field.name} must be true or false, got {shown(value)}')
        return bool(value)
    return _checked_number(field.name, spec, value, whole=isinstance(field.default, int))


def _checked_text(name: str, spec: Spec, value: Any) -> str:
    expected = f'{name} must be {"one of " + spec.range if spec.choices else "a text"}, got {shown(value)}'
    if not isinstance(value, str):
        raise TypeError(expected)
    if spec.choices and value not in spec.choices:
        raise ValueError(expected)
    return value


def _checked_list(name: str, spec: Spec, value: Any, size: int) -> tuple[float, ...]:
    if isinstance(value, np.ndarray | array.array):
        value = value.tolist()
    if isinstance(value, str | bytes | bytearray | memoryview) or not isinstance(value, Sequence):
        raise TypeError(f'{name} must be a list of {size} numbers, got {shown(value)}')
    if len(value) != size:
        raise ValueError(f'{name} must be a list of {size} numbers, got {len(value)}: {shown(list(value))}')
    return tuple(_checked_number(f'each number of {name}', spec, number, whole=False) for number in value)


def _checked_number(name: str, spec: Spec, value: Any, *, whole: bool) -> float:
    unit = spec.unit and f' {spec.unit}'
    if not isinstance(value, numbers.Integral if whole else numbers.Real) or isinstance(value, bool):
        raise TypeError(f'{name} must be {"a whole number" if whole else "a number"} of {spec.range}{unit}, '
                        f'got {shown(value)}')
    # Numpy compares in the type of its number, in which the range may be infinite.
    number: Any = value.item() if isinstance(value, np.generic) else value
    if not (spec.low <= number <= spec.high or (spec.unset and number != number)):
        raise ValueError(f'{name} must be {spec.range}{unit}, got {shown(value)}')
    return int(number) if whole else float(number)
