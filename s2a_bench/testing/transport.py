"""The conformance suite of transports: subclass `TransportSuite` for each variant and payload, naming the pipeline."""

from __future__ import annotations

import json
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from threading import Event, Thread
from typing import Any, ClassVar, Final

import numpy as np
import pytest

from s2a_bench.clock import clock_id, now_ns
from s2a_bench.errors import EngineError, RequestFailed
from s2a_bench.facts import INFER_MS, PAYLOAD_BYTES, PROMPT_N
from s2a_bench.trace import GROUPS, RESIDUAL, STAGES, Trace, budget, path_of
from s2a_bench.transport import (
    ACTIONS,
    JPEG,
    LOSSLESS,
    PNG,
    TOKENS,
    TRANSPORTS,
    YUYV,
    Client,
    Handler,
    Server,
    Transport,
    Wiring,
    open_client,
    open_server,
)
from s2a_bench.transport.pictures import encoded
from s2a_bench.transport.pipeline import one_pipeline, pipelines
from s2a_bench.transport.serving import Queued
from s2a_bench.types import Action, Frame, Piece, Request, Token

Connect = Callable[[Handler], Client]
"""Opens a client of the server that has this handler."""

CODED: Final = frozenset({"image_encode", "image_decode"})
PICTURE_STAGES: Final = {YUYV: frozenset({"yuv_decode"}), JPEG: CODED, PNG: CODED}
"""Payload -> the stages of a camera's YUYV frame; of all others `convert`."""
PATIENCE_S: Final = 20.0


class RecordingHandler:
    """A handler that records requests and answers with these texts, or with the actions of an array (H, D)."""

    def __init__(self, answer: Sequence[Any]) -> None:
        self.answer = answer
        self.requests: list[Request] = []
        self.fail_at: int | None = None

    def __call__(self, request: Request, trace: Trace) -> Generator[Piece, None, None]:
        self.requests.append(request)
        for index, text in enumerate(self.answer):
            if index == self.fail_at:
                raise EngineError("the engine has had enough")
            now = now_ns()
            if not index:
                trace.marks.append(("inference", now))
            trace.token_ns.append(now)
            yield (
                Token(index, text, 7 + index) if isinstance(text, str) else Action(index, np.asarray(text, np.float32))
            )
        if self.fail_at == len(self.answer):
            raise EngineError("the engine has had enough")
        trace.facts[PROMPT_N] = 12.0


def yuyv_frame(width: int = 64, height: int = 48, seed: int = 0) -> Frame:
    data = np.random.default_rng(seed).integers(0, 256, (height, width, 2), np.uint8)
    return Frame(seed, now_ns(), width, height, "yuv422_yuy2", data)


def ask(client: Client, request: Request) -> tuple[list[Piece], Trace]:
    trace = Trace()
    trace.mark(RESIDUAL)
    return list(client.request(request, trace)), trace


def wiring_of(
    name: str,
    address: str = "",
    *,
    timeout_s: float = 20,
    deadline_s: float = 0,
    max_tokens: int = 512,
    **options: Any,
) -> Wiring[Any]:
    """Return the wiring of a client or server for a pipeline's name; a black box has its address in its options."""
    pipeline = one_pipeline(name, **options)
    address = address or pipeline.options.external_address
    return pipeline.wiring(address, timeout_s=timeout_s, deadline_s=deadline_s, max_tokens=max_tokens)


@contextmanager
def served(wiring: Wiring[Any], handler: Handler) -> Iterator[tuple[Server, Thread]]:
    server = open_server(wiring, handler)
    thread = Thread(target=server.serve)
    thread.start()
    try:
        yield server, thread
    finally:
        server.stop()
        thread.join()


def connector(wiring: Wiring[Any]) -> Iterator[Connect]:
    servers: dict[int, tuple[Server, Thread]] = {}
    with ExitStack() as stack:

        def connect(handler: Handler) -> Client:
            if id(handler) not in servers:
                servers[id(handler)] = stack.enter_context(served(wiring, handler))
            server, thread = servers[id(handler)]
            client = open_client(replace(wiring, address=server.address), thread.is_alive)
            stack.callback(client.close)
            return client

        yield connect


class TransportSuite:
    """Run by every transport and variant. Name the pipeline, or override `wiring`; set the limits of its protocol."""

    name: ClassVar[str]
    """The name in ``--transport``: the transport, perhaps a variant, perhaps options."""
    carries_id_and_limit = True
    carries: ClassVar[frozenset[str]] = frozenset({"grammar", "seed"})
    """The further fields of a request that reach the handler."""
    whole = False
    """Whether an answer is sent as a whole: then none of it arrives before an error."""
    lacks: ClassVar[frozenset[str]] = frozenset()
    """Declared stages that only other variants have."""
    burst = 1000
    """Tokens or actions of a long answer."""
    failure = "the engine has had enough"
    """The message of a client whose engine fails with these words."""

    @pytest.fixture
    def wiring(self) -> Wiring[Any]:
        return wiring_of(self.name)

    @pytest.fixture
    def connect(self, wiring: Wiring[Any]) -> Iterator[Connect]:
        yield from connector(wiring)

    @pytest.fixture
    def transport(self, wiring: Wiring[Any]) -> Transport[Any]:
        return TRANSPORTS[wiring.transport]

    def handler(self, wiring: Wiring[Any], texts: Sequence[str]) -> RecordingHandler:
        """Return a handler that answers with these texts, or if the transport has no tokens with as many actions."""
        if TOKENS in wiring.capabilities.answer_kinds:
            return RecordingHandler(texts)
        return RecordingHandler([[index / 8, -index] for index in range(len(texts))])

    def test_it_is_found_by_the_name_that_it_declares(self, transport: Transport[Any], wiring: Wiring[Any]) -> None:
        assert transport.name == wiring.transport
        assert wiring.variant in (transport.variants or ("",))

    def test_its_stages_are_new_ones_of_known_groups(self, transport: Transport[Any]) -> None:
        assert set(transport.stages.values()) <= set(GROUPS)
        assert not transport.stages.keys() & STAGES.keys()

    def test_its_styles_are_of_its_variants(self, transport: Transport[Any]) -> None:
        assert transport.style.keys() <= set(transport.variants or ("",))

    def test_every_option_is_documented_and_unknown_ones_are_refused(self, transport: Transport[Any]) -> None:
        fields = transport.options.model_fields
        assert [name for name, field in fields.items() if not field.description] == []
        assert transport.options.model_config.get("frozen")
        assert transport.options.model_config.get("extra") == "forbid"

    def test_what_a_server_process_is_told_survives_json(self, wiring: Wiring[Any]) -> None:
        assert Wiring.from_json(json.loads(json.dumps(wiring.to_json()))) == wiring

    def test_the_name_of_a_cell_names_the_same_cell(self, transport: Transport[Any], wiring: Wiring[Any]) -> None:
        options = {transport.name: wiring.options.model_dump(exclude_unset=True)}
        for cell in pipelines([transport.name], options):
            assert pipelines([cell.name], options) == [cell]

    def test_tokens_arrive_in_order_with_text_and_id(self, connect: Connect, wiring: Wiring[Any]) -> None:
        self._needs(TOKENS, wiring)
        texts = ["go", "_to(", "キッチン", ")\n", ""]
        tokens, _ = ask(connect(RecordingHandler(texts)), Request("a", "plan", (yuyv_frame(),)))
        assert tokens == [Token(index, text, 7 + index) for index, text in enumerate(texts)]

    def test_actions_arrive_in_order_with_every_bit(self, connect: Connect, wiring: Wiring[Any]) -> None:
        self._needs(ACTIONS, wiring)
        chunk = np.random.default_rng(5).normal(size=(16, 7)).astype(np.float32)
        chunk[0, :3] = 1e-42, 3.4e38, -0.0
        actions, trace = ask(
            connect(RecordingHandler(list(chunk))), Request("a", "plan", (yuyv_frame(),), max_tokens=16)
        )
        assert [action.index for action in actions] == list(range(16))
        got = np.stack([action.values for action in actions if isinstance(action, Action)])
        assert got.dtype == np.float32
        assert got.tobytes() == chunk.tobytes()
        if not wiring.black_box:
            assert trace.remote is not None
            assert len(trace.remote.token_ns) == 16
            assert trace.chain()[-1][0] == "return"

    def test_several_pictures_and_the_state_reach_the_handler(self, connect: Connect, wiring: Wiring[Any]) -> None:
        if not wiring.capabilities.accepts_state:
            pytest.skip(f"{wiring.transport}/{wiring.variant} carries no observations of policies")
        handler = self.handler(wiring, ["x"])
        state = (0.5, -1.25, 3.0)
        frames = tuple(yuyv_frame(width, height, seed=width) for width, height in ((64, 48), (32, 32), (48, 64)))
        ask(connect(handler), Request("a", "plan", frames, state=state))
        (got,) = handler.requests
        assert got.state == state
        assert [image.data.shape for image in got.images] == [(48, 64, 3), (32, 32, 3), (64, 48, 3)]

    @staticmethod
    def _needs(kind: str, wiring: Wiring[Any]) -> None:
        if kind not in wiring.capabilities.answer_kinds:
            pytest.skip(f"{wiring.transport}/{wiring.variant} does not carry {kind}")

    def test_every_field_of_a_request_reaches_the_handler(self, connect: Connect, wiring: Wiring[Any]) -> None:
        handler = self.handler(wiring, ["x"])
        sent = Request("id-7", 'Grüße,\n"robot"\t机器人', (), max_tokens=9, grammar='root ::= "x"\n', seed=42)
        ask(connect(handler), sent)
        (got,) = handler.requests
        expected = sent if self.carries_id_and_limit else replace(sent, id=got.id, max_tokens=got.max_tokens)
        lost = {"grammar": "", "seed": 0}
        assert got == replace(expected, **{name: lost[name] for name in lost.keys() - self.carries})  # type: ignore[arg-type]

    def test_the_picture_arrives_as_rgb(self, connect: Connect, wiring: Wiring[Any]) -> None:
        import cv2

        handler = self.handler(wiring, ["x"])
        frame = yuyv_frame(seed=3)
        ask(connect(handler), Request("a", "", (frame,)))
        (image,) = handler.requests[0].images
        expected = cv2.cvtColor(frame.data, cv2.COLOR_YUV2RGB_YUY2)
        assert (image.encoding, image.width, image.height) == ("rgb8", 64, 48)
        assert image.data.shape == expected.shape
        if wiring.options.payload in LOSSLESS:
            np.testing.assert_array_equal(image.data, expected)

    def test_stages_and_residual_sum_to_the_whole(
        self, connect: Connect, transport: Transport[Any], wiring: Wiring[Any]
    ) -> None:
        client = connect(self.handler(wiring, ["x", "y"]))
        begin = now_ns()
        _, trace = ask(client, Request("a", "plan", (yuyv_frame(),)))
        end = now_ns()
        chain = trace.chain()
        spent = budget(chain)
        assert sum(spent.stages_ns.values()) + spent.residual_ns == spent.e2e_ns == chain[-1][1] - chain[0][1]
        assert begin <= chain[0][1] <= chain[-1][1] <= end
        assert (chain[-1][0] == "return") != wiring.black_box
        assert set(spent.stages_ns) <= set(path_of([transport.stages]))
        assert all(duration >= 0 for duration in spent.stages_ns.values())
        assert ({"inference", "return"} <= set(spent.stages_ns)) != wiring.black_box

    def test_every_stage_takes_time(self, connect: Connect, transport: Transport[Any], wiring: Wiring[Any]) -> None:
        _, trace = ask(connect(self.handler(wiring, ["x"])), Request("a", "plan", (yuyv_frame(),)))
        spent = budget(trace.chain()).stages_ns
        stages = {"inference", "return", *transport.stages} - self.lacks
        stages |= PICTURE_STAGES.get(wiring.options.payload, {"convert"})
        if not transport.in_process:
            stages.add("network")
        if wiring.black_box:  # the rest of its way is not seen
            stages = {stage for stage in stages if path_of([transport.stages])[stage] in {"encode", "pack"}}
        assert {stage for stage in stages if spent.get(stage, 0) <= 0} == set()

    def test_the_payload_weighs_as_much_as_its_pictures(self, connect: Connect, wiring: Wiring[Any]) -> None:
        if PAYLOAD_BYTES not in wiring.capabilities.facts:
            pytest.skip(f"{wiring.transport}/{wiring.variant} reports no bytes")
        client, payload = connect(self.handler(wiring, ["x"])), wiring.options.payload
        frames = [yuyv_frame(seed=seed) for seed in range(3 if wiring.capabilities.accepts_state else 1)]
        without, sent = (
            ask(client, Request("a", "plan", tuple(images)))[1].facts[PAYLOAD_BYTES] for images in ([], frames)
        )
        files = [frame.data if payload == YUYV else encoded(frame, payload, Trace())[1] for frame in frames]
        pictures = sum(file.size for file in files)
        assert pictures <= sent - without <= 4 / 3 * pictures + 400 * len(frames)  # Base64 and fields at most

    def test_marks_are_computed_once_the_answer_has_arrived(self, connect: Connect, wiring: Wiring[Any]) -> None:
        if wiring.black_box:
            pytest.skip("a black box sends no marks")
        arrived, recording = Event(), self.handler(wiring, ["x", "y"])

        def handler(request: Request, trace: Trace) -> Generator[Piece, None, None]:
            trace.later["had_arrived"] = lambda: float(arrived.wait(PATIENCE_S / 4))
            yield from recording(request, trace)

        trace = Trace()
        for piece in connect(handler).request(Request("a", "plan"), trace):
            if piece.index == 1:
                arrived.set()
        assert trace.facts["had_arrived"] == 1

    def test_inference_begins_when_the_engine_is_free(self, connect: Connect, wiring: Wiring[Any]) -> None:
        """Inference begins neither in the queue nor before, by the marks and by what a policy server reports."""
        if wiring.black_box:
            pytest.skip("a black box sends no marks")
        recording, busy = self.handler(wiring, ["x", "y"]), Event()
        called_ns: list[int] = []

        def answering(request: Request, trace: Trace) -> Generator[Piece, None, None]:
            if not busy.is_set():
                busy.set()
                gives_up_ns = now_ns() + PATIENCE_S * 1e9
                while not queued.turns.waiting and now_ns() < gives_up_ns:
                    Event().wait(0.002)
            called_ns.append(now_ns())
            yield from recording(request, trace)

        queued = Queued.around(answering)
        first, second = connect(queued), connect(queued)
        asking = Thread(target=ask, args=(first, Request("a", "plan")))
        asking.start()
        assert busy.wait(PATIENCE_S)
        _, trace = ask(second, Request("b", "plan"))
        asking.join()
        chain, (busy_ns, handed_ns) = trace.chain(), called_ns
        begins_ns = chain[[stage for stage, _ in chain].index("inference") - 1][1]
        assert busy_ns < begins_ns <= handed_ns
        assert trace.remote is not None
        assert trace.facts.get(INFER_MS, 0) * 1e6 < trace.remote.token_ns[-1] - busy_ns

    def test_the_servers_marks_come_back(self, connect: Connect, wiring: Wiring[Any]) -> None:
        _, trace = ask(connect(self.handler(wiring, ["x", "y", "z"])), Request("a", "plan"))
        if wiring.black_box:
            assert trace.remote is None  # nothing is made up
            return
        assert trace.remote is not None
        assert trace.remote.clock == clock_id()
        assert len(trace.remote.token_ns) == 3
        assert trace.remote.token_ns == sorted(trace.remote.token_ns)
        assert trace.facts[PROMPT_N] == 12.0

    def test_every_fact_that_it_tells_is_declared(self, connect: Connect, wiring: Wiring[Any]) -> None:
        _, trace = ask(connect(self.handler(wiring, ["x", "y"])), Request("a", "plan", (yuyv_frame(),)))
        assert set(trace.facts) <= {*wiring.capabilities.facts, PROMPT_N}  # the handler's
        assert all(fact.about for fact in wiring.capabilities.facts)

    def test_an_engine_that_refuses_fails_this_request_only(self, connect: Connect, wiring: Wiring[Any]) -> None:
        handler = self.handler(wiring, ["x"])
        client = connect(handler)
        handler.fail_at = 0
        with pytest.raises(RequestFailed, match=self.failure):
            ask(client, Request("a", "plan"))
        handler.fail_at = None
        tokens, _ = ask(client, Request("b", "plan"))
        assert len(tokens) == 1

    @pytest.mark.parametrize("fail_at", [1, 2, 3])
    def test_tokens_before_a_break_are_seen(self, connect: Connect, wiring: Wiring[Any], fail_at: int) -> None:
        handler = self.handler(wiring, ["a", "b", "c"])
        handler.fail_at = fail_at
        indices: list[int] = []
        with pytest.raises(RequestFailed, match=self.failure):
            indices.extend(token.index for token in connect(handler).request(Request("a", "plan"), Trace()))
        # extend keeps the items before an exception
        assert indices == ([] if self.whole else [0, 1, 2][:fail_at])

    def test_an_empty_answer_is_no_error(self, connect: Connect, wiring: Wiring[Any]) -> None:
        self._needs(TOKENS, wiring)
        tokens, _ = ask(connect(RecordingHandler([])), Request("a", "plan"))
        assert tokens == []

    def test_a_burst_of_many_tokens_is_complete(self, connect: Connect, wiring: Wiring[Any]) -> None:
        handler = self.handler(wiring, [f"t{number} " for number in range(self.burst)])
        tokens, _ = ask(connect(handler), Request("a", "plan", max_tokens=self.burst))
        acts = not isinstance(handler.answer[0], str)
        expected = [Action(0, np.float32(each)).text for each in handler.answer] if acts else handler.answer  # type: ignore[arg-type]
        assert [token.text for token in tokens] == expected

    def test_a_request_can_be_left_early(self, connect: Connect, wiring: Wiring[Any]) -> None:
        client = connect(self.handler(wiring, [f"t{number}" for number in range(50)]))
        tokens = client.request(Request("a", "plan"), Trace())
        assert next(tokens).index == 0
        tokens.close()  # type: ignore[attr-defined]  # both are generators
        again, _ = ask(client, Request("b", "plan", max_tokens=50))
        assert len(again) == 50

    def test_closing_twice_does_no_harm(self, connect: Connect, wiring: Wiring[Any]) -> None:
        client = connect(self.handler(wiring, ["x"]))
        client.close()
        client.close()
