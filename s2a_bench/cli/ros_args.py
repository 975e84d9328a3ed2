"""``--ros-args`` as every ROS 2 node accepts them: they become options of `serve ros`.

A file of parameters counts as far as its sections match the node, ``/**`` and other wildcards included. In a section
with a wildcard an unknown name belongs to another node and is left out.
"""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from s2a_bench.errors import UsageError
from s2a_bench.text import dotted, none_of

FLAG: Final = "--ros-args"
END: Final = "--"
VALUED: Final = {
    "-r": "remap",
    "--remap": "remap",
    "-p": "param",
    "--param": "param",
    "--params-file": "params_file",
    "--log-level": "log_level",
    "-e": "enclave",
    "--enclave": "enclave",
    "--log-config-file": "log_config_file",
}
QUIET: Final = re.compile("--(en|dis)able-(rosout|stdout|external-lib)-logs")
"""Ignored flags: the log goes to /rosout and, from warnings on, to stderr."""
ENCLAVE: Final = "ROS_SECURITY_ENCLAVE_OVERRIDE"
"""ROS 2's own variable for the flag, which rclpy's nodes follow."""
OF_EVERY_NODE: Final = "start_type_description_service"
"""Parameter that launch files set for every node."""
PARAMETERS: Final = "ros__parameters"


def folded(arguments: Sequence[str]) -> list[str]:
    """Return a command line whose arguments from ``--ros-args`` to ``--`` or the end are one value of that flag."""
    ordinary: list[str] = []
    of_ros: list[str] = []
    into = ordinary
    for argument in arguments:
        if argument == FLAG:
            into = of_ros
        elif into is of_ros and argument == END:
            into = ordinary
        else:
            into.append(argument)
    return [*ordinary, f"{FLAG}={shlex.join(of_ros)}"] if FLAG in arguments else ordinary


@dataclass(slots=True)
class Read:
    options: dict[str, Any] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    environ: dict[str, str] = field(default_factory=dict)
    """For the node's process."""


def read(text: str, allowed: Sequence[str], node: Mapping[str, str]) -> Read:
    """Read the arguments for a node with the parameters ``allowed``; ``node`` has its default namespace and name.

    Raises UsageError for an unknown argument, and for a parameter that the node does not have.
    """
    result = Read()
    arguments = list(_given(shlex.split(text)))
    rules = [rule for kind, value in arguments if kind == "remap" if (rule := _pair(value, "-r", node["node_name"]))]
    renamed = {"__ns": "namespace", "__node": "node_name", "__name": "node_name"}
    result.options = {renamed[source]: target for source, target in rules if source in renamed}
    if remaps := [f"{source}:={target}" for source, target in rules if source not in renamed]:
        result.options["remap"] = remaps
    named = {**node, **result.options}
    name = f"{named['namespace']}/{named['node_name']}"
    for kind, value in arguments:
        if kind == "param":
            if pair := _pair(value, "-p", node["node_name"]):
                _take(result, {pair[0]: _yaml(pair[1], f"-p {value}")}, allowed, "-p")
        elif kind == "params_file":
            _read_file(result, Path(value), allowed, name)
        elif kind == "log_level":
            result.options["log_level"] = value.rpartition(":=")[2].lower()
        elif kind == "enclave":
            result.environ[ENCLAVE] = value
        elif kind == "log_config_file":
            result.notes.append(f"--log-config-file {value} is left out: the log goes to /rosout and to stderr")
    return result


def _given(arguments: Sequence[str]) -> Iterator[tuple[str, str]]:
    rest = iter(arguments)
    for argument in rest:
        if QUIET.fullmatch(argument):
            continue
        if argument not in VALUED:
            raise UsageError(f"`ros_args`: {argument} is not one of {', '.join(VALUED)}; {END} ends them")
        value = next(rest, None)
        if value is None:
            raise UsageError(f"`ros_args`: {argument} needs a value")
        yield VALUED[argument], value


def _pair(text: str, flag: str, node_name: str) -> tuple[str, str] | None:
    """Return both sides of ``[node:]left:=right``; None if it is for a node of another name."""
    left, assigned, right = text.partition(":=")
    if not (assigned and left and right):
        raise UsageError(f"`ros_args`: {flag} {text} should look like {'from:=to' if flag == '-r' else 'name:=value'}")
    of_node, separated, name = left.rpartition(":")
    return None if separated and of_node != node_name else (name, right)


def _take(result: Read, values: Mapping[str, Any], allowed: Sequence[str], where: str, *, shared: bool = False) -> None:
    """Store parameters; raises UsageError for an unknown one unless the section is ``shared`` with other nodes."""
    for name, value in values.items():
        if name in allowed:
            result.options[name] = value
        elif name == OF_EVERY_NODE:
            continue
        elif shared:
            result.notes.append(f"{where}: {name} is not a parameter of this node and left out")
        else:
            raise UsageError(f"`ros_args` {where}: {none_of(name, allowed)}")


def _read_file(result: Read, path: Path, allowed: Sequence[str], node_name: str) -> None:
    from s2a_bench.toml_file import read as read_file

    whole = _yaml(read_file(path, "params_file"), f"--params-file {path}")
    sections = list(_sections(whole, ""))
    if not sections:
        raise UsageError(f"`ros_args`: --params-file {path} has no '{PARAMETERS}'")
    matching = [(pattern, values) for pattern, values in sections if _matches(pattern, node_name)]
    for pattern, values in matching:
        parameters = dict(dotted(values)) if isinstance(values, dict) else {}
        _take(result, parameters, allowed, f"--params-file {path}, {pattern}", shared="*" in pattern)
    if not matching:
        listed = ", ".join(pattern for pattern, _ in sections)
        result.notes.append(f"--params-file {path} has nothing for {node_name}, only for {listed}")


def _sections(tree: Any, path: str) -> Iterator[tuple[str, Any]]:
    for key, inner in tree.items() if isinstance(tree, dict) else ():
        if key == PARAMETERS:
            yield path, inner
        else:
            yield from _sections(inner, f"{path}/{str(key).strip('/')}")


def _matches(pattern: str, node_name: str) -> bool:
    """Return True if a pattern matches: * stands for one part of the name, ** for any number."""
    parts = ({"**": "(/[^/]+)*", "*": "/[^/]+"}.get(part, "/" + re.escape(part)) for part in pattern.split("/") if part)
    return re.fullmatch("".join(parts), node_name) is not None


def _yaml(text: str, where: str) -> Any:
    from ruamel.yaml import YAML
    from ruamel.yaml.error import YAMLError

    try:
        return YAML(typ="safe", pure=True).load(text)
    except (YAMLError, ValueError, RecursionError) as error:
        raise UsageError(f"`ros_args`: {where} is not YAML: {next(iter(str(error).splitlines()), '')}") from error
