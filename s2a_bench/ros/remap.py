"""Names of topics, services and actions that are remapped, as ``from:=to`` of ROS 2: the first rule for a name holds.

Names are relative (below the namespace), private (``~/x``, below the node) or absolute.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping
from typing import Any, Final

from s2a_bench.ros import (
    SERVICE_QOS,
    ActionClient,
    ActionServer,
    Middleware,
    Publisher,
    QoS,
    ServiceClient,
    Subscription,
)

NAME: Final = r"(?:~/|/)?[A-Za-z_][A-Za-z0-9_]*(?:/[A-Za-z_][A-Za-z0-9_]*)*"
RULE: Final = re.compile(f"({NAME}):=({NAME})")


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
    """A middleware in which names of ours stand for others."""

    def __init__(self, middleware: Middleware, names: Mapping[str, str]) -> None:
        """Replace the keys of ``names`` by their values."""
        self._middleware, self._names = middleware, names
        self.describe, self.close = middleware.describe, middleware.close

    def _name(self, name: str) -> str:
        return self._names.get(name, name)

    def publisher(self, topic: str, type_name: str, qos: QoS) -> Publisher:
        """Publish on what stands for ``topic``."""
        return self._middleware.publisher(self._name(topic), type_name, qos)

    def subscription(self, topic: str, type_name: str, qos: QoS) -> Subscription:
        """Subscribe to what stands for ``topic``."""
        return self._middleware.subscription(self._name(topic), type_name, qos)

    def service(self, name: str, type_name: str, answer: Callable[[Any], Any], qos: QoS = SERVICE_QOS) -> None:
        """Offer a service under what stands for ``name``."""
        self._middleware.service(self._name(name), type_name, answer, qos)

    def service_client(self, name: str, type_name: str) -> ServiceClient:
        """Call what stands for ``name``."""
        return self._middleware.service_client(self._name(name), type_name)

    def action_client(self, name: str, type_name: str, version: str = "6.0") -> ActionClient:
        """Call what stands for ``name``."""
        return self._middleware.action_client(self._name(name), type_name, version)

    def action_server(
        self, name: str, type_name: str, result_timeout_s: float = 60.0, version: str = ""
    ) -> ActionServer:
        """Offer an action under what stands for ``name``."""
        return self._middleware.action_server(self._name(name), type_name, result_timeout_s, version)
