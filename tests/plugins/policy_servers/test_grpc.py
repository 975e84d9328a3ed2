"""lerobot's protocol: our client for its policy server, whose answers are pickles that nobody unpickles."""

from __future__ import annotations

import json
import random
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from threading import Event
from typing import Any, ClassVar

import numpy as np
import pytest

from s2a_bench.errors import EngineError, RequestFailed, ServerDied, UsageError
from s2a_bench.experiments.latency.config import LatencyConfig
from s2a_bench.experiments.latency.run import run_latency
from s2a_bench.facts import PAYLOAD_BYTES, RECONNECTS
from s2a_bench.frames.convert import yuyv_to_rgb
from s2a_bench.plugins.policy_servers.grpc import GET_ACTIONS_MS, GRPC, PAYLOAD_DOWN_BYTES, GrpcOptions
from s2a_bench.plugins.policy_servers.grpc.pickles import OPCODES, chunk_in
from s2a_bench.store.run import read_run
from s2a_bench.testing import NullProgress
from s2a_bench.testing.transport import Connect, TransportSuite, ask, wiring_of, yuyv_frame
from s2a_bench.trace import Trace, budget
from s2a_bench.transport import Choice, Client, Handler, Wiring, open_client
from s2a_bench.types import Action, Frame, Request
from tests.servers.lerobot import PolicyServer, action, answer, chunk, grpc_server, name, storage, text

GOLDEN = Path(__file__).with_name("data")
CHUNK = np.arange(12, dtype=np.float32).reshape(4, 3) / 8
STATE = (0.5, 1.5)


def good(observation: Any) -> bytes:
    return chunk(observation.timestamp, CHUNK)


@contextmanager
def policy(*replies: Callable[[Any], bytes | None], port: int = 0) -> Iterator[tuple[PolicyServer, str]]:
    """A policy server that replies with these in turn, the last for ever."""
    left = list(replies or [good])

    def reply(observation: Any) -> bytes | None:
        return (left.pop(0) if len(left) > 1 else left[0])(observation)

    server = PolicyServer(reply)
    with grpc_server([server.handlers()], port) as url:
        yield server, url


def robot(url: str, timeout_s: float = 20, **more: Any) -> closing[Client]:
    options = {"policy_type": "act", "pretrained": "me/act", **more}
    return closing(open_client(wiring_of("grpc/lerobot", url=url, timeout_s=timeout_s, **options)))


def request(*frames: Any, state: tuple[float, ...] = STATE) -> Request:
    return Request("a", "pick it up", frames, state=state)


class TestClient:
    @pytest.mark.parametrize(
        ("size", "pieces"), [((64, 48), [3]), ((1280, 960), [1, 3]), ((1600, 1000), [1, 2, 3])], ids=str
    )
    def test_a_policy_gets_what_the_template_says(self, size: tuple[int, int], pieces: list[int]) -> None:
        frames = [yuyv_frame(*size, seed=1), yuyv_frame(seed=2)]
        with policy() as (server, url), robot(url, actions_per_chunk=4, device="cuda") as opened:
            actions, trace = ask(opened, request(*frames))
        np.testing.assert_array_equal(np.stack([each.values for each in actions]), CHUNK)  # type: ignore[union-attr]
        (told,), (seen,) = server.policies, server.observations
        assert server.states == [pieces]
        axes, pictures = ["height", "width", "channels"], dict(zip(("front", "wrist"), frames, strict=True))
        images = {
            f"observation.images.{camera}": {"dtype": "image", "shape": (frame.height, frame.width, 3), "names": axes}
            for camera, frame in pictures.items()
        }
        state = {"dtype": "float32", "shape": (2,), "names": ["state.0", "state.1"]}
        assert vars(told) == {
            "policy_type": "act",
            "pretrained_name_or_path": "me/act",
            "lerobot_features": {**images, "observation.state": state},
            "actions_per_chunk": 4,
            "device": "cuda",
            "rename_map": {},
        }
        assert seen.must_go is True
        assert [seen.observation[key] for key in ("task", "state.0", "state.1")] == ["pick it up", 0.5, 1.5]
        for camera, frame in pictures.items():
            np.testing.assert_array_equal(seen.observation[camera], yuyv_to_rgb(frame.data))
        spent = budget(trace.chain())
        assert [*spent.stages_ns] == ["convert", "connect", "pickle_pack", "send", "server", "pickle_parse"]
        assert trace.facts[PAYLOAD_BYTES] > sum(3 * frame.width * frame.height for frame in frames)
        assert trace.facts[GET_ACTIONS_MS] * 1e6 >= spent.stages_ns["server"]
        assert trace.facts[PAYLOAD_DOWN_BYTES] == len(good(seen)) + 3

    def test_the_policy_is_loaded_once_and_again_after_another_cells(self) -> None:
        with (
            policy() as (server, url),
            robot(url) as first,
            robot(url) as alike,
            robot(url, pretrained="me/other") as second,
        ):
            for opened in (first, first, alike, second, first):
                ask(opened, request())
            assert [each.pretrained_name_or_path for each in server.policies] == ["me/act", "me/other", "me/act"]
            assert len({each.timestep for each in server.observations[:2]}) == 2

    def test_a_server_that_comes_again_loads_the_policy_again(self) -> None:
        with ExitStack() as stack:
            with policy() as (_, url):
                clients = [stack.enter_context(robot(url)) for _ in range(2)]
                for opened in clients:  # the first has the policy loaded for both
                    ask(opened, request())
            for opened in clients:
                with pytest.raises(RequestFailed, match="broke the connection"):
                    ask(opened, request())
            server, _ = stack.enter_context(policy(port=int(url.rpartition(":")[2])))
            assert [ask(opened, request())[1].facts[RECONNECTS] for opened in clients] == [1, 1]
            assert len(server.policies) == 1


class TestContract(TransportSuite):
    """The contract, as far as lerobot's server carries it: no ids, no marks; its log has the policy's error."""

    carries_id_and_limit = False
    carries: ClassVar[frozenset[str]] = frozenset()
    whole = True
    burst = 400  # bytes grow with the square
    failure = "its policy raised an error"

    @pytest.fixture
    def wiring(self, tmp_path: Path) -> Wiring[Any]:
        path = tmp_path / "optional.json"
        cameras = {f"camera_{index}?": f"{{image:{index}}}" for index in range(3)}
        path.write_text(json.dumps({**cameras, "state?": "{state}", "task": "{prompt}"}))
        return wiring_of("grpc/lerobot", url="grpc://a:1", policy_type="act", pretrained="x", template=str(path))

    @pytest.fixture
    def connect(self, wiring: Wiring[Any]) -> Iterator[Connect]:
        with ExitStack() as stack:

            def connect(handler: Handler) -> Client:
                _, url = stack.enter_context(policy(lambda seen: policy_of(handler, seen)))
                client = open_client(replace(wiring, address=url))
                stack.callback(client.close)
                return client

            yield connect


def policy_of(handler: Handler, seen: Any) -> bytes | None:
    """Return the chunk with which a handler answers an observation; None where it fails, as lerobot's server does."""
    numbers = [value for value in seen.observation.values() if isinstance(value, float)]
    pictures = [value for value in seen.observation.values() if isinstance(value, np.ndarray)]
    frames = tuple(Frame(-1, 0, each.shape[1], each.shape[0], "rgb8", each) for each in pictures)
    request = Request("", seen.observation["task"], frames, state=tuple(numbers))
    with suppress(EngineError):
        actions = [piece.values for piece in handler(request, Trace()) if isinstance(piece, Action)]
        return chunk(seen.timestamp, np.stack(actions))
    return None


FAULTS = {
    "nothing": (lambda _: None, "without a chunk: its policy raised an error, .* as another client took it"),
    "another's": (lambda seen: chunk(seen.timestamp + 1, CHUNK), "the observation of another client"),
    "no pickle": (lambda _: b"what", "not a chunk of lerobot's"),
    "no number": (lambda seen: chunk(seen.timestamp, CHUNK * np.float32(np.nan)), "not finite"),
    "too much": (lambda _: bytes(5 << 20), "more than 4 MiB"),
}


@pytest.mark.parametrize(("reply", "says"), FAULTS.values(), ids=FAULTS)
def test_a_faulty_answer_is_one_line_and_the_next_request_goes_on(
    reply: Callable[[Any], bytes | None], says: str
) -> None:
    with policy(reply, good) as (server, url), robot(url) as opened:
        with pytest.raises(RequestFailed, match=says):
            ask(opened, request())
        actions, trace = ask(opened, request())
        assert (len(actions), RECONNECTS in trace.facts) == (4, False)
        assert len(server.policies) == 1 + ("without a chunk" in says)  # the server may have been started again


def test_a_policy_that_does_not_load_is_told_in_the_servers_words() -> None:
    says = pytest.raises(RequestFailed, match="Policy type foo not supported")
    with policy() as (_, url), robot(url, policy_type="foo") as opened, says:
        ask(opened, request())


def test_a_silent_server_is_given_up() -> None:
    over, says = Event(), pytest.raises(RequestFailed, match="silent for too long")
    with policy(lambda _: over.wait(20) and None) as (_, url), robot(url, timeout_s=0.5) as opened:
        with says:
            ask(opened, request())
        over.set()


def test_where_nothing_listens_the_run_ends_and_another_grpc_server_is_named_so() -> None:
    foreign = pytest.raises(RequestFailed, match="not a policy server of lerob")
    with grpc_server() as url, robot(url) as opened, foreign:
        ask(opened, request())
    with robot(url) as opened, pytest.raises(ServerDied, match=f"no gRPC server answers at {url}"):
        ask(opened, request())


ACT = {"url": "grpc://a:1", "policy_type": "act"}
MISUSES: dict[str, tuple[dict[str, str], int, str]] = {
    **{f"url {url}": ({"url": url}, 1, "url") for url in ("ws://a:1", "grpc://a", "grpc://me:secret@a:1")},
    "no policy": (ACT, 1, "give `policy_type` and `pretrained`"),
    "no type": ({"url": "grpc://a:1", "pretrained": "x"}, 1, "give `policy_type` and `pretrained`"),
    "cameras": ({**ACT, "pretrained": "x"}, 5, "has places for 4"),
    "state": ({**ACT, "pretrained": "x"}, 1, "the request has 0; see `cameras` and `state`"),
}


@pytest.mark.parametrize(("options", "cameras", "says"), MISUSES.values(), ids=MISUSES)
def test_a_choice_without_a_policy_or_its_needs_is_refused(options: dict[str, str], cameras: int, says: str) -> None:
    with pytest.raises(UsageError, match=says):
        GRPC.require(Choice(GrpcOptions(**options), cameras=cameras))


def test_a_template_with_what_lerobot_does_not_take_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "chw.toml"
    path.write_text('front = "{image:0|CHW}"\nstate = "{state}"')
    options = GrpcOptions(**ACT, pretrained="x", template=str(path))
    with pytest.raises(UsageError, match="front must be a picture"):
        GRPC.require(Choice(options, state=2))


@pytest.mark.parametrize("path", sorted(GOLDEN.glob("*.pkl")), ids=lambda path: path.stem)
def test_what_torch_and_lerobot_wrote_is_read(path: Path) -> None:
    stamp, actions = chunk_in(path.read_bytes())
    rows = 1 if path.stem == "float64" else 3
    expected = np.arange(-2, 2 * rows - 2).reshape(rows, 2) / (1 if path.stem == "int64" else 8)
    np.testing.assert_array_equal(actions, expected)
    assert stamp == 1.5


KEPT, LARGE, REBUILD = storage(CHUNK), storage(CHUNK.repeat(1 << 15)), name("torch._utils", "_rebuild_tensor_v2")


def bombs(path: Path) -> dict[str, tuple[bytes, str]]:
    """Pickles that make a folder where they are unpickled, and those that are too large, deep or wrong."""
    bomb = name("os", "mkdir") + text(str(path)) + b"\x85R"
    refused = "it names os.mkdir, which no chunk does"
    deep = b"]" + b"\x85" * (OPCODES - 10)
    return {
        "bare": (b"\x80\x02" + bomb + b".", refused),
        "in a storage": (answer(action(1.0, b"\x80\x02" + bomb + b".", 0, 3)), refused),
        "at the storage's end": (answer(action(1.0, KEPT[:-8] + bomb, 0, 3)), "a storage of|buffer size"),
        "as an instance": (b"\x80\x02" + name("subprocess", "Popen") + b")\x81.", "subprocess.Popen"),
        "by its number": (b"\x80\x02\x82\x01.", "the opcode EXT1"),
        "in proto 0": (b"(S'x'\nios\nmkdir\n.", "the opcode STRING"),
        "large memo": (b"\x80\x02]r\xff\xff\xff\x7f.", "the opcode LONG_BINPUT"),
        "deep": (b"\x80\x04})" + b"\x85" * (2 * OPCODES) + b"Ns.", f"more than {OPCODES}"),
        "a deep key": (b"\x80\x04})" + deep[1:] + b"Ns.", "object"),
        "beyond the storage": (answer(action(1.0, KEPT, 10, 3)), "a tensor of 3 numbers from 10 on, of 12"),
        "before the storage": (answer(action(1.0, KEPT, -3, 3)), "a tensor of 3 numbers from -3"),
        "no stride": (answer(action(1.0, KEPT, 0, 3, 0)), "slice step|a tensor of 3"),
        "wrong count": (answer(action(1.0, storage(CHUNK, 1 << 20), 0, 3)), "a storage of 1048576"),
        "another type": (answer(action(1.0, storage(CHUNK, kind="UntypedStorage"), 0, 3)), "torch.UntypedStorage"),
        "unequal": (answer(action(1.0, KEPT, 0, 3), action(1.0, KEPT, 0, 2)), "different lengths"),
        "too many numbers": (answer(*[action(1.0, LARGE, 0, 12 << 15)] * 3), "more than 1048576"),
        "no list": (b"\x80\x02}.", "not a chunk"),
        "an attribute of a name": (answer(REBUILD + b"}" + text("x") + b"Nsb"), "not a chunk"),
        "half": (answer(action(1.0, KEPT, 0, 3))[:-30], "not a chunk"),
    }


@pytest.mark.parametrize("which", bombs(Path()))
def test_a_hostile_pickle_is_refused_and_runs_nothing(which: str, tmp_path: Path) -> None:
    data, says = bombs(tmp_path / "made")[which]
    with pytest.raises(RequestFailed, match=says):
        chunk_in(data)
    assert not (tmp_path / "made").exists()


def test_a_damaged_pickle_is_read_or_refused() -> None:
    whole, dice = (GOLDEN / "float32.pkl").read_bytes(), random.Random(0)
    for _ in range(500):
        damaged = bytearray(whole)
        for _ in range(dice.randint(1, 4)):
            damaged[dice.randrange(len(damaged))] = dice.randrange(256)
        try:
            _, actions = chunk_in(bytes(damaged))
        except RequestFailed:
            continue
        assert actions.ndim == 2


def test_a_run_has_its_stages_and_facts(tmp_path: Path) -> None:
    with policy() as (server, url):
        options = {"grpc": {"url": url, "policy_type": "act", "pretrained": "me/act"}}
        few: dict[str, Any] = {"requests": 4, "warmup": 1, "launches": 2, "state": 2, "sample_resources_hz": 0}
        config = LatencyConfig(
            transports=("loopback", "grpc"), engine={"name": "echo"}, size=(64, 48), options=options, **few
        )
        run = read_run(run_latency(config, tmp_path, NullProgress()))
    assert len(server.policies) == 2  # a launch has a client of its own
    assert run.samples.groupby("launch").size().tolist() == [10, 10]
    (same,) = [each["message"] for each in run.manifest["warnings"] if each["code"] == "same-server"]
    assert same.startswith("the server of grpc/lerobot ran on")
    assert (run.samples["error"] == "").all()
    assert {"pickle_pack": "pack", "send": "network", "pickle_parse": "parse"}.items() <= dict(run.stages).items()
    assert {"payload_bytes", "payload_down_bytes", "get_actions_ms"} <= set(run.manifest["facts"])
