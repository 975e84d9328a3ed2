"""GR00T's protocol: our server for anybody's clients, our client for anybody's servers."""

from __future__ import annotations

import asyncio
import io
import json
import warnings
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, contextmanager
from dataclasses import replace
from pathlib import Path
from threading import Event, Thread
from typing import Any

import msgpack
import numpy as np
import pytest
import zmq

from s2a_bench.errors import RequestFailed, ServerDied, UsageError
from s2a_bench.experiments.latency.config import LatencyConfig
from s2a_bench.experiments.latency.run import run_latency
from s2a_bench.frames.convert import yuyv_to_rgb
from s2a_bench.plugins.policy_servers.zmq.server import ZmqExchange
from s2a_bench.store.run import read_run
from s2a_bench.testing import NullProgress
from s2a_bench.testing.transport import RecordingHandler, ask, served, wiring_of, yuyv_frame
from s2a_bench.trace import Trace, budget
from s2a_bench.transport import Client, Handler, Server, open_client
from s2a_bench.transport.limits import Limits
from s2a_bench.transport.pipeline import one_pipeline
from s2a_bench.transport.serving import Core
from s2a_bench.types import Request
from tests.transport.test_every_server import Gate
from tests.waiting import until

CHUNK = np.arange(12, dtype=np.float32).reshape(4, 3) / 8
KEY = "s3cret-robot-key"
TASK = "annotation.human.task_description"


@contextmanager
def serving(handler: Handler, limits: Limits | None = None, **options: Any) -> Iterator[Server]:
    wiring = wiring_of("zmq/gr00t", **options)
    with served(replace(wiring, limits=limits or wiring.limits), handler) as (server, _):
        yield server


def robot(server: str, timeout_s: float = 20, **more: Any) -> closing[Client]:
    """Our own client."""
    return closing(open_client(wiring_of("zmq/gr00t", server, timeout_s=timeout_s, **more)))


def encoded(value: Any) -> Any:
    """GR00T's encoding of arrays, word for word as its sources have it."""
    if isinstance(value, np.ndarray):
        output = io.BytesIO()
        np.save(output, value, allow_pickle=False)
        return {"__ndarray_class__": True, "as_npy": output.getvalue()}
    return value


def decoded(value: Any) -> Any:
    return np.load(io.BytesIO(value["as_npy"]), allow_pickle=False) if "__ndarray_class__" in value else value


def mapped(peer: Any) -> dict[str, Callable[..., Any]]:
    """Packing and reading of msgpack-numpy, as N1.7 has them."""
    return {"packb": peer.packb, "unpackb": peer.unpackb}


FILES: dict[str, Callable[..., Any]] = {
    "packb": lambda value: msgpack.packb(value, default=encoded),
    "unpackb": lambda data: msgpack.unpackb(data, object_hook=decoded),
}
"""Those of N1.5 and N1.6."""


@contextmanager
def plain(
    address: str, packb: Any = FILES["packb"], unpackb: Any = FILES["unpackb"], name: bytes = b""
) -> Iterator[Callable[..., Any]]:
    """A client as GR00T's: a REQ socket, one endpoint a call."""
    context = zmq.Context()
    peer = context.socket(zmq.REQ)
    if name:
        peer.identity, peer.reconnect_ivl = name, -1
    peer.rcvtimeo, peer.linger = 20_000, 0
    peer.connect(address)

    def call(endpoint: str, data: Any = None, **fields: Any) -> Any:
        peer.send(packb({"endpoint": endpoint, "data": data, **fields}))
        return unpackb(peer.recv())

    try:
        yield call
    finally:
        context.destroy(0)


@contextmanager
def policy(
    answers: Callable[[Any], Any], packb: Any = FILES["packb"], unpackb: Any = FILES["unpackb"]
) -> Iterator[str]:
    """A server as GR00T's: a REP socket, one request after the other; bytes are sent as they are, None ends it."""
    context, over = zmq.Context(), Event()
    peer = context.socket(zmq.REP)
    peer.rcvtimeo, peer.linger = 50, 0
    port = peer.bind_to_random_port("tcp://127.0.0.1")

    def serve() -> None:
        while not over.is_set():
            try:
                request = unpackb(peer.recv())
            except zmq.Again:
                continue
            answer = answers(request)
            if answer is None:
                break
            peer.send(answer if isinstance(answer, bytes) else packb(answer))
        peer.close()

    thread = Thread(target=serve)
    thread.start()
    try:
        yield f"tcp://127.0.0.1:{port}"
    finally:
        over.set()
        thread.join()
        context.destroy(0)


def flat(frames: int = 1, batched: bool = False) -> dict[str, Any]:
    video, state = np.full((frames, 48, 64, 3), 7, np.uint8), np.arange(5, dtype=np.float64)[np.newaxis]
    whole = {"video.front": video, "state.single_arm": state, "state.gripper": np.array([[0.5]])}
    return {**{key: each[np.newaxis] if batched else each for key, each in whole.items()}, TASK: ["pick it up"]}


def nested() -> dict[str, Any]:
    """An observation in the layout of N1.6 and N1.7."""
    return {
        "video": {"front": np.zeros((1, 2, 48, 64, 3), np.uint8), "wrist": np.ones((1, 1, 32, 32, 3), np.uint8)},
        "state": {"arm": np.zeros((1, 1, 5), np.float32)},
        "language": {TASK: [["pick it up"]]},
    }


@pytest.fixture
def peer() -> Any:
    return pytest.importorskip("msgpack_numpy")


@pytest.fixture
def strands() -> Any:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # it misses the robots that it is for
        return pytest.importorskip("strands_robots.policies.groot")


class TestClientsOfOthers:
    def test_the_client_of_strands_robots_is_answered_and_its_policy_moves_a_robot(self, strands: Any) -> None:
        joints = [f"joint_{number}" for number in range(6)]
        handler = RecordingHandler(list(np.arange(12, dtype=np.float32).reshape(2, 6)))
        with serving(handler) as server:
            theirs = strands.Gr00tPolicy("so100", "127.0.0.1", int(server.address.rpartition(":")[2]))
            assert theirs.client.ping()
            answer = theirs.client.get_action(flat())
            theirs.set_robot_state_keys(joints)
            seen = {"webcam": np.zeros((48, 64, 3), np.uint8), **dict.fromkeys(joints, 0.25)}
            moves = asyncio.run(theirs.get_actions(seen, "go home"))
            theirs.client.__del__()
        np.testing.assert_array_equal(answer["action.robot"], handler.answer)
        first, second = handler.requests
        assert (first.prompt, first.state) == ("pick it up", (0.0, 1.0, 2.0, 3.0, 4.0, 0.5))
        assert [image.data.shape for image in first.images] == [(48, 64, 3)]
        assert (first.images[0].data == 7).all()
        assert [list(move.values()) for move in moves] == [[0, 1, 2, 3, 4, 5], [6, 7, 8, 9, 10, 11]]
        assert (second.prompt, second.state) == ("go home", (0.25,) * 6)

    def test_n1_5_is_answered_flat_with_a_batch_where_it_has_one(self) -> None:
        with serving(RecordingHandler(list(CHUNK))) as server, plain(server.address) as call:
            for frames, batched in ((1, False), (2, True)):
                answer = call("get_action", flat(frames, batched))
                assert list(answer) == ["action.robot"]
                assert answer["action.robot"].shape == ((1, 4, 3) if batched else (4, 3))

    @pytest.mark.parametrize("codec", ["files", "maps"])
    def test_n1_6_and_n1_7_are_answered_with_a_list_each_in_its_own_codec(self, codec: str, peer: Any) -> None:
        handler = RecordingHandler(list(CHUNK))
        with serving(handler) as server, plain(server.address, **FILES if codec == "files" else mapped(peer)) as call:
            actions, info = call("get_action", {"observation": nested(), "options": {"words": "not the prompt"}})
        assert info == {}
        np.testing.assert_array_equal(actions["robot"], CHUNK[np.newaxis])
        (got,) = handler.requests
        assert (got.prompt, got.state) == ("pick it up", (0.0,) * 5)
        assert [image.data.shape for image in got.images] == [(48, 64, 3), (48, 64, 3), (32, 32, 3)]

    def test_other_endpoints_answer_as_gr00ts(self) -> None:
        with serving(RecordingHandler([])) as server, plain(server.address) as call:
            assert call("ping") == {"status": "ok", "message": "Server is running"}
            assert call("reset", {"options": None}) == {}
            assert "Unknown endpoint: 'dance'" in call("dance")["error"]
            assert "stop its process" in call("kill")["error"]
            configs = call("get_modality_config")
        assert set(configs) == {"video", "state", "action", "language"}
        assert configs["language"]["as_json"]["modality_keys"] == [TASK]

    @pytest.mark.parametrize(
        ("layout", "marks", "key"),
        [
            ("auto", ["__ModalityConfig_class__", "__ModalityConfig__"], "ego_view"),
            ("n1.5", ["__ModalityConfig_class__"], "video.ego_view"),
            ("n1.6", ["__ModalityConfig_class__"], "ego_view"),
            ("n1.7", ["__ModalityConfig__"], "ego_view"),
        ],
    )
    def test_its_modalities_have_the_marks_of_its_layout(self, layout: str, marks: list[str], key: str) -> None:
        with serving(RecordingHandler([]), layout=layout) as server, plain(server.address) as call:
            configs = call("get_modality_config")
        assert {tuple(config) for config in configs.values()} == {(*marks, "s2a-bench", "as_json")}
        video = configs["video"]["as_json"]
        assert (json.loads(video) if layout == "n1.5" else video)["modality_keys"] == [key]

    @pytest.mark.parametrize("more", [{}, {"s2a": {"id": "mine"}}])
    def test_marks_follow_the_chunk_for_who_sends_an_extension_alone(self, more: dict[str, Any]) -> None:
        sent: list[bytes] = []
        request = {"endpoint": "get_action", "data": flat(), **more}
        exchange = ZmqExchange(lambda message: sent.append(bytes(message)), request, Trace(), Limits(), maps=False)
        Core(RecordingHandler(list(CHUNK)), Limits()).answer(exchange)
        assert sent[0] == FILES["packb"]({"action.robot": CHUNK})
        assert [len(FILES["unpackb"](each)["s2a"]["token_ns"]) for each in sent[1:]] == [len(CHUNK)] * len(more)


class TestServer:
    def test_it_answers_others_while_a_request_is_under_way(self) -> None:
        gate = Gate("zmq/gr00t")
        with serving(gate) as server, ExitStack() as stack:
            first, second = (stack.enter_context(plain(server.address)) for _ in range(2))
            answers: list[Any] = []
            asking = Thread(target=lambda: answers.append(first("get_action", flat())))
            asking.start()
            until(lambda: gate.began)
            assert second("ping")["status"] == "ok"
            gate.go.set()
            asking.join()
        np.testing.assert_array_equal(answers[0]["action.robot"], np.zeros((2, 2)))

    def test_without_its_key_nothing_is_told(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setenv("ROBOT_KEY", KEY)
        handler = RecordingHandler(list(CHUNK))
        with serving(handler, api_key_env="ROBOT_KEY") as server, plain(server.address) as call:
            for wrong in ({}, {"api_token": "wrong"}, {"api_token": None}, {"api_token": [KEY]}):
                for endpoint in ("ping", "get_action", "get_modality_config", "kill"):
                    assert "Unauthorized" in call(endpoint, flat(), **wrong)["error"]
            assert call("ping", api_token=KEY)["status"] == "ok"
        assert handler.requests == []


class TestBlackBox:
    @pytest.mark.parametrize("layout", ["n1.5", "n1.6", "n1.7"])
    def test_a_foreign_policy_is_told_what_the_template_says(self, layout: str, peer: Any) -> None:
        requests: list[Any] = []

        def answers(request: Any) -> Any:
            requests.append(request)
            arm, gripper = CHUNK[:, :2].astype(np.float64), CHUNK[:, 2:].astype(np.float64)
            if layout == "n1.5":
                return {"action.arm": arm, "action.gripper": gripper[:, 0]}
            return [{"arm": arm[np.newaxis], "gripper": gripper[np.newaxis]}, {"seconds": 1.0}]

        frame = yuyv_frame(seed=4)
        codec = mapped(peer) if layout == "n1.7" else FILES
        with policy(answers, **codec) as url, robot("", url=url, layout=layout) as client:
            actions, trace = ask(client, Request("a", "pick it up", (frame,), state=(0.5, 1.5)))
        np.testing.assert_array_equal(np.stack([action.values for action in actions]), CHUNK)  # type: ignore[union-attr]
        (request,) = requests
        assert set(request) == {"endpoint", "data"}
        data = request["data"]
        if layout == "n1.5":
            picture, state, words = data["video.ego_view"], data["state.robot"], data[TASK]
            assert (picture.shape, state.shape, words) == ((1, 48, 64, 3), (1, 2), ["pick it up"])
        else:
            seen = data["observation"]
            picture, state, words = seen["video"]["ego_view"], seen["state"]["robot"], seen["language"][TASK]
            assert (picture.shape, state.shape, words) == ((1, 1, 48, 64, 3), (1, 1, 2), [["pick it up"]])
        np.testing.assert_array_equal(picture.reshape(48, 64, 3), yuyv_to_rgb(frame.data))
        assert state.dtype == np.float32
        spent = budget(trace.chain())
        assert trace.chain()[-1][0] == "server"
        assert {"convert", "msgpack_pack", "server"} <= set(spent.stages_ns)

    def test_an_error_is_told_and_the_next_request_goes_on(self) -> None:
        answers = iter([{"error": "no such\nrobot"}, b"ERROR", [{"robot": CHUNK[np.newaxis]}, {}]])
        with policy(lambda _: next(answers)) as url, robot("", url=url, layout="n1.6") as client:
            with pytest.raises(RequestFailed, match="no such robot"):
                ask(client, Request("a", "go"))
            with pytest.raises(RequestFailed, match="another kind of policy"):
                ask(client, Request("a", "go"))
            assert len(ask(client, Request("a", "go"))[0]) == 4

    def test_the_same_client_connects_anew_after_a_failure(self) -> None:
        calls: list[int] = []
        given_up = Event()

        def answers(_: Any) -> Any:
            calls.append(len(calls))
            if len(calls) == 1:
                given_up.wait(20)
            return [{"robot": (CHUNK + calls[-1])[np.newaxis]}, {}]

        with policy(answers) as url, robot("", url=url, layout="n1.6", timeout_s=1) as client:
            with pytest.raises(RequestFailed, match="silent"):
                ask(client, Request("a", "go"))
            given_up.set()
            actions, trace = ask(client, Request("b", "go"))
        np.testing.assert_array_equal(actions[0].values, CHUNK[0] + 1)  # type: ignore[union-attr]
        assert trace.facts["reconnects"] == 1.0
        assert "connect" in dict(trace.chain())

    @pytest.mark.parametrize("layout", ["auto", "n1.6"])
    def test_nothing_there_is_told_at_once(self, layout: str) -> None:
        with (
            pytest.raises(ServerDied, match="nothing answers at tcp"),
            robot("", url="tcp://127.0.0.1:1", layout=layout, timeout_s=60) as client,
        ):
            ask(client, Request("a", "go"))

    def test_a_server_of_another_protocol_is_told_within_the_time_out(self) -> None:
        with served(wiring_of("http"), RecordingHandler(["go"])) as (server, _):
            url = server.address.replace("http:", "tcp:")
            with (
                pytest.raises(RequestFailed, match="is it a ZeroMQ peer"),
                robot("", url=url, timeout_s=0.5) as client,
            ):
                ask(client, Request("a", "go"))

    @pytest.mark.parametrize(("dies", "error"), [(False, "broke the connection"), (True, "has ended")])
    def test_a_server_that_goes_is_told_at_once(self, dies: bool, error: str) -> None:
        dead = Event()
        with (
            policy(lambda _: dead.set() if dies else None) as url,
            closing(open_client(wiring_of("zmq/gr00t", url, timeout_s=3000), lambda: not dead.is_set())) as client,
            pytest.raises((RequestFailed, ServerDied), match=error),
        ):
            ask(client, Request("a", "go"))

    def test_a_server_that_is_started_anew_is_connected_to_anew(self) -> None:
        with serving(RecordingHandler(list(CHUNK))) as server, robot(server.address) as client:
            ask(client, Request("a", "go"))
            server.stop()
            until(lambda: not client._connection.stands())  # type: ignore[attr-defined]
            with served(wiring_of("zmq/gr00t", server.address.partition("//")[2]), RecordingHandler(list(CHUNK))):
                actions, trace = ask(client, Request("b", "go"))
        assert len(actions) == len(CHUNK)
        assert trace.facts["reconnects"] == 1.0

    @pytest.mark.parametrize("url", ["http://a:1", "tcp://a", "tcp://a:1/x", "tcp://u:p@a:1"])
    def test_other_urls_are_refused(self, url: str) -> None:
        with pytest.raises(UsageError, match="`url`"):
            one_pipeline("zmq", url=url)


def configs(mark: str) -> dict[str, Any]:
    return {"video": {mark: True, "as_json": {"delta_indices": [0], "modality_keys": ["ego_view"]}}}


class Policy:
    """What a policy server does, and what it was sent."""

    def __init__(self, answer: Any) -> None:
        self.answer, self.requests = answer, list[Any]()

    def __call__(self, request: Any) -> Any:
        self.requests.append(request)
        if request["endpoint"] != "get_action":
            return self.answer if request["endpoint"] == "get_modality_config" else {"status": "ok"}
        (picture,) = request["data"]["observation"]["video"].values()
        if not isinstance(picture, np.ndarray):
            return {"error": f"must be a numpy array. Got {type(picture)}"}
        return [{"robot": CHUNK[np.newaxis]}, {}]

    @property
    def endpoints(self) -> list[str]:
        return [request["endpoint"] for request in self.requests]


class TestLayoutOfAServer:
    """The layout `auto`."""

    def test_n1_7s_configurations_have_its_arrays_sent(self, peer: Any) -> None:
        answers = Policy(configs("__ModalityConfig__"))
        with policy(answers, **mapped(peer)) as url, robot("", url=url) as client:
            assert client.describe() == {"url": url, "template": "gr00t-n1.6", "layout": "n1.7"}
            for number in range(2):
                ask(client, Request(f"{number}", "go", (yuyv_frame(),)))
        assert answers.endpoints == ["get_modality_config", "get_action", "get_action"]

    @pytest.mark.parametrize("answer", [configs("__ModalityConfig_class__"), {"error": "Unknown endpoint"}, [1]])
    def test_all_others_have_n1_6s_sent(self, answer: Any) -> None:
        answers = Policy(answer)
        with policy(answers) as url, robot("", url=url) as client:
            assert client.describe()["layout"] == "n1.6"
            ask(client, Request("a", "go", (yuyv_frame(),)))
        assert answers.endpoints == ["get_modality_config", "get_action"]

    def test_n1_5s_configurations_are_text_and_its_observations_flat(self) -> None:
        keys = {"video": ["video.front"], "state": ["state.single_arm", "state.gripper"], "language": [TASK]}
        seen: list[Any] = []

        def answers(request: Any) -> Any:
            """As gr00t/eval/service.py of NVIDIA/Isaac-GR00T at 0a015f63 and model/policy.py at 16c4f7b3."""
            if request["endpoint"] == "get_modality_config":
                told = {name: {"delta_indices": [0], "modality_keys": each} for name, each in keys.items()}
                return {name: {"__ModalityConfig_class__": True, "as_json": json.dumps(told[name])} for name in told}
            seen.append({key: np.shape(request["data"][key]) for each in keys.values() for key in each})
            return {"action.single_arm": CHUNK[:, :2], "action.gripper": CHUNK[:, 2]}

        with policy(answers) as url, robot("", url=url) as client:
            assert client.describe() == {"url": url, "template": "get_modality_config", "layout": "n1.5"}
            actions, _ = ask(client, numbered(6, 1))
        np.testing.assert_array_equal(np.stack([action.values for action in actions]), CHUNK)  # type: ignore[union-attr]
        assert seen == [
            {"video.front": (1, 48, 64, 3), "state.single_arm": (1, 5), "state.gripper": (1, 1), TASK: (1,)}
        ]

    def test_the_key_goes_with_it(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setenv("ROBOT_KEY", KEY)
        with policy(answers := Policy({})) as url, robot("", url=url, api_key_env="ROBOT_KEY"):
            assert answers.requests == [{"endpoint": "get_modality_config", "api_token": KEY}]

    @pytest.mark.parametrize(
        ("layout", "found"), [("auto", "n1.6"), ("n1.5", "n1.5"), ("n1.6", "n1.6"), ("n1.7", "n1.7")]
    )
    def test_our_own_server_tells_its_layout(self, layout: str, found: str) -> None:
        handler = RecordingHandler(list(CHUNK))
        with serving(handler, layout=layout) as server, robot("", url=server.address) as client:
            assert client.describe()["layout"] == found
            ask(client, Request("a", "go", (yuyv_frame(),)))
            with robot(server.address) as own:
                assert own.describe()["layout"] == "n1.6"
                ask(own, Request("b", "go", (yuyv_frame(),)))
        assert [request.images[0].data.shape for request in handler.requests] == [(48, 64, 3)] * 2

    def test_a_run_records_it_and_no_sample_waits_for_it(self, peer: Any, tmp_path: Path) -> None:
        answers = Policy(configs("__ModalityConfig__"))
        with policy(answers, **mapped(peer)) as url:
            config = LatencyConfig(transports=(f"zmq?url={url}",), requests=2, warmup=0, size=(64, 48))
            run = read_run(run_latency(config, tmp_path, NullProgress()))
        assert run.manifest["asked"] == {
            f"zmq/gr00t?url={url}": {"url": url, "template": "gr00t-n1.6", "layout": "n1.7"}
        }
        assert answers.endpoints == ["get_modality_config", "get_action", "get_action"]
        assert run.samples["error"].isna().all() or set(run.samples["error"]) == {""}


def droid(*state: str, steps: int) -> tuple[tuple[str, ...], int, tuple[str, ...], str]:
    cameras = ("exterior_image_1_left", "wrist_image_left")
    return cameras, steps, state, "annotation.language.language_instruction"


EMBODIMENTS = {
    "unitree_g1": (
        ("ego_view",),
        1,
        ("left_leg", "right_leg", "waist", "left_arm", "right_arm", "left_hand", "right_hand"),
        "annotation.human.task_description",
    ),
    "libero_panda": (
        ("image", "wrist_image"),
        1,
        ("x", "y", "z", "roll", "pitch", "yaw", "gripper"),
        "annotation.human.action.task_description",
    ),
    "oxe_droid": droid("joint_position", "gripper_position", steps=1),
    "two unknown": droid("eef_position", "eef_rotation", steps=1),
    "oxe_droid of N1.7": droid("eef_9d", "gripper_position", "joint_position", steps=2),
}
"""Cameras, pictures of each, parts of the state, key of the prompt: NVIDIA/Isaac-GR00T,
gr00t/configs/data/embodiment_configs.py at d3c0e4d3, examples/DROID at be889e7a."""


class Embodied:
    """A policy server that checks an observation as NVIDIA/Isaac-GR00T does, gr00t/policy/gr00t_policy.py be889e7a."""

    def __init__(self, name: str, layout: str, widths: tuple[int, ...] = ()) -> None:
        cameras, steps, parts, self.words = EMBODIMENTS[name]
        self.cameras, self.steps, self.widths = cameras, steps, dict(zip(parts, widths, strict=False))
        self.seen: Any = None
        mark = {"n1.6": "__ModalityConfig_class__", "n1.7": "__ModalityConfig__"}[layout]
        told = {"video": (steps, cameras), "state": (1, parts), "action": (16, parts), "language": (1, [self.words])}
        rest = dict.fromkeys(("sin_cos_embedding_keys", "mean_std_embedding_keys", "action_configs"))
        self.configs = {
            modality: {mark: True, "as_json": {"delta_indices": [*range(n)], "modality_keys": [*keys], **rest}}
            for modality, (n, keys) in told.items()
        }

    def __call__(self, request: Any) -> Any:
        if request["endpoint"] == "get_modality_config":
            return self.configs
        self.seen = seen = request["data"]["observation"]
        try:
            assert seen.keys() == {"video", "state", "language"}
            for key in self.cameras:
                picture = seen["video"][key]
                assert picture.dtype == np.uint8
                assert (picture.ndim, picture.shape[:2], picture.shape[-1]) == (5, (1, self.steps), 3)
            for key, width in self.widths.items():
                assert seen["state"][key].dtype == np.float32
                assert seen["state"][key].shape == (1, 1, width)
            assert seen["language"][self.words] == [["go"]]
        except (AssertionError, KeyError) as error:
            return {"error": f"{type(error).__name__} {error}"}
        return [{"robot": CHUNK[np.newaxis]}, {}]


def numbered(count: int, cameras: int) -> Request:
    frames = tuple(yuyv_frame(seed=each) for each in range(cameras))
    return Request("a", "go", frames, state=tuple(map(float, range(count))))


class TestEmbodiments:
    """What a server's configurations tell, without a template."""

    @pytest.mark.parametrize(
        ("name", "layout", "widths"),
        [
            ("unitree_g1", "n1.6", (6, 6, 3, 7, 7, 7, 7)),
            ("unitree_g1", "n1.7", (6, 6, 3, 7, 7, 1, 1)),
            ("libero_panda", "n1.6", (1, 1, 1, 1, 1, 1, 2)),
            ("oxe_droid", "n1.6", (7, 1)),
            ("oxe_droid of N1.7", "n1.7", (9, 1, 7)),
        ],
    )
    def test_an_embodiment_needs_no_template(self, name: str, layout: str, widths: tuple[int, ...], peer: Any) -> None:
        server = Embodied(name, layout, widths)
        request = numbered(sum(widths), len(server.cameras))
        with policy(server, **mapped(peer) if layout == "n1.7" else FILES) as url, robot("", url=url) as client:
            assert client.describe()["template"] == "get_modality_config"
            for _ in "ab":
                assert len(ask(client, request)[0]) == 4
        np.testing.assert_array_equal(
            np.concatenate([part[0, 0] for part in server.seen["state"].values()]), request.state
        )
        for picture, frame in zip(server.seen["video"].values(), request.images, strict=True):
            for each in picture[0]:
                np.testing.assert_array_equal(each, yuyv_to_rgb(frame.data))

    @pytest.mark.parametrize("key", ["s2a", "wrist?", "many"])
    def test_keys_that_no_template_can_have_leave_the_default(self, key: str) -> None:
        server = Embodied("libero_panda", "n1.6")
        told = server.configs["video"]["as_json"]
        told |= {"delta_indices": [*range(2000)]} if key == "many" else {"modality_keys": [key]}
        with policy(server) as url, robot("", url=url) as client:
            assert client.describe()["template"] == "gr00t-n1.6"

    @pytest.mark.parametrize(
        ("name", "state", "cameras", "why"),
        [
            (
                "libero_panda",
                8,
                1,
                r"get_modality_config: video\.wrist_image.* wants 2 pictures, and the request has 1$",
            ),
            ("libero_panda", 8, 3, "get_modality_config has places for 2 pictures, not 3$"),
            ("libero_panda", 6, 2, r"x \(1\), .* gripper \(\?\), not 6 numbers; change `state`, or give `template`$"),
            ("oxe_droid", 0, 2, r"joint_position \(\?\), gripper_position \(1\), not 0 numbers"),
            ("two unknown", 9, 1, r"eef_position \(\?\), eef_rotation \(\?\), not 9 numbers; give `template`$"),
        ],
    )
    def test_what_does_not_fit_is_told(self, name: str, state: int, cameras: int, why: str) -> None:
        with (
            policy(Embodied(name, "n1.6")) as url,
            robot("", url=url) as client,
            pytest.raises(RequestFailed, match=why),
        ):
            ask(client, numbered(state, cameras))

    def test_a_template_goes_first(self) -> None:
        server = Embodied("unitree_g1", "n1.6")
        with policy(server) as url, robot("", url=url, template="gr00t-so100") as client:
            assert client.describe()["template"] == "gr00t-so100"
            with pytest.raises(RequestFailed, match="KeyError 'ego_view'"):
                ask(client, numbered(6, 2))
        shapes = {key: part.shape for key, part in server.seen["state"].items()}
        assert shapes == {"single_arm": (1, 1, 5), "gripper": (1, 1, 1)}


def test_a_client_that_comes_again_takes_its_place() -> None:
    """As one whose machine lost its power, and which the server still takes to be there."""
    with serving(RecordingHandler(CHUNK)) as server, plain(server.address, name=b"arm") as lost:
        answer = lost("ping")
        with plain(server.address, name=b"arm") as again:
            assert again("ping") == answer


def test_it_carries_actions_and_state_alone() -> None:
    pipeline = one_pipeline("zmq")
    assert pipeline.capabilities.answer_kinds == ("actions",)
    assert pipeline.capabilities.accepts_state
    assert one_pipeline("zmq", url="tcp://127.0.0.1:1").capabilities.payloads == ("raw",)
