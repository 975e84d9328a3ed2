"""An engine's options refuse what llama.cpp would refuse, before anything is loaded."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from s2a_bench.errors import UsageError
from s2a_bench.inference import EngineConfig


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"name": "gpt"}, "`name`: 'gpt' is not one of llama, echo"),
        ({"kv_type": "q5_1"}, "`kv_type`: 'q5_1' is not one of f32, f16, q8_0, q4_0"),
        ({"kv_type": "q8_0", "flash_attention": "off"}, "`kv_type` q8_0 needs flash attention"),
        ({"flash_attention": "yes"}, "`flash_attention`: 'yes' is not one of auto, on, off"),
        ({"sampling": "beam"}, "`sampling`: 'beam' is not one of model, greedy"),
        ({"batch": 0}, "`batch`: 0 should be greater than or equal to 32"),
        ({"context": 10}, "`context`: 10 should be greater than or equal to 256"),
        ({"threads": -1}, "`threads`: -1"),
        ({"gpu_layers": -2}, "`gpu_layers`: -2"),
        ({"pace": -1}, "`pace`: -1"),
    ],
)
def test_settings_that_make_no_sense_are_named(fields: dict[str, Any], message: str) -> None:
    with pytest.raises(UsageError) as error:
        EngineConfig(**fields)
    assert message in str(error.value)


def test_a_server_is_told_as_json() -> None:
    config = EngineConfig(model=Path("m.gguf"), threads=2, pace=4.8, latency="80")
    assert EngineConfig(**config.model_dump(mode="json")) == config
