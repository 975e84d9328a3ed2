"""Read ROS 2 interface files (.msg, .srv, .action) for rosbags, and add the types ROS derives from them.

A service gives ``X_Request`` and ``X_Response``; an action gives goal, result and feedback, the two services around
them and the feedback message. Beside each request and response stands ``...__wire``: the body behind the header
``uint64 guid, int64 seq`` with which rmw_cyclonedds sends it. ``X`` and ``X_Event`` are never sent: the hash of a
service, which rmw_zenoh has in its keys, is that of ``X``.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any, TypeAlias

from rosbags.interfaces import Nodetype
from rosbags.typesys.msg import MSGParser, make_typesdict

if TYPE_CHECKING:
    import sys

    if sys.version_info >= (3, 11):
        from importlib.resources.abc import Traversable
    else:
        from importlib.abc import Traversable

Description: TypeAlias = "tuple[Nodetype, Any]"
Fields: TypeAlias = "list[tuple[str, Description]]"
Definitions: TypeAlias = "dict[str, tuple[list[Any], Fields]]"
"""ROS type name -> (constants, fields), what rosbags' type store registers."""
Defaults: TypeAlias = "dict[str, dict[str, Any]]"
"""ROS type name -> field -> the default its interface file gives."""

GUID: Description = (Nodetype.BASE, ("uint64", 0))
SEQUENCE: Description = (Nodetype.BASE, ("int64", 0))
STATUS: Description = (Nodetype.BASE, ("int8", 0))
ACCEPTED: Description = (Nodetype.BASE, ("bool", 0))
GOAL_ID: Description = (Nodetype.NAME, "unique_identifier_msgs/msg/UUID")
STAMP: Description = (Nodetype.NAME, "builtin_interfaces/msg/Time")
EVENT_INFO: Description = (Nodetype.NAME, "service_msgs/msg/ServiceEventInfo")

PARTS = {
    "msg": ("",),
    "srv": ("_Request", "_Response"),
    "action": ("_Goal", "_Result", "_Feedback"),
}
"""Kind of interface file -> the suffixes of the types between its ``---`` lines."""


def read_package(folder: Traversable, package: str) -> tuple[Definitions, Defaults]:
    """Read ``folder/{msg,srv,action}/*`` as the interfaces of ``package``."""
    definitions: Definitions = {}
    defaults: Defaults = {}
    for kind, suffixes in PARTS.items():
        if not (folder / kind).is_dir():
            continue
        for entry in sorted((folder / kind).iterdir(), key=lambda entry: entry.name):
            if not entry.name.endswith("." + kind):
                continue
            name = f"{package}/{kind}/{entry.name.removesuffix('.' + kind)}"
            for suffix, text in zip(suffixes, _sections(entry.read_text()), strict=True):
                definitions[name + suffix], defaults[name + suffix] = _parse(text, package)
            definitions.update(_derived(name, kind))
    return definitions, defaults


def _sections(text: str) -> list[str]:
    """Split an interface file at its ``---`` lines."""
    sections = [""]
    for line in text.splitlines():
        if line.strip() == "---":
            sections.append("")
        else:
            sections[-1] += line + "\n"
    return sections


def _parse(text: str, package: str) -> tuple[tuple[list[Any], Fields], dict[str, Any]]:
    """Parse one section; under ``msg/``, because rosbags resolves bare names beside the type's own."""
    (parsed,) = MSGParser(f"MSG: {package}/msg/Section\n{text}").specification()
    (definition,) = make_typesdict([parsed]).values()
    return definition, {field.name: field.value for field in parsed.fields if field.value is not None}


def _derived(name: str, kind: str) -> Iterator[tuple[str, tuple[list[Any], Fields]]]:
    """Yield the types that ROS makes of a service or an action."""
    services = [name] if kind == "srv" else []
    if kind == "action":
        services = [name + "_SendGoal", name + "_GetResult"]
        parts: dict[str, Fields] = {
            "_SendGoal_Request": [("goal_id", GOAL_ID), ("goal", (Nodetype.NAME, name + "_Goal"))],
            "_SendGoal_Response": [("accepted", ACCEPTED), ("stamp", STAMP)],
            "_GetResult_Request": [("goal_id", GOAL_ID)],
            "_GetResult_Response": [("status", STATUS), ("result", (Nodetype.NAME, name + "_Result"))],
            "_FeedbackMessage": [("goal_id", GOAL_ID), ("feedback", (Nodetype.NAME, name + "_Feedback"))],
        }
        yield from ((name + suffix, ([], fields)) for suffix, fields in parts.items())
    for service in services:
        request, response, event = (service + part for part in ("_Request", "_Response", "_Event"))
        for half in (request, response):
            yield half + "__wire", ([], [("guid", GUID), ("seq", SEQUENCE), ("body", (Nodetype.NAME, half))])
        at_most_one = [(Nodetype.SEQUENCE, ((Nodetype.NAME, half), 1)) for half in (request, response)]
        yield event, ([], [("info", EVENT_INFO), ("request", at_most_one[0]), ("response", at_most_one[1])])
        whole = (("request_message", request), ("response_message", response), ("event_message", event))
        yield service, ([], [(part, (Nodetype.NAME, of)) for part, of in whole])


def char_as_uint8(description: Description) -> Description:
    """Replace ``char`` by the ``uint8`` that ROS 2 takes it for, in type hashes too."""
    node, detail = description
    if node == Nodetype.BASE:
        return (node, ("uint8", 0)) if detail[0] == "char" else description
    if node == Nodetype.NAME:
        return description
    inner, count = detail
    return (node, (char_as_uint8(inner), count))
