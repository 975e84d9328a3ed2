import ctypes
import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from s2a_bench.errors import BadRequest, EngineError, ModelError, UsageError
from s2a_bench.facts import LLAMA
from s2a_bench.inference import Engine, EngineConfig, open_engine
from s2a_bench.inference.llama_cpp import LlamaCppEngine, llama_cpp
from s2a_bench.inference.llama_prompt import VisionTower, bitmap_of, mtmd_cpp
from s2a_bench.testing.engine import EngineSuite, ask, rgb_frame
from s2a_bench.transport.ros.action import BOUNDS

PLAN = r"""
root ::= "[" skill ("," skill){2} "]"
skill ::= "{\"skill\":\"" ("stop" | "go" | "turn") "\",\"s\":" [1-9] "." [0-9] "}"
"""


@pytest.fixture(scope="module")
def shared(tiny: EngineConfig) -> Iterator[LlamaCppEngine]:
    engine = LlamaCppEngine(tiny)
    yield engine
    engine.close()


class TestLlamaCpp(EngineSuite):
    @pytest.fixture
    def engine(self, shared: LlamaCppEngine) -> Engine:
        return shared

    @pytest.fixture
    def fresh_engine(self, tiny: EngineConfig) -> Engine:
        return open_engine(tiny)


def text(engine: Engine, **request: object) -> str:
    return "".join(token.text for token in ask(engine, **request))  # type: ignore[arg-type]


def test_what_a_request_wants_of_sampling_replaces_the_engines_own(shared: LlamaCppEngine) -> None:
    coldest = [text(shared, seed=seed, sampling=(("temp", 0.0),)) for seed in (1, 2)]
    assert coldest[0] == coldest[1]
    assert text(shared, seed=1) != coldest[0]
    assert text(shared, seed=1, sampling=(("top_k", 1),)) == coldest[0]
    assert text(shared, seed=1, sampling=(("temp", 0.0), ("penalty_repeat", 50.0))) != coldest[0]


@pytest.mark.parametrize("end", [0, 1])
def test_extremes_of_sampling_are_answered(shared: LlamaCppEngine, end: int) -> None:
    for name, bounds in BOUNDS.items():
        assert text(shared, sampling=((name, bounds[end]),))
    for mode in (1, 2):
        wanted = (("mirostat", mode), ("mirostat_tau", BOUNDS["mirostat_tau"][end]), ("penalty_last_n", -1))
        assert text(shared, sampling=wanted)


def test_the_grammar_is_obeyed_and_ends_the_answer(shared: LlamaCppEngine) -> None:
    skill = r'\{"skill":"(stop|go|turn)","s":[1-9]\.[0-9]\}'
    answers = {text(shared, seed=seed, max_tokens=200, grammar=PLAN) for seed in range(4)}
    assert all(re.fullmatch(rf"\[{skill}(,{skill}){{2}}\]", answer) for answer in answers)
    assert len(answers) > 1


@pytest.mark.parametrize(
    ("grammar", "reason"),
    [
        ("root ::= [a", "unexpected end of input"),
        ('other ::= "a"', "root"),
        ("root ::= missing", "missing"),
        ("??", ""),
    ],
)
def test_a_bad_grammar_is_named_and_the_next_request_works(
    shared: LlamaCppEngine, grammar: str, reason: str, capfd: pytest.CaptureFixture[str]
) -> None:
    for _ in range(2):
        with pytest.raises(BadRequest, match=f"grammar of request r is not valid GBNF: .*{reason}"):
            ask(shared, grammar=grammar)
    assert ask(shared)
    assert capfd.readouterr() == ("", "")


def test_a_repeated_frame_is_evaluated_in_full_again(shared: LlamaCppEngine) -> None:
    counts = []
    for _ in range(3):
        ask(shared, images=(rgb_frame(5, 640, 480),))
        counts.append(shared.facts["prompt_n"])
    assert counts[0] > 3 * 64  # an overview and at least two slices of 64 tokens
    assert counts == [counts[0]] * 3


def test_facts_tell_what_the_last_request_cost(shared: LlamaCppEngine) -> None:
    ask(shared, max_tokens=5)
    facts = dict(shared.facts)
    assert set(facts) == set(LLAMA) - {"vision_encode_ms"}  # there was no picture
    assert facts["prompt_eval_ms"] <= facts["prompt_ms"]
    assert facts["first_decode_ms"] <= facts["predicted_ms"]
    assert facts["predicted_n"] == 5
    assert facts["prompt_n"] > 10
    assert min(facts["prompt_ms"], facts["predicted_ms"]) > 0


def test_the_vision_tower_of_a_request_before_is_not_counted_again(shared: LlamaCppEngine) -> None:
    ask(shared, images=(rgb_frame(5, 640, 480),))
    ask(shared)
    assert "vision_encode_ms" not in shared.facts


def test_timing_a_picture_step_by_step_changes_no_token(
    shared: LlamaCppEngine, monkeypatch: pytest.MonkeyPatch
) -> None:
    pictures = (rgb_frame(5, 640, 480), rgb_frame(6))
    answer = ask(shared, images=pictures, max_tokens=24)

    def in_one_step(self: VisionTower, llama: Any, chunk: Any) -> int:
        past, where = llama_cpp.llama_pos(0), (llama.n_tokens, 0, llama.n_batch, False)
        assert not mtmd_cpp.mtmd_helper_eval_chunk_single(self._mtmd, llama.ctx, chunk, *where, ctypes.byref(past))
        llama.n_tokens = past.value
        return 0

    monkeypatch.setattr(VisionTower, "_evaluate_slice", in_one_step)
    assert ask(shared, images=pictures, max_tokens=24) == answer


def test_the_bitmap_holds_exactly_the_pixels() -> None:
    for frame in (
        rgb_frame(3, 31, 17),
        replace(rgb_frame(4, 40, 30), width=20, data=rgb_frame(4, 40, 30).data[:, ::2]),
    ):
        bitmap = bitmap_of(frame)
        size = mtmd_cpp.mtmd_bitmap_get_n_bytes(bitmap)
        pixels = np.ctypeslib.as_array(mtmd_cpp.mtmd_bitmap_get_data(bitmap), (size,)).copy()
        shape = mtmd_cpp.mtmd_bitmap_get_nx(bitmap), mtmd_cpp.mtmd_bitmap_get_ny(bitmap)
        assert shape == (frame.width, frame.height)
        mtmd_cpp.mtmd_bitmap_free(bitmap)
        np.testing.assert_array_equal(pixels, frame.data.reshape(-1))


def test_what_is_in_the_picture_and_in_the_prompt_matters(shared: LlamaCppEngine) -> None:
    frame = rgb_frame(1)
    swapped = replace(frame, data=frame.data[:, :, ::-1])
    answers = [text(shared, images=images, max_tokens=24) for images in ((), (frame,), (swapped,), (rgb_frame(2),))]
    answers.append(text(shared, prompt="other", images=(frame,), max_tokens=24))
    assert len(set(answers)) == len(answers)


def test_the_order_of_two_pictures_matters(shared: LlamaCppEngine) -> None:
    one, two = rgb_frame(1), rgb_frame(2)
    assert text(shared, images=(one, two), max_tokens=24) != text(shared, images=(two, one), max_tokens=24)


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"encoding": "bgr8"}, "bgr8 picture; engines take rgb8"),
        ({"width": 640, "height": 480}, r"640x480 whose data are uint8 of shape \(48, 64, 3\)"),
    ],
)
def test_pictures_that_are_no_rgb8_are_refused(shared: LlamaCppEngine, fields: dict[str, Any], message: str) -> None:
    with pytest.raises(BadRequest, match=message):
        ask(shared, images=(replace(rgb_frame(), **fields),))


def test_a_request_longer_than_the_context_says_so(tiny: EngineConfig) -> None:
    engine = LlamaCppEngine(tiny.but(context=256))
    with pytest.raises(BadRequest, match=r"does not fit the context of 256 tokens \(prompt of \d{3,4} tokens"):
        ask(engine, "word " * 500)
    with pytest.raises(BadRequest, match=r"does not fit .* answer of up to 250\); shorten it or raise --context"):
        ask(engine, max_tokens=250)
    with pytest.raises(BadRequest, match=r"prompt of \d{3} tokens, answer of up to 6\)"):
        ask(engine, images=tuple(rgb_frame(index) for index in range(4)))
    assert ask(engine)
    engine.close()


def test_a_prompt_with_the_marker_of_a_picture_is_refused_not_misread(shared: LlamaCppEngine) -> None:
    with pytest.raises(EngineError, match="request r was refused"):
        ask(shared, "look at <__media__>")
    assert ask(shared)


def test_it_describes_model_and_build(shared: LlamaCppEngine, tiny: EngineConfig) -> None:
    facts = shared.describe()
    assert facts["dummy"] is True
    assert facts["architecture"] == "qwen2"
    assert facts["model"] == str(tiny.model)
    assert facts["threads"] == 1
    assert len(str(facts["model_sha256"])) == len(str(facts["mmproj_sha256"])) == 64
    assert facts["parameters"] == 3_294_233
    assert facts["quantisation"] == "F16"
    assert isinstance(facts["gpu_offload_supported"], bool)


def test_a_quantisation_of_several_words_is_whole(shared: LlamaCppEngine, monkeypatch: pytest.MonkeyPatch) -> None:
    def describe(_: object, buffer: ctypes.Array[ctypes.c_char], __: int) -> None:
        buffer.value = b"qwen2 7B Q4_K - Medium"

    monkeypatch.setattr(llama_cpp, "llama_model_desc", describe)
    assert shared.describe()["quantisation"] == "Q4_K - Medium"


def damaged(path: Path, target: Path, old: bytes, new: bytes) -> Path:
    data = path.read_bytes()
    assert old in data
    target.write_bytes(data.replace(old, new))
    return target


def test_what_only_llama_cpp_can_tell_is_a_model_error(
    tiny: EngineConfig, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    strange = damaged(tiny.model, tmp_path / "model.gguf", b"blk.3.ffn_up.weight", b"blk.3.ffn_xx.weight")
    with pytest.raises(ModelError, match=r"`model` .*model.gguf: llama.cpp: .*blk.3.ffn_up.weight"):
        LlamaCppEngine(tiny.but(model=strange))
    strange = damaged(tiny.mmproj, tmp_path / "mmproj.gguf", b"resampler.query", b"resampler.xuery")
    with pytest.raises(ModelError, match=r"`mmproj` .*mmproj.gguf: llama.cpp: .*resampler.query"):
        LlamaCppEngine(tiny.but(mmproj=strange))
    assert capfd.readouterr() == ("", "")


def test_nothing_is_printed(tiny: EngineConfig, capfd: pytest.CaptureFixture[str]) -> None:
    engine = LlamaCppEngine(tiny)
    ask(engine, images=(rgb_frame(1, 640, 480),), grammar=PLAN, max_tokens=200)
    engine.close()
    assert capfd.readouterr() == ("", "")


def test_layers_on_a_gpu_are_refused_by_a_build_for_the_cpu(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(llama_cpp, "llama_supports_gpu_offload", lambda: False)
    with pytest.raises(UsageError, match="`gpu_layers`: this llama-cpp-python is built for the CPU alone"):
        LlamaCppEngine(EngineConfig(gpu_layers=-1))
