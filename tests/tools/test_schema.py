"""The schemas in docs/ are what the classes of the ``--json`` objects say."""

from __future__ import annotations

import importlib.util
import json
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import jsonschema
import pytest
from pydantic import TypeAdapter

from s2a_bench.store.schema import Fraction, about

ROOT = Path(__file__).parent.parent.parent
spec = importlib.util.spec_from_file_location("s2a_schema", ROOT / "tools/schema.py")
assert spec is not None
assert spec.loader is not None
tool = importlib.util.module_from_spec(spec)
sys.modules["s2a_schema"] = tool
spec.loader.exec_module(tool)


@pytest.mark.parametrize("name", sorted(tool.CLASSES))
def test_the_committed_schema_is_what_the_code_declares(name: str) -> None:
    committed = (ROOT / f"docs/schema/{name}.json").read_text(encoding="utf-8")
    assert tool.text_of(name) == committed, "run tools/schema.py"
    jsonschema.Draft202012Validator.check_schema(json.loads(committed))


@dataclass
class SomeCell:
    """Of ``None`` or more."""

    share: Fraction | None
    late: Annotated[Fraction | None, about("If any.")] = None


def test_null_is_no_value_of_a_key_that_may_be_absent() -> None:
    assert TypeAdapter(SomeCell).json_schema(schema_generator=tool.HouseForm) == {
        "description": "Of `null` or more.",
        "type": "object",
        "required": ["share"],
        "additionalProperties": False,
        "properties": {
            "share": {"anyOf": [share := {"type": "number", "minimum": 0, "maximum": 1}, {"type": "null"}]},
            "late": {**share, "description": "If any."},
        },
    }
