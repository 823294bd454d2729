"""The tables of parameters as parameters of a ROS 2 node: declared, checked together, and swapped as one."""

import array
import dataclasses
import difflib
import math
from collections.abc import Callable, Iterable
from typing import Any

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor, SetParametersResult
from rclpy.node import Node
from rclpy.parameter import Parameter

from line_feature_node.core import Parameters
from line_feature_node.core.parameters import Spec
from line_feature_node.options import Options

#: Parameters that rclpy itself declares.
BUILT_IN = {'use_sim_time', 'start_type_description_service'}
#: The policies that may be overridden, with their values; depth is a number.
QOS_POLICIES: dict[str, tuple[str, ...]] = {
    'history': ('keep_last', 'keep_all', 'system_default'),
    'depth': (),
    'reliability': ('best_effort', 'reliable', 'system_default', 'best_available'),
    'durability': ('volatile', 'transient_local', 'system_default', 'best_available'),
}


class NodeParameters:
    """The parameters of a node, in two frozen objects that are replaced as one.

    The node must have been made with automatically_declare_parameters_from_overrides, so that overrides can be read:
    here they are checked, whole numbers are taken for doubles, and what no parameter claims is warned of.

    Attributes:
        parameters: Those of the extraction.
        options: The node's own.
    """

    def __init__(self, node: Node, qos_overrides: Iterable[str], changed: Callable[[], None]) -> None:
        """Declare everything.

        Args:
            node: Where.
            qos_overrides: Names of the parameters for quality of service that the node will declare.
            changed: Called after each change.

        Raises:
            TypeError, ValueError: An override has the wrong type or range, or contradicts another; the message has the
                name of the parameter.
        """
        self._changed = changed
        overrides = _taken_overrides(node)
        self.options = Options.of(_known(overrides, Options))
        self.parameters = Parameters.profile(self.options.profile, **_known(overrides, Parameters))
        names = {*_NAMES, *qos_overrides}
        for name in names & overrides.keys() - _NAMES.keys():
            _check_qos(name, overrides[name])
        _warn_of_unknown(node, overrides, names)
        for table in (self.options, self.parameters):
            for name, spec in table.specs().items():
                node.declare_parameter(name, _ros_value(getattr(table, name)), _descriptor(name, spec),
                                       ignore_override=True)
        # Registered last, as declaring calls them too. A callback that raises would end the spinning.
        node.add_pre_set_parameters_callback(self._complete)
        node.add_on_set_parameters_callback(self._check)
        node.add_post_set_parameters_callback(self._apply)

    def _complete(self, changes: list[Parameter]) -> list[Parameter]:
        """Numbers as the type they are wanted in, and with a profile all values that it sets."""
        completed = [_completed(change) for change in changes]
        given = {change.name for change in changes}
        for change in completed:
            if change.name == 'profile' and change.value in Options.specs()['profile'].choices:
                chosen = Parameters.profile(change.value)
                completed += [_parameter(name, getattr(chosen, name)) for name in chosen.specs() if name not in given]
        return completed

    def _candidate(self, changes: list[Parameter]) -> tuple[Parameters, Options]:
        values = {change.name: change.value for change in changes}
        return (dataclasses.replace(self.parameters, **_known(values, Parameters)),
                dataclasses.replace(self.options, **_known(values, Options)))

    def _check(self, changes: list[Parameter]) -> SetParametersResult:
        try:
            self._candidate(changes)
        except (TypeError, ValueError) as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def _apply(self, changes: list[Parameter]) -> None:
        if any(change.name in _NAMES for change in changes):
            self.parameters, self.options = self._candidate(changes)
            self._changed()


_NAMES = {**Parameters.specs(), **Options.specs()}
_DEFAULTS = {name: getattr(table, name) for table in (Parameters(), Options()) for name in table.specs()}


def _taken_overrides(node: Node) -> dict[str, Any]:
    """Values of all overrides, by name, as their tables want them; taken from the node, which then lacks them."""
    values = {}
    for name in set(node.get_parameters_by_prefix('')) - BUILT_IN:
        values[name] = _converted(name, node.get_parameter(name).value)
        node.undeclare_parameter(name)
    return values


def _known(values: dict[str, Any], table: type[Parameters] | type[Options]) -> dict[str, Any]:
    return {name: value for name, value in values.items() if name in table.specs()}


def _check_qos(name: str, value: Any) -> None:
    """Raise what is wrong with an override of a policy, which rclpy would say less clearly, and later."""
    policy = name.rpartition('.')[2]
    values = QOS_POLICIES[policy]
    if values and value not in values:
        raise ValueError(f'{name} must be one of {", ".join(values)}, got {value!r}')
    if not values and (type(value) is not int or not 0 <= value <= 10000):
        raise ValueError(f'{name} must be a whole number of 0 to 10000, got {value!r}')


def _warn_of_unknown(node: Node, overrides: Iterable[str], names: set[str]) -> None:
    for name in overrides:
        if name not in names:
            similar = {_folded(known): known for known in names}
            closest = difflib.get_close_matches(_folded(name), similar, n=1, cutoff=0.5)
            hint = f': did you mean {similar[closest[0]]!r}?' if closest else ''
            node.get_logger().warning(f'there is no parameter {name!r}, what it is set to has no effect{hint}')


def _folded(name: str) -> str:
    """A name in which what looks alike is alike, as T1 and Tl."""
    return name.lower().translate(str.maketrans('lo', '10'))


def _converted(name: str, value: Any) -> Any:
    """A number as the type of its parameter, where nothing is lost by it: users write 50 for 50.0, and tools 4.0 for 4.

    What cannot be converted is left to the check.
    """
    default = _DEFAULTS.get(name)
    if isinstance(default, float) and type(value) is int:
        return float(value)
    if type(default) is int and isinstance(value, float) and value.is_integer():
        return int(value)
    if isinstance(default, tuple) and isinstance(value, array.array) and value.typecode != 'd' and len(value):
        return [float(item) for item in value]
    return value


def _ros_value(value: Any) -> Any:
    return list(value) if isinstance(value, tuple) else value


def _completed(change: Parameter) -> Parameter:
    """A change as its table wants it; what needs no conversion is left as it came, whatever it is."""
    if change.name not in _NAMES or not isinstance(change.value, int | float | array.array):
        return change
    value = _converted(change.name, change.value)
    return change if value is change.value else _parameter(change.name, value)


def _parameter(name: str, value: Any) -> Parameter:
    return Parameter(name, value=_ros_value(value))


def _descriptor(name: str, spec: Spec) -> ParameterDescriptor:
    """What tools show of a parameter. NaN, which stands for "unset", would be outside of any range."""
    constraints = ', '.join(filter(None, (spec.range, spec.unit)))
    descriptor = ParameterDescriptor(
        name=name, description=spec.description, additional_constraints=constraints, read_only=spec.constant)
    default = _DEFAULTS[name]
    if type(default) is int:
        descriptor.integer_range = [IntegerRange(from_value=int(spec.low), to_value=int(spec.high), step=1)]
    elif isinstance(default, float) and not spec.unset and math.isfinite(spec.high):
        descriptor.floating_point_range = [FloatingPointRange(from_value=spec.low, to_value=spec.high, step=0.0)]
    return descriptor
