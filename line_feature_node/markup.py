"""HTML and SVG from Python: whatever is not made here is text, and is escaped."""

import html

#: Elements that have no end tag.
VOID = ('br', 'img', 'meta')


class Markup(str):
    """Text that is HTML already."""

    __slots__ = ()


def tag(name: str, /, *inside: str, **attributes: str | float) -> Markup:
    """An element.

    Args:
        name: Of the element.
        inside: What is in it: markup as it is, other text escaped.
        **attributes: Values are escaped; in names `_` stands for `-`, and one at the end is left out: `class_`.
    """
    values = ''.join(f' {key.removesuffix("_").replace("_", "-")}="{html.escape(_text(value))}"'
                     for key, value in attributes.items())
    return Markup(f'<{name}{values}>' if name in VOID else f'<{name}{values}>{joined(*inside)}</{name}>')


def joined(*parts: str) -> Markup:
    """One after another: markup as it is, other text escaped."""
    return Markup(''.join(part if isinstance(part, Markup) else html.escape(part) for part in parts))


def _text(value: str | float) -> str:
    return value if isinstance(value, str) else f'{value:.6g}'
