"""The schemas in docs/ are what the classes of the ``--json`` objects say."""

from __future__ import annotations

import importlib.util
import json
import sys
from pathlib import Path

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


def test_what_json_does_not_know_has_no_schema() -> None:
    with pytest.raises(TypeError, match="has no JSON schema"):
        tool.Parts().of(complex)
