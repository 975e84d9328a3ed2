"""Names of topics, services and actions that are remapped, as ``from:=to`` of ROS 2: the first rule for a name holds.

Names are relative (below the namespace), private (``~/x``, below the node) or absolute.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping
from typing import Final, TypeVar

from s2a_bench.errors import UsageError
from s2a_bench.ros import Middleware

T = TypeVar("T")
NAME: Final = r"(?:~/|/)?[A-Za-z_][A-Za-z0-9_]*(?:/[A-Za-z_][A-Za-z0-9_]*)*"
RULE: Final = re.compile(f"({NAME}):=({NAME})")
ABSOLUTE: Final = re.compile(r"(/[A-Za-z_][A-Za-z0-9_]*)+")
"""ROS 2's rules for an absolute name: of a topic, a namespace, a node."""


def check_node_name(name: str) -> None:
    if not ABSOLUTE.fullmatch(name):
        raise UsageError(f"node name '{name}': write it as /name or /namespace/name, letters, digits and _")


def expanded(name: str, node_name: str) -> str:
    """Return the absolute name that a node ``/namespace/name`` means by ``name``."""
    if name.startswith("/"):
        return name
    return node_name + name[1:] if name.startswith("~") else f"{node_name.rpartition('/')[0]}/{name}"


def table(rules: Iterable[str], node_name: str) -> dict[str, str]:
    """Return absolute name -> the one that stands for it."""
    names: dict[str, str] = {}
    for rule in rules:
        source, _, target = rule.partition(":=")
        names.setdefault(expanded(source, node_name), expanded(target, node_name))
    return names


class Remapped:
    def __init__(self, middleware: Middleware, names: Mapping[str, str]) -> None:
        def renamed(make: Callable[..., T]) -> Callable[..., T]:
            return lambda name, *how, **more: make(names.get(name, name), *how, **more)

        self.publisher, self.subscription = renamed(middleware.publisher), renamed(middleware.subscription)
        self.service, self.service_client = renamed(middleware.service), renamed(middleware.service_client)
        self.action_client, self.action_server = renamed(middleware.action_client), renamed(middleware.action_server)
        self.offers, self.describe, self.close = middleware.offers, middleware.describe, middleware.close
