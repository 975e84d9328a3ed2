"""Write the metrics of timelines into docs/schema/s2a-bench-1.json: `.venv/bin/python tools/docs_schema.py`."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from s2a_bench.experiments.timeline.metrics import METRICS

SCHEMA = Path(__file__).parent.parent / "docs" / "schema" / "s2a-bench-1.json"


def with_metrics(schema: dict[str, Any]) -> dict[str, Any]:
    """Return the schema with the metrics of a timeline's cell as their table has them; its other keys stay.

    A metric that goes leaves its entry, to be taken out by hand.
    """
    cell = schema["$defs"]["timeline_cell"]
    about = {name: entry for name, entry in cell["properties"].items() if name not in METRICS}
    metrics = {name: metric.schema for name, metric in METRICS.items()}
    needed = [name for name in cell["required"] if name not in METRICS]
    needed += [name for name, metric in METRICS.items() if not metric.optional]
    cell = {**cell, "required": needed, "properties": about | metrics}
    return {**schema, "$defs": {**schema["$defs"], "timeline_cell": cell}}


def main() -> None:
    """Write the schema anew."""
    schema = with_metrics(json.loads(SCHEMA.read_text(encoding="utf-8")))
    SCHEMA.write_text(json.dumps(schema, indent=2, ensure_ascii=False) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
