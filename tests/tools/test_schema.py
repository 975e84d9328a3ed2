"""The schemas in docs/ are what the classes of the ``--json`` objects say."""

from __future__ import annotations

import importlib.util
import json
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import jsonschema
import pytest

from s2a_bench.store.manifest import present
from s2a_bench.store.schema import NonNegative, about
from s2a_bench.writers.json import cell_of_row

ROOT = Path(__file__).parent.parent.parent
spec = importlib.util.spec_from_file_location("s2a_schema", ROOT / "tools/schema.py")
assert spec is not None
assert spec.loader is not None
tool = importlib.util.module_from_spec(spec)
sys.modules["s2a_schema"] = tool
spec.loader.exec_module(tool)


@pytest.mark.parametrize("name", sorted(tool.SCHEMAS))
def test_the_committed_schema_is_what_the_code_declares(name: str) -> None:
    committed = (ROOT / "docs/schema" / name).read_text(encoding="utf-8")
    assert tool.text_of(tool.SCHEMAS[name]()) == committed, "run tools/schema.py"
    jsonschema.Draft202012Validator.check_schema(json.loads(committed))


@dataclass
class Inner:
    """Something inside."""

    pair: tuple[float, float] | None


@dataclass
class Outer:
    """All that there is.

    In two parts.
    """

    kind: Literal["a", "b"]
    share: Annotated[float | None, {"minimum": 0}]
    many: list[Inner]
    facts: dict[str, int]
    more: str = ""


def test_a_class_becomes_an_object_without_further_keys() -> None:
    parts = tool.Parts()
    assert parts.object(Outer) == {
        "description": "All that there is. In two parts.",
        "type": "object",
        "required": ["kind", "share", "many", "facts"],
        "additionalProperties": False,
        "properties": {
            "kind": {"enum": ["a", "b"]},
            "share": {"type": ["number", "null"], "minimum": 0},
            "many": {"type": "array", "items": {"$ref": "#/$defs/inner"}},
            "facts": {"type": "object", "additionalProperties": {"type": "integer"}},
            "more": {"type": "string"},
        },
    }
    pair = {"type": "array", "items": {"type": "number"}, "minItems": 2, "maxItems": 2}
    assert parts.defs["inner"]["properties"]["pair"] == {"oneOf": [pair, {"type": "null"}]}


@dataclass
class Lacking:
    """Some of it may be absent."""

    share: Annotated[NonNegative | None, about("Of all.")] = None
    inner: Annotated[Inner | None, about("Inside.")] = None
    kind: Literal["a"] | None = None


def test_what_is_none_by_default_is_absent_and_never_null() -> None:
    assert tool.Parts().object(Lacking)["properties"] == {
        "share": {"type": "number", "minimum": 0, "description": "Of all."},
        "inner": {"$ref": "#/$defs/inner", "description": "Inside."},
        "kind": {"const": "a"},
    }
    assert present(Lacking(share=0.5)) == {"share": 0.5}


@dataclass
class Row:
    """A row."""

    title: str
    at_ns: int
    share: float | None


def test_a_cell_of_a_row_has_its_fields_but_some_and_lacks_what_it_may_lack() -> None:
    cell = cell_of_row("RowCell", "A cell.", Row, without=("at_ns",), own={"at_s": float, "profile": str | None})
    found = tool.Parts().object(cell)
    assert found["description"] == "A cell."
    assert found["required"] == ["title", "at_s", "profile"]
    assert found["properties"]["share"] == {"type": "number"}
    assert found["properties"]["profile"] == {"type": ["string", "null"]}


def test_what_json_does_not_know_has_no_schema() -> None:
    with pytest.raises(TypeError, match="has no JSON schema"):
        tool.Parts().of(complex)
