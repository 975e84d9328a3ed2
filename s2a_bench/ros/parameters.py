"""A node's parameters: what they are, and what the services of ``rcl_interfaces`` answer about them. No I/O.

They are options, named like their flags with underscores. Those that are read when they are needed can be set while the
node runs; the others are read-only. Unknown names are answered as rclpy does: a value of type NOT_SET.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from enum import IntEnum
from threading import Lock
from typing import Any, Final

from s2a_bench.errors import UsageError
from s2a_bench.options import Options, extra_of
from s2a_bench.ros import messages as ros

SERVICE: Final = "rcl_interfaces/srv/"
VALUE: Final = "rcl_interfaces/msg/ParameterValue"
PARAMETER: Final = "rcl_interfaces/msg/Parameter"
DESCRIPTOR: Final = "rcl_interfaces/msg/ParameterDescriptor"
RESULT: Final = "rcl_interfaces/msg/SetParametersResult"


class Type(IntEnum):
    """``rcl_interfaces/msg/ParameterType``."""

    NOT_SET = 0
    BOOL = 1
    INTEGER = 2
    DOUBLE = 3
    STRING = 4
    BYTE_ARRAY = 5
    BOOL_ARRAY = 6
    INTEGER_ARRAY = 7
    DOUBLE_ARRAY = 8
    STRING_ARRAY = 9


FIELDS: Final = {kind: f"{kind.name.lower()}_value" for kind in Type if kind}
"""Type -> the field of ParameterValue that holds it."""
TYPES: Final[dict[type, Type]] = {bool: Type.BOOL, int: Type.INTEGER, float: Type.DOUBLE, str: Type.STRING}
"""Type of our options -> type in ROS; what is neither is text, None is not set."""

RANGES: Final = {
    Type.INTEGER: ("integer_range", "rcl_interfaces/msg/IntegerRange", int),
    Type.DOUBLE: ("floating_point_range", "rcl_interfaces/msg/FloatingPointRange", float),
}
"""Type -> the field of ParameterDescriptor that holds its range, the range's type, and ours."""


@dataclass(frozen=True, slots=True)
class Parameter:
    name: str
    value: Any
    about: str = ""
    live: bool = False
    """Whether it may be set while the node runs."""
    least: float | None = None
    most: float | None = None


def of_options(options: Options, names: Iterable[str], live: Iterable[str] = ()) -> Iterator[Parameter]:
    """Yield options as parameters; ``live`` are those that may be set."""
    for name in names:
        field = type(options).model_fields[name]
        value = getattr(options, name)
        if isinstance(value, tuple):
            value = list(map(str, value))
        elif value is not None and type(value) not in TYPES:
            value = str(value)
        yield Parameter(
            str(extra_of(field).get("flag") or name).replace("-", "_"),
            value,
            field.description or "",
            name in live,
            _bound(field.metadata, "ge", "gt"),
            _bound(field.metadata, "le", "lt"),
        )


def _bound(metadata: Iterable[Any], *names: str) -> float | None:
    return next((float(getattr(each, name)) for each in metadata for name in names if hasattr(each, name)), None)


def type_of(value: Any) -> Type:
    if value is None:
        return Type.NOT_SET
    return Type.STRING_ARRAY if isinstance(value, list) else TYPES[type(value)]


def value_message(value: Any) -> Any:
    kind = type_of(value)
    return ros.default(VALUE, type=int(kind), **({FIELDS[kind]: value} if kind else {}))


def value_of(message: Any) -> Any:
    """Read a ParameterValue; raises UsageError for an unknown type."""
    try:
        kind = Type(message.type)
    except ValueError:
        raise UsageError(f"{message.type} is not a type of a parameter") from None
    value: Any = getattr(message, FIELDS[kind]) if kind else None
    return value.tolist() if hasattr(value, "tolist") else value


class Parameters:
    """The parameters of one node; callable from any thread."""

    def __init__(
        self,
        declared: Iterable[Parameter],
        change: Callable[[Mapping[str, Any]], None] = lambda _: None,
        changed: Callable[[Sequence[Any]], None] = lambda _: None,
    ) -> None:
        """Declare them; ``change`` raises UsageError for values that cannot be, ``changed`` hears of new ones."""
        self._declared = {each.name: each for each in declared}
        self._change, self._changed = change, changed
        self._lock = Lock()

    def services(self) -> Iterator[tuple[str, Callable[[Any], Any]]]:
        """Yield the name of each service type of ``rcl_interfaces``, and what answers it."""
        yield "DescribeParameters", self._describe
        yield "GetParameters", self._get
        yield "GetParameterTypes", self._types
        yield "ListParameters", self._list
        yield "SetParameters", self._set
        yield "SetParametersAtomically", self._set_atomically

    def messages(self) -> list[Any]:
        """Return all as ``rcl_interfaces/msg/Parameter``."""
        return [_named(each.name, each.value) for each in self._declared.values()]

    def _find(self, names: Sequence[str]) -> list[tuple[str, Parameter | None]]:
        return [(name, self._declared.get(name)) for name in names]

    def _describe(self, request: Any) -> Any:
        descriptors = [
            _descriptor(each) if each else ros.default(DESCRIPTOR, name=name)
            for name, each in self._find(request.names)
        ]
        return ros.default(SERVICE + "DescribeParameters_Response", descriptors=descriptors)

    def _get(self, request: Any) -> Any:
        values = [value_message(each.value if each else None) for _, each in self._find(request.names)]
        return ros.default(SERVICE + "GetParameters_Response", values=values)

    def _types(self, request: Any) -> Any:
        types = [int(type_of(each.value)) if each else 0 for _, each in self._find(request.names)]
        return ros.default(SERVICE + "GetParameterTypes_Response", types=types)

    def _list(self, request: Any) -> Any:
        """Names have no dots, so one level: a prefix is a whole name."""
        names = [name for name in self._declared if not len(request.prefixes) or name in request.prefixes]
        result = ros.default("rcl_interfaces/msg/ListParametersResult", names=names)
        return ros.default(SERVICE + "ListParameters_Response", result=result)

    def _set(self, request: Any) -> Any:
        results = [self._tried([each]) for each in request.parameters]
        return ros.default(SERVICE + "SetParameters_Response", results=results)

    def _set_atomically(self, request: Any) -> Any:
        result = self._tried(request.parameters)
        return ros.default(SERVICE + "SetParametersAtomically_Response", result=result)

    def _tried(self, parameters: Sequence[Any]) -> Any:
        try:
            with self._lock:
                wanted = {each.name: self._allowed(each) for each in parameters}
                self._change(wanted)
                for name, value in wanted.items():
                    self._declared[name] = replace(self._declared[name], value=value)
        except UsageError as error:
            return ros.default(RESULT, successful=False, reason=str(error))
        self._changed([_named(*pair) for pair in wanted.items()])
        return ros.default(RESULT, successful=True)

    def _allowed(self, parameter: Any) -> Any:
        """Return the value that a parameter should get; raises UsageError where it cannot be set to such a one."""
        declared = self._declared.get(parameter.name)
        if declared is None:
            raise UsageError(f"there is no parameter {parameter.name[:100]!r}")
        if not declared.live:
            raise UsageError(f"parameter {declared.name} is read-only: start the node with another value")
        value = value_of(parameter.value)
        if (sent := Type(parameter.value.type)) != (wanted := type_of(declared.value)):
            raise UsageError(f"parameter {declared.name} is of type {wanted.name}, not {sent.name}")
        return value


def _named(name: str, value: Any) -> Any:
    return ros.default(PARAMETER, name=name, value=value_message(value))


def _descriptor(declared: Parameter) -> Any:
    kind = type_of(declared.value)
    fields: dict[str, Any] = {
        "name": declared.name,
        "type": int(kind),
        "description": declared.about,
        "read_only": not declared.live,
        "dynamic_typing": declared.value is None,
    }
    if declared.least is not None and declared.most is not None and kind in RANGES:
        field, range_type, number = RANGES[kind]
        bounds = {"from_value": number(declared.least), "to_value": number(declared.most)}
        fields[field] = [ros.default(range_type, **bounds)]
    return ros.default(DESCRIPTOR, **fields)
