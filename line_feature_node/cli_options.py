"""What the commands of `line_features` share: options for all parameters, and how they speak."""

import inspect
import types
from collections.abc import Callable
from pathlib import Path
from typing import Any, NoReturn, Optional

import typer
from rich.console import Console

from line_feature_node.core import PROFILES, Parameters
from line_feature_node.core.parameters import Spec
from line_feature_node.options import Options
from line_feature_node.parameter_files import read_parameter_file

#: What is made of options and file, by the name that a command has it under.
MADE = ('parameters', 'profile', 'options')

console, errors = Console(highlight=False, soft_wrap=True), Console(stderr=True, highlight=False, soft_wrap=True)


def fail(message: str) -> NoReturn:
    """End with one sentence and status 2."""
    errors.print(message, markup=False)
    raise typer.Exit(2)


def path_of(text: str) -> Path:
    """The path that an argument names; an empty one, as of a variable that is not set, would be the current folder."""
    if not text:
        raise typer.BadParameter("a path is expected, got '' (. is the current folder)")
    return Path(text)


def with_parameters(command: Callable[..., None]) -> Callable[..., None]:
    """Give a command, which takes `parameters`, options for a file, for `profile` and for each of Parameters instead.

    What is given as an option wins over what the file says, and that over the profile. A command may take more of MADE:
    the name of the profile they started from, and the options of the node, as the file sets them.
    """

    def run(params_file: Path | None, profile: str | None, **values: Any) -> None:
        own = {name: values.pop(name) for name in kept}
        given = {name: value for name, value in values.items() if value is not None}
        try:
            made = dict(zip(MADE, _parameters(params_file, profile, given), strict=True))
        except (TypeError, ValueError) as error:
            raise typer.BadParameter(str(error)) from None
        command(**own, **{name: value for name, value in made.items() if name in signature.parameters})

    signature = inspect.signature(command)
    kept = [name for name in signature.parameters if name not in MADE]
    options: dict[str, tuple[Any, str]] = {
        'params-file': (Path, 'Parameter file (YAML) of a ROS 2 node, whose values are taken.'),
        'profile': (str, f'Set of parameters to start from: {", ".join(PROFILES)}; default default.')}
    for name, spec in Parameters.specs().items():
        default = getattr(Parameters(), name)
        kind = types.GenericAlias(tuple, (float,) * len(default)) if isinstance(default, tuple) else type(default)
        options[name] = (kind, f'{spec.description} {_range(name, spec, default)}.')
    added = [
        inspect.Parameter(name.replace('-', '_'), inspect.Parameter.KEYWORD_ONLY, annotation=Optional[kind], default=(
            typer.Option(None, f'--{name}/--no-{name}' if kind is bool else f'--{name}', help=text)))
        for name, (kind, text) in options.items()]
    described = [*(signature.parameters[name] for name in kept), *added]
    run.__name__, run.__doc__ = command.__name__, command.__doc__
    # What Typer reads of a function, instead of what the function has.
    vars(run)['__signature__'] = signature.replace(parameters=described)
    run.__annotations__ = {parameter.name: parameter.annotation for parameter in described}
    return run


def _range(name: str, spec: Spec, default: Any) -> str:
    """The values that an option takes, and its default, as the help has them."""
    if isinstance(default, bool):
        return f'Default --{"" if default else "no-"}{name}'
    unit = f' ({spec.unit})' if spec.unit else ''
    if isinstance(default, tuple):
        given = ' '.join(f'{number:g}' for number in default)
        return f'{spec.range}{unit}, with spaces between; default --{name} {given}'
    return f'{spec.range}{unit}; default {default}'


def _parameters(path: Path | None, profile: str | None, given: dict[str, Any]) -> tuple[Parameters, str, Options]:
    """What is made of options and file, in the order of MADE."""
    values, unknown = read_parameter_file(path) if path else ({}, [])
    for name in unknown:
        errors.print(f'{path}: there is no parameter {name!r}, what it is set to has no effect', markup=False)
    own = {name: value for name, value in values.items() if name in Parameters.specs()}
    options = Options.of({name: value for name, value in values.items() if name in Options.specs()})
    name = profile or options.profile
    return Parameters.profile(name, **{**own, **given}), name, options
