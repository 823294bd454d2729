"""The one table of parameters: name, default, range, unit and description of each."""

import dataclasses
import math
import numbers
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Spec:
    """What is known of one parameter besides its default.

    Attributes:
        low: Smallest value allowed, of a number.
        high: Largest value allowed, of a number.
        unit: Unit of measure, '' for a pure number or a choice.
        description: One sentence for people.
        choices: The values allowed, of a choice.
        unset: Whether NaN is allowed, and means "not given".
    """

    description: str
    low: float = -math.inf
    high: float = math.inf
    unit: str = ''
    choices: tuple[str, ...] = ()
    unset: bool = False

    @property
    def range(self) -> str:
        """The allowed values, in words: '0.1 to 5' or 'deriche, sobel'."""
        if self.choices:
            return ', '.join(self.choices)
        return f'{self.low:g} to {self.high:g}' + (', or nan for unset' if self.unset else '')


def _parameter(default: Any, description: str, **spec: Any) -> Any:
    return dataclasses.field(default=default, metadata={'spec': Spec(description, **spec)})


@dataclass(frozen=True, kw_only=True, eq=False)
class Parameters:
    """Every parameter of the pipeline, checked when made and never changed after.

    The names alpha, T1, T2, n, tau1 and tau2 are the paper's. :meth:`specs` gives range, unit and description of each.

    Raises:
        TypeError: A name is unknown or a value has the wrong type.
        ValueError: A value is outside its range, or the values contradict each other.
    """

    operator: str = _parameter(
        'deriche', 'Edge operator; dog is the derivative of a Gaussian.',
        choices=('deriche', 'sobel', 'prewitt', 'scharr', 'dog'))
    alpha: float = _parameter(
        1.0, "Width of Deriche's operator: smaller smooths more.", low=0.2, high=5.0, unit='1/pixel')
    sigma: float = _parameter(
        1.0, 'Standard deviation of the Gaussian, for the operator dog: larger smooths more.',
        low=0.3, high=10.0, unit='pixels')
    T1: float = _parameter(
        8.0, 'Upper threshold of the hysteresis: a stronger gradient is an edge.',
        low=0.0, high=1000.0, unit='grey levels/pixel')
    T2: float = _parameter(
        3.0, 'Lower threshold of the hysteresis, less than T1: a stronger gradient is an edge where connected to one.',
        low=0.0, high=1000.0, unit='grey levels/pixel')
    intensity_min: float = _parameter(
        math.nan, 'Pixel value that counts as grey level 0; unset: 0.', low=-1e9, high=1e9, unset=True)
    intensity_max: float = _parameter(
        math.nan, 'Pixel value that counts as grey level 255; unset: the largest of the integer type, 255 for floats.',
        low=-1e9, high=1e9, unset=True)
    thinning: str = _parameter(
        'suppression', 'How edges are thinned: by suppressing what is no maximum of the gradient, by morphology after '
        'the hysteresis, or not at all (then there are no chains).', choices=('suppression', 'morphological', 'none'))
    max_gap: int = _parameter(2, 'Longest gap in a broken edge that is bridged.', low=0, high=8, unit='pixels')
    min_chain: int = _parameter(8, 'Shorter edge chains are dropped.', low=1, high=100000, unit='pixels')
    n: int = _parameter(
        4, 'Window of the edge normalisation, before and after; 0 turns it off.', low=0, high=10000, unit='pixels')
    min_size: int = _parameter(5, 'Smaller line-blobs give no segment.', low=2, high=100000, unit='pixels')
    orientation: str = _parameter(
        'principal_axis', 'How the orientation of a line-blob is computed.',
        choices=('principal_axis', 'least_squares'))
    tau1: float = _parameter(
        1.0, 'Linked segments have their mid-points nearer than this to the line of the other.',
        low=0.0, high=20.0, unit='pixels')
    tau2: float = _parameter(
        6.0, 'Linked segments have two end points nearer than this to each other.',
        low=0.0, high=100.0, unit='pixels')
    min_length: float = _parameter(
        0.0, 'Shorter segments are dropped after linking.', low=0.0, high=100000.0, unit='pixels')

    def __post_init__(self) -> None:
        for field in dataclasses.fields(self):
            object.__setattr__(self, field.name, _checked(field, getattr(self, field.name)))
        if self.T2 >= self.T1:
            raise ValueError(f'T2 must be less than T1, got T2 = {self.T2:g} and T1 = {self.T1:g}')
        if self.intensity_min >= self.intensity_max:
            raise ValueError('intensity_min must be less than intensity_max, got '
                             f'{self.intensity_min:g} and {self.intensity_max:g}')

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Parameters) and self._key() == other._key()

    def __hash__(self) -> int:
        return hash(self._key())

    def _key(self) -> tuple[Any, ...]:
        """All values; None for unset ones, since NaN is not equal to itself."""
        return tuple(None if value != value else value for value in vars(self).values())

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
            raise ValueError(f'profile must be one of {", ".join(PROFILES)}, got {name!r}')
        return cls.of({**PROFILES[name], **parameters})

    @classmethod
    def of(cls, values: Mapping[str, Any]) -> 'Parameters':
        """Parameters from a mapping; an unknown name is a TypeError that says which names there are."""
        names = [field.name for field in dataclasses.fields(cls)]
        for name in values:
            if name not in names:
                raise TypeError(f'unknown parameter {name!r}: the parameters are {", ".join(names)}')
        return cls(**values)

    @classmethod
    def specs(cls) -> dict[str, Spec]:
        """Name of every parameter, in order, with its range, unit and description."""
        return {field.name: field.metadata['spec'] for field in dataclasses.fields(cls)}


#: The named sets: what each changes of the defaults.
PROFILES: dict[str, dict[str, Any]] = {
    'default': {},
    'paper': {},
}


def _checked(field: 'dataclasses.Field[Any]', value: Any) -> Any:
    """The value as the type of its field, or the error that says what is wrong with it."""
    spec: Spec = field.metadata['spec']
    expected = f'{field.name} must be'
    if spec.choices:
        if not isinstance(value, str):
            raise TypeError(f'{expected} one of {spec.range}, got {value!r}')
        if value not in spec.choices:
            raise ValueError(f'{expected} one of {spec.range}, got {value!r}')
        return value
    whole = isinstance(field.default, int)
    if not isinstance(value, numbers.Integral if whole else numbers.Real) or isinstance(value, bool):
        raise TypeError(f'{expected} {"a whole number" if whole else "a number"} of {spec.range}'
                        f'{spec.unit and " " + spec.unit}, got {value!r}')
    number: Any = value
    if not (spec.low <= number <= spec.high or (spec.unset and math.isnan(number))):
        raise ValueError(f'{expected} {spec.range}{spec.unit and " " + spec.unit}, got {value!r}')
    return int(number) if whole else float(number)
