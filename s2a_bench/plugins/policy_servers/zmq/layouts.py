"""GR00T's keys, and the layouts of its messages: observations of a robot, and chunks of actions.

N1.5 is flat: ``video.<camera>`` (T, H, W, 3) uint8, ``state.<part>`` (T, D), ``annotation.<...>`` [text]; its answer is
``action.<part>`` (H, D). N1.6 is nested: ``observation`` with ``video``, ``state`` and ``language``, all with a batch
in front, as (B, T, H, W, 3), (B, T, D), [[text]]; its answer is [{part: (B, H, D)}, info]. N1.7 nests as N1.6 does, and
packs arrays and marks configurations in another way (`wire`). Our server reads all of them, and answers in the same.

A request of our client has what `observed` adds beside GR00T's keys. Its answer is followed by a second message, what
the server marked; nothing of it is measured.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np

from s2a_bench.errors import RequestFailed
from s2a_bench.plugins.policy_servers.observation import EXTENSION, Template
from s2a_bench.types import Action, Vector
from s2a_bench.vectors import actions_of

GET_ACTION, PING, RESET, MODALITIES, KILL = "get_action", "ping", "reset", "get_modality_config", "kill"
ENDPOINT, DATA, TOKEN, ERROR, RETRY = "endpoint", "data", "api_token", "error", "retry_after_s"
AUTO, N1_5, N1_6, N1_7 = "auto", "n1.5", "n1.6", "n1.7"
OURS: Final = "s2a-bench"
"""Key of our server's configurations, which their readers ignore."""
PLACES: Final = 1024
"""The most places of a template that a server's configurations make."""
CONFIG_MARKS: Final = {N1_6: "__ModalityConfig_class__", N1_7: "__ModalityConfig__"}
"""Layout -> the key that marks a modality's configuration; N1.5's is N1.6's, with the configuration as text."""
OBSERVATION: Final = "observation"
NAMES: Final = {
    "video": "ego_view",
    "state": "robot",
    "action": "robot",
    "language": "annotation.human.task_description",
}
"""Modality -> the key that our server tells of; whatever the keys are, it reads them."""
ONES: Final = ("x", "y", "z", "roll", "pitch", "yaw", "rx", "ry", "rz", "rw", "pad", "gripper_position")
WIDTHS: Final = {**dict.fromkeys(ONES, 1), "waist": 3, "single_arm": 5, "leg": 6, "arm": 7, "eef_9d": 9}
"""Part of a robot, left as right -> numbers of its state in GR00T's own embodiments; no server tells of them."""
STATE_AXES, PICTURE_AXES = 2, 4
"""The axes of N1.5's arrays without a batch."""


def marked(marks: set[str]) -> str:
    """Return the layout of what the marks of a message say, see `wire.read`; N1.6's where they say none or several."""
    layouts = marks - {OURS}
    return layouts.pop() if len(layouts) == 1 else N1_6


def observation_in(data: Any) -> tuple[Any, str]:
    nested = data.get(OBSERVATION) if isinstance(data, dict) else None
    return (nested, N1_6) if isinstance(nested, dict) else (data, N1_5)


def answer_of(observation: Mapping[Any, Any], layout: str, chunk: Vector) -> Any:
    if layout == N1_6:
        return [{NAMES["action"]: chunk[np.newaxis]}, {}]
    return {f"action.{NAMES['action']}": chunk[np.newaxis] if _batched(observation) else chunk}


def actions_in(answer: Any) -> list[Action]:
    """Return the chunk of an answer of either layout, the parts of an action side by side; raises RequestFailed."""
    actions = answer[0] if isinstance(answer, list) and answer else answer
    if not isinstance(actions, dict):
        raise RequestFailed(f"actions should be a map of arrays, not {type(actions).__name__}")
    return actions_of(actions)


def modalities(layout: str) -> dict[str, Any]:
    """Return our server's answer to ``get_modality_config``; `AUTO` has the marks of N1.6 and of N1.7."""
    configs: dict[str, Any] = {}
    marks = CONFIG_MARKS.values() if layout == AUTO else [CONFIG_MARKS.get(layout, CONFIG_MARKS[N1_6])]
    for modality, name in NAMES.items():
        key = f"{modality}.{name}" if layout == N1_5 and modality != "language" else name
        config: dict[str, Any] = {"delta_indices": [0], "modality_keys": [key]}
        if layout != N1_5:
            config |= dict.fromkeys(("sin_cos_embedding_keys", "mean_std_embedding_keys", "action_configs"))
        content = json.dumps(config) if layout == N1_5 else config
        configs[modality] = {**dict.fromkeys((*marks, OURS), True), "as_json": content}
    return configs


def modalities_in(answer: Any) -> dict[str, tuple[list[str], int]]:
    """Return modality -> keys and time steps, as ``get_modality_config`` was answered; nothing if it was not."""
    try:
        configs = {name: answer[name]["as_json"] for name in ("video", "state", "language")}
        configs = {name: json.loads(each) if isinstance(each, str) else each for name, each in configs.items()}
        keys_of = {
            name: ([*map(str, each["modality_keys"])], len(each["delta_indices"])) for name, each in configs.items()
        }
    except (LookupError, TypeError, ValueError, RecursionError):
        return {}
    plain = all(key != EXTENSION and not key.endswith("?") for keys, _ in keys_of.values() for key in keys)
    few = sum(len(keys) * steps for keys, steps in keys_of.values()) <= PLACES
    return keys_of if plain and few else {}


def template_of(layout: str, keys_of: Mapping[str, tuple[Sequence[str], int]], state: int) -> Template:
    """Return the observation that a server tells of, whose unknown part, or left and right, takes the state's rest."""
    parts = keys_of["state"][0]
    kinds = [part.rpartition(".")[2].replace("left_", "").replace("right_", "") for part in parts]
    unknown = [kind for kind in kinds if kind not in WIDTHS]
    each, over = divmod(state - sum(WIDTHS.get(kind, 0) for kind in kinds), len(unknown) or 1)
    off = each < 1 if unknown else each != 0
    if len({*unknown}) > 1 or over or off:
        widths = ", ".join(f"{part} ({WIDTHS.get(kind, '?')})" for part, kind in zip(parts, kinds, strict=True))
        cure = "give `template`" if len({*unknown}) > 1 else "change `state`, or give `template`"
        raise RequestFailed(f"the server's state is {widths}, not {state} numbers; {cure}")
    ends = np.cumsum([0, *(WIDTHS.get(kind, each) for kind in kinds)])
    places = {"video": "{{image:{0}}}", "state": "{{state:{1}:{2}}}", "language": "{{prompt}}"}
    content: dict[str, Any] = {}
    for modality, (keys, steps) in keys_of.items():
        rows = {key: [places[modality].format(i, *ends[i : i + 2])] * steps for i, key in enumerate(keys)}
        content |= rows if layout == N1_5 else {modality: {key: [row] for key, row in rows.items()}}
    return Template(content, MODALITIES)


def _batched(flat: Mapping[Any, Any]) -> bool:
    """Return whether N1.5's arrays have a batch in front: as GR00T finds it, by the states, else by the pictures."""
    arrays = {str(key): value.ndim for key, value in flat.items() if isinstance(value, np.ndarray)}
    states = [axes for key, axes in arrays.items() if "state" in key]
    return min(states) > STATE_AXES if states else any(axes > PICTURE_AXES for axes in arrays.values())
