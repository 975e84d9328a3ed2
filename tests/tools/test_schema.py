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


def test_what_json_does_not_know_has_no_schema() -> None:
    with pytest.raises(TypeError, match="has no JSON schema"):
        tool.Parts().of(complex)
