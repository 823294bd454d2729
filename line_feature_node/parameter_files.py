"""Parameter files of ROS 2 nodes, read where there is no ROS 2."""

from pathlib import Path
from typing import Any

from line_feature_node.core import Parameters
from line_feature_node.core.parameters import shown
from line_feature_node.options import QOS_OVERRIDES, Options
from line_feature_node.yaml_text import parsed


def read_parameter_file(path: Path) -> tuple[dict[str, Any], list[str]]:
    """The parameters that a file sets for nodes of any name, whole numbers as doubles where these are wanted.

    Args:
        path: A file as `--params-file` of a node takes it.

    Returns:
        Values by name, for Parameters and Options; and the names that are in neither, but for those of quality of
        service, which a recording has none of.

    Raises:
        ValueError: It cannot be read, or is no such file; the message is a sentence.
    """
    try:
        content = parsed(path.read_text(encoding='utf-8'), aliases=False)
    except OSError as error:
        raise ValueError(f'{path}: {error.strerror}') from None
    except UnicodeDecodeError as error:
        raise ValueError(f'{path}: not YAML ({error})') from None
    except ValueError as error:
        raise ValueError(f'{path}: {error}') from None
    sections = [section['ros__parameters'] for section in _sections(content)]
    if not sections:
        raise ValueError(f'{path}: no ros__parameters in it, as parameter files of ROS 2 have them')
    values: dict[str, Any] = {}
    for section in sections:
        if not isinstance(section, dict):
            raise ValueError(f'{path}: ros__parameters must be names with values, got {shown(section)}')
        values.update(_flattened(section))
    known = {*Parameters.specs(), *Options.specs()}
    return ({name: value for name, value in values.items() if name in known},
            [str(name) for name in values if name not in known and not str(name).startswith(QOS_OVERRIDES)])


def _flattened(section: dict[str, Any], before: str = '') -> dict[str, Any]:
    """Values by their full names: a mapping in it stands for names that begin with its own and a point."""
    values: dict[str, Any] = {}
    for name, value in section.items():
        if isinstance(value, dict):
            values |= _flattened(value, f'{before}{name}.')
        else:
            values[f'{before}{name}'] = value
    return values


def _sections(content: Any) -> list[dict[str, Any]]:
    """All mappings with ros__parameters, however deep in names of nodes and namespaces."""
    if not isinstance(content, dict):
        return []
    if 'ros__parameters' in content:
        return [content]
    return [section for value in content.values() for section in _sections(value)]
