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
}
