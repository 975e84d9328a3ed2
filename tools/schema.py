"""Write docs/schema/*.json from the classes that ``--json`` objects are made of.

`.venv/bin/python tools/schema.py`. A dataclass becomes an object without further keys, its docstring the description;
`Annotated[type, {...}]` adds bounds and descriptions; a field with a default may be absent. Of s2a-bench-1.json the
cells (`Experiment.cell`), ratios, warnings and what else is a class are written; the frame stays as it stands.
"""

from __future__ import annotations

import dataclasses
import inspect
import json
import re
import types
from collections.abc import Sequence
from pathlib import Path
from pkgutil import resolve_name
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints

from s2a_bench.experiments import EXPERIMENTS
from s2a_bench.experiments.ccrb.view.tables import ORDERINGS
from s2a_bench.experiments.profile_capture import ProfileJson
from s2a_bench.experiments.throughput.metrics import Reference
from s2a_bench.inference.fetch import FetchedFile
from s2a_bench.inference.model_list import ListedModel
from s2a_bench.plan.skillset import GAPS
from s2a_bench.provenance import Origins
from s2a_bench.report.compare.shown import CompareJson
from s2a_bench.store.manifest import RunWarning
from s2a_bench.store.schema import Count, Fraction, Many, about
from s2a_bench.sweep.json import PlannedCell, SweptCell
from s2a_bench.writers.json import RatioJson

FOLDER = Path(__file__).parent.parent / "docs/schema"
PLAIN = {str: "string", Path: "string", int: "integer", float: "number", bool: "boolean", type(None): "null"}


class Parts:
    """Schemas of types; those of dataclasses are collected under ``$defs``."""

    def __init__(self) -> None:
        """Start without any."""
        self.defs: dict[str, dict[str, Any]] = {}

    def of(self, hint: Any) -> dict[str, Any]:  # noqa: PLR0911 - a type, a schema
        """Return the schema of a type; raises TypeError for one that JSON does not know."""
        origin, arguments = get_origin(hint), get_args(hint)
        if origin is Annotated:
            return self.of(arguments[0]) | {key: value for more in arguments[1:] for key, value in more.items()}
        if hint is Any:
            return {}
        if hint in PLAIN:
            return {"type": PLAIN[hint]}
        if dataclasses.is_dataclass(hint):
            name = _name(hint)
            self.defs.setdefault(name, self.object(hint))
            return {"$ref": f"#/$defs/{name}"}
        if origin is Literal:
            return {"const": arguments[0]} if len(arguments) == 1 else {"enum": list(arguments)}
        if origin in {Union, types.UnionType}:
            return _either([self.of(one) for one in arguments])
        if origin is list:
            return {"type": "array", "items": self.of(arguments[0])}
        if origin is tuple:
            n = len(arguments)
            return {"type": "array", "items": self.of(arguments[0]), "minItems": n, "maxItems": n}
        if origin is dict:
            return {"type": "object", "additionalProperties": self.of(arguments[1]) or True}
        raise TypeError(f"{hint} has no JSON schema")

    def object(self, cls: Any) -> dict[str, Any]:
        """Return the schema of a dataclass; a field with a default may be absent."""
        hints = get_type_hints(cls, include_extras=True)
        fields = dataclasses.fields(cls)
        return {
            "description": " ".join((inspect.getdoc(cls) or "").replace("``", "`").replace("None", "null").split()),
            "type": "object",
            "required": [field.name for field in fields if field.default is dataclasses.MISSING],
            "additionalProperties": False,
            "properties": {field.name: _there(self.of(hints[field.name]), field) for field in fields},
        }


def _name(cls: Any) -> str:
    return re.sub(r"(?<!^)(?=[A-Z])", "_", cls.__name__).lower()


def _there(schema: dict[str, Any], field: dataclasses.Field[Any]) -> dict[str, Any]:
    """Return the schema of a field where it is there: without null, if that says that it is absent."""
    if field.default is not None:
        return schema
    if isinstance(schema.get("type"), list):
        return schema | {"type": next(kind for kind in schema["type"] if kind != "null")}
    if "oneOf" not in schema:
        return schema
    rest = [each for each in schema["oneOf"] if each != {"type": "null"}]
    inner = rest[0] if len(rest) == 1 else {"oneOf": rest}
    return {name: value for name, value in schema.items() if name != "oneOf"} | inner


def compare_schema() -> dict[str, Any]:
    """Return the schema of `compare --json`."""
    parts = Parts()
    return {**_head("s2a-bench-compare-1", "s2a-bench compare --json, version 1"), **parts.object(CompareJson)} | {
        "$defs": parts.defs
    }


def frame_schema() -> dict[str, Any]:
    """Return the schema of what the measuring commands print, with what is declared in the place of what was there."""
    declared = [EXPERIMENTS[name].cell for name in sorted(EXPERIMENTS)]
    cells = [resolve_name(cell) for cell in declared if cell.startswith("s2a_bench.")]
    named: dict[str, Any] = {"ratio": RatioJson, "warning": RunWarning, "origins": Origins}
    named |= {_name(each): each for each in (*cells, Reference, CcrbStudy)}
    named["sweep_cell"] = PlannedCell | SweptCell
    return _redefined("s2a-bench-1", named, kept=("level", "check"))


@dataclasses.dataclass(frozen=True)
class OrderingShare:
    """The number and share of the scenarios in which an ordering holds."""

    k: Count
    value: Fraction
    ci95: Annotated[tuple[float, float] | None, about("Clopper-Pearson; random scenarios only.")] = None


@dataclasses.dataclass(frozen=True)
class CcrbStudy:
    """The shares of one study under one gap behaviour.

    Orderings: the paper's; a policy's impact is more than 0.5 m/s faster (worse) or slower (better) than
    stream-to-act's, of any kind or from behind.
    """

    study: Literal["phase", "random"]
    gap_behaviour: Annotated[str, {"enum": list(GAPS)}]
    scenarios: Many
    orderings: Annotated[
        dict[str, OrderingShare], {"required": list(ORDERINGS), "propertyNames": {"enum": list(ORDERINGS)}}
    ]
    follower_survives: Annotated[
        OrderingShare | None,
        about("Where the car behind avoids an ego with immediate tokens; otherwise a rear impact proves nothing."),
    ] = None
    paper_rates_tokens_per_s: Annotated[
        tuple[float, float] | None,
        about("Least and greatest R at which the paper's ordering holds; absent if it never does."),
    ] = None


@dataclasses.dataclass(frozen=True, kw_only=True)
class BoardFacts:
    """This board; unreadable facts are absent."""

    model: Annotated[str | None, about("From the device tree.")] = None
    gpu: str | None = None
    cpu: str | None = None
    cores: Annotated[Many, about("That this process may use.")]
    memory_bytes: int | None = None
    power_mode: str | None = None
    governor: str | None = None


def profile_schema() -> dict[str, Any]:
    """Return the schema of `profile ... --json`."""
    return _redefined("s2a-bench-profile-1", {"board": BoardFacts, "profile": ProfileJson})


def model_schema() -> dict[str, Any]:
    """Return the schema of `model fetch|list --json`."""
    return _redefined("s2a-bench-model-1", {"fetched": FetchedFile, "listed": ListedModel})


def _redefined(name: str, named: dict[str, Any], kept: Sequence[str] = ()) -> dict[str, Any]:
    """Return a schema whose definitions are written anew, but for ``kept`` ones; its frame stays as it stands."""
    whole: dict[str, Any] = json.loads((FOLDER / f"{name}.json").read_text(encoding="utf-8"))
    parts = Parts()
    made = {
        key: parts.object(each) if dataclasses.is_dataclass(each) else parts.of(each) for key, each in named.items()
    }
    return whole | {"$defs": {key: whole["$defs"][key] for key in kept} | made | parts.defs}


def _head(name: str, title: str) -> dict[str, Any]:
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "$id": f"https://s2a-bench.invalid/schema/{name}.json",
        "title": title,
    }


def _either(found: list[dict[str, Any]]) -> dict[str, Any]:
    """Join alternatives: a plain type or null as a list of types, else oneOf."""
    *others, last = found
    if last == {"type": "null"} and len(others) == 1 and others[0].keys() == {"type"}:
        return {"type": [others[0]["type"], "null"]}
    return {"oneOf": found}


SCHEMAS = {
    "s2a-bench-compare-1.json": compare_schema,
    "s2a-bench-1.json": frame_schema,
    "s2a-bench-profile-1.json": profile_schema,
    "s2a-bench-model-1.json": model_schema,
}


def text_of(schema: dict[str, Any]) -> str:
    """Write a schema as its file holds it."""
    return json.dumps(schema, indent=2, ensure_ascii=False) + "\n"


if __name__ == "__main__":
    for file, build in SCHEMAS.items():
        (FOLDER / file).write_text(text_of(build()), encoding="utf-8")
