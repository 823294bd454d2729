"""YAML of the outside world: what it says, or one sentence on why it is none."""

from typing import Any

import yaml

#: Levels that a text without aliases may have, as each takes longer than the one before.
DEEPEST = 100


def parsed(text: str, *, aliases: bool = True) -> Any:
    """What a text in YAML says, in plain types.

    Args:
        text: One document.
        aliases: Whether what is said once may stand in several places. With few of them a short text says gigabytes to
            whoever goes through it, and parameter files of ROS 2 have none.

    Raises:
        ValueError: It is none; the message is a sentence.
    """
    try:
        alias = None if aliases else _first_alias(text)
        content = None if alias else yaml.safe_load(text)
    except RecursionError as error:
        raise ValueError('nested too deep') from error
    except Exception as error:
        # Besides its own errors those of whatever values make it call: dates, and numbers with tags that lie.
        words = ' '.join(str(error).split()) or 'a value that is not what its tag says'
        raise ValueError(f'not YAML ({words})') from error
    if alias:
        raise ValueError(f'*{alias} is an alias, and there are to be none')
    return content


def _first_alias(text: str) -> str | None:
    """The name of the first alias; RecursionError where it there are too many levels."""
    depth = 0
    for event in yaml.parse(text, yaml.SafeLoader):
        if isinstance(event, yaml.AliasEvent):
            return event.anchor
        depth += isinstance(event, yaml.CollectionStartEvent) - isinstance(event, yaml.CollectionEndEvent)
        if depth > DEEPEST:
            raise RecursionError
    return None
