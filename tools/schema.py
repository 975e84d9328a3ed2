"""Write docs/schema/*.json from the classes that ``--json`` objects and exported manifests are made of.

`.venv/bin/python tools/schema.py`. Pydantic writes the schema of each dataclass: an object without further keys, its
docstring the description; `Annotated[type, Facts(...)]` adds bounds and descriptions; a field with a default may be
absent. Frames, which say what each command prints, stay as they stand in the files.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from pkgutil import resolve_name
from typing import Annotated, Any, Literal

from pydantic import TypeAdapter
from pydantic.alias_generators import to_snake
from pydantic.json_schema import GenerateJsonSchema
from pydantic_core import core_schema

from s2a_bench.bounds import Count, Facts, Fraction, Many, about
from s2a_bench.experiments import EXPERIMENTS
from s2a_bench.experiments.ccrb.view.tables import ORDERINGS
from s2a_bench.experiments.cells import columns_of
from s2a_bench.experiments.latency.metrics import AROUND, LatencyCell
from s2a_bench.experiments.profile_capture import ProfileJson
from s2a_bench.experiments.requests import RequestCellJson
from s2a_bench.experiments.throughput.metrics import Reference
from s2a_bench.inference.fetch import FetchedFile
from s2a_bench.inference.model_list import ListedModel
from s2a_bench.plan.skillset import GAPS
from s2a_bench.provenance import Origins
from s2a_bench.report.compare.shown import CompareJson
from s2a_bench.store.export import FACTS, ExportedRun
from s2a_bench.store.manifest import RunWarning
from s2a_bench.sweep.json import PlannedCell, SweptCell
from s2a_bench.writers.json import RatioJson

FOLDER = Path(__file__).parent.parent / "docs/schema"


class HouseForm(GenerateJsonSchema):
    """Pydantic's schemas without titles and defaults, with classes in snake case."""

    def normalize_name(self, name: str) -> str:
        """Return the name of a definition."""
        return super().normalize_name(to_snake(name))

    def field_title_should_be_set(self, schema: Any) -> bool:  # noqa: ARG002
        """Return False: the key says it."""
        return False

    def dataclass_schema(self, schema: core_schema.DataclassSchema) -> dict[str, Any]:
        """Return the schema of a dataclass, described by its docstring."""
        made = super().dataclass_schema(schema)
        del made["title"]
        if schema["cls"] is LatencyCell:
            summary = made["properties"]["e2e_ms"]
            made["properties"] |= {each.key: summary | {"description": each.about} for each in AROUND}
        if schema["cls"] is ExportedRun:
            made["properties"] |= {key: {"type": "object"} for key in FACTS}
        text = " ".join(made["description"].replace("``", "`").replace("None", "null").split())
        return made | _keys(schema["cls"], made) | {"description": text, "additionalProperties": False}

    def field_is_required(self, field: Any, total: bool) -> bool:  # noqa: ARG002
        """Return True if the class names no value for a field; what a factory makes is always there."""
        return "default" not in field["schema"]

    def default_schema(self, schema: core_schema.WithDefaultSchema) -> dict[str, Any]:
        """Return the schema of a field where it is there: without null, if that says that it is absent."""
        made = self.generate_inner(schema["schema"])
        return _without_null(made) if schema.get("default", ...) is None else made


def _without_null(schema: dict[str, Any]) -> dict[str, Any]:
    kinds = [kind for kind in schema.get("anyOf", ()) if kind != {"type": "null"}]
    kind = kinds[0] if len(kinds) == 1 else {"anyOf": kinds}
    return {**kind, **{key: value for key, value in schema.items() if key != "anyOf"}} if kinds else schema


def _keys(cls: type, made: dict[str, Any]) -> dict[str, Any]:
    """Return properties and required keys of a class of rows, as `json_of` writes them; nothing for another class."""
    columns = columns_of(cls)
    if issubclass(cls, RequestCellJson) or not any(column.metric or column.json_key for column in columns):
        return {}
    properties, required = {}, []
    for column in columns:
        if not column.key:
            continue
        stored = made["properties"][column.name]
        schema = dict(_without_null(stored))
        if column.in_s or (column.metric and getattr(cls, "means", False)):
            schema["type"] = "number"
        if column.json_key and schema["type"] == "string":
            schema["type"] = ["string", "null"]
        if column.name in made["required"] and {"type": "null"} not in stored.get("anyOf", ()):
            required.append(column.key)
        properties[column.key] = schema
    return {"properties": properties, "required": required}


@dataclass(frozen=True)
class OrderingShare:
    """The number and share of the scenarios in which an ordering holds."""

    k: Count
    value: Fraction
    ci95: Annotated[tuple[float, float] | None, about("Clopper-Pearson; random scenarios only.")] = None


@dataclass(frozen=True)
class CcrbStudy:
    """The shares of one study under one gap behaviour.

    Orderings: the paper's; a policy's impact is more than 0.5 m/s faster (worse) or slower (better) than
    stream-to-act's, of any kind or from behind.
    """

    study: Literal["phase", "random"]
    gap_behaviour: Annotated[str, Facts(enum=list(GAPS))]
    scenarios: Many
    orderings: Annotated[
        dict[str, OrderingShare], Facts(required=list(ORDERINGS), propertyNames={"enum": list(ORDERINGS)})
    ]
    follower_survives: Annotated[
        OrderingShare | None,
        about("Where the car behind avoids an ego with immediate tokens; otherwise a rear impact proves nothing."),
    ] = None
    paper_rates_tokens_per_s: Annotated[
        tuple[float, float] | None,
        about("Least and greatest R at which the paper's ordering holds; absent if it never does."),
    ] = None


@dataclass(frozen=True, kw_only=True)
class BoardFacts:
    """This board; unreadable facts are absent."""

    model: Annotated[str | None, about("From the device tree.")] = None
    gpu: str | None = None
    cpu: str | None = None
    cores: Annotated[Many, about("That this process may use.")]
    memory_bytes: int | None = None
    power_mode: str | None = None
    governor: str | None = None


CELLS = [resolve_name(each.cell) for _, each in sorted(EXPERIMENTS.items()) if each.cell.startswith("s2a_bench.")]
CLASSES: dict[str, list[Any]] = {
    "s2a-bench-1": [*CELLS, PlannedCell, SweptCell, RatioJson, RunWarning, Origins, Reference, CcrbStudy],
    "s2a-bench-compare-1": [CompareJson],
    "s2a-bench-export-1": [ExportedRun],
    "s2a-bench-model-1": [FetchedFile, ListedModel],
    "s2a-bench-profile-1": [BoardFacts, ProfileJson],
}
"""The classes that the frame of each schema refers to."""


def text_of(name: str) -> str:
    """Return a schema as its file holds it, with the definitions of its classes written anew."""
    frame = json.loads((FOLDER / f"{name}.json").read_text(encoding="utf-8"))
    adapters: list[Any] = [(each, "validation", TypeAdapter(each)) for each in CLASSES[name]]
    _, definitions = TypeAdapter.json_schemas(adapters, schema_generator=HouseForm)
    return json.dumps(frame | definitions, indent=2, ensure_ascii=False) + "\n"


if __name__ == "__main__":
    for name in CLASSES:
        (FOLDER / f"{name}.json").write_text(text_of(name), encoding="utf-8")
