"""GR00T's protocol: our server for anybody's clients, our client for anybody's servers."""

from __future__ import annotations

import asyncio
import io
import json
import warnings
from collections.abc import Callable, Generator, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from threading import Event, Thread
from typing import Any

import msgpack
import numpy as np
import pytest
import zmq

from s2a_bench.clock import now_ns
from s2a_bench.errors import PortInUse, RequestFailed, ServerDied, UsageError
from s2a_bench.frames.convert import yuyv_to_rgb
from s2a_bench.testing.transport import Recorder, ask, served, wiring, yuyv_frame
from s2a_bench.trace import Trace, budget
from s2a_bench.transport import Client, Handler, Server, open_client, open_server
from s2a_bench.transport.dangers import examine
from s2a_bench.transport.limits import Limits
from s2a_bench.transport.pipeline import one_pipeline
from s2a_bench.transport.zmq.watch import Watch
from s2a_bench.types import Action, Piece, Request

CHUNK = np.arange(12, dtype=np.float32).reshape(4, 3) / 8
KEY = "s3cret-robot-key"
TASK = "annotation.human.task_description"


@contextmanager
def serving(handler: Handler, limits: Limits | None = None, **options: Any) -> Iterator[Server]:
    told = wiring("zmq/gr00t", **options)
    with served(replace(told, limits=limits or told.limits), handler) as (server, _):
        yield server


@contextmanager
def robot(server: str, **more: Any) -> Iterator[Client]:
    """Our own client."""
    timeout_s = more.pop("timeout_s", 20)
    client = open_client(wiring("zmq/gr00t", server, timeout_s=timeout_s, **more))
    try:
        yield client
    finally:
        client.close()


def encoded(value: Any) -> Any:
    """GR00T's encoding of arrays, word for word as its sources have it."""
    if isinstance(value, np.ndarray):
        output = io.BytesIO()
        np.save(output, value, allow_pickle=False)
        return {"__ndarray_class__": True, "as_npy": output.getvalue()}
    return value


def decoded(value: Any) -> Any:
    return np.load(io.BytesIO(value["as_npy"]), allow_pickle=False) if "__ndarray_class__" in value else value


@contextmanager
def plain(address: str) -> Iterator[Callable[..., Any]]:
    """A client as GR00T's: a REQ socket, one endpoint a call."""
    context = zmq.Context()
    peer = context.socket(zmq.REQ)
    peer.rcvtimeo, peer.linger = 20_000, 0
    peer.connect(address)

    def call(endpoint: str, data: Any = None, **fields: Any) -> Any:
        peer.send(msgpack.packb({"endpoint": endpoint, "data": data, **fields}, default=encoded))
        return msgpack.unpackb(peer.recv(), object_hook=decoded)

    try:
        yield call
    finally:
        context.destroy(0)


@contextmanager
def policy(answers: Callable[[Any], Any]) -> Iterator[str]:
    """A server as GR00T's: a REP socket, one request after the other; bytes and None are sent as they are, or not."""
    context, over = zmq.Context(), Event()
    peer = context.socket(zmq.REP)
    peer.rcvtimeo, peer.linger = 50, 0
    port = peer.bind_to_random_port("tcp://127.0.0.1")

    def serve() -> None:
        while not over.is_set():
            try:
                request = msgpack.unpackb(peer.recv(), object_hook=decoded)
            except zmq.Again:
                continue
            answer = answers(request)
            if answer is None:
                return
            peer.send(answer if isinstance(answer, bytes) else msgpack.packb(answer, default=encoded))

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


class Held:
    """An engine that answers when it is let."""

    def __init__(self) -> None:
        self.begun, self.let = Event(), Event()
        self.ids: list[str] = []

    def __call__(self, request: Request, trace: Trace) -> Generator[Piece, None, None]:
        self.ids.append(request.id)
        self.begun.set()
        assert self.let.wait(20)
        now = now_ns()
        trace.marks.append(("inference", now))
        trace.token_ns.append(now)
        yield Action(0, CHUNK[0])


def until(met: Callable[[], bool]) -> None:
    deadline = now_ns() + 20_000_000_000
    while not met():
        assert now_ns() < deadline
        Event().wait(0.005)


@pytest.fixture
def strands() -> Any:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # it misses the robots that it is for
        return pytest.importorskip("strands_robots.policies.groot")


class TestClientsOfOthers:
    def test_the_client_of_strands_robots_is_answered(self, strands: Any) -> None:
        handler = Recorder(list(CHUNK))
        with serving(handler) as server:
            client = strands.GR00TClient("127.0.0.1", int(server.address.rpartition(":")[2]))
            assert client.ping()
            answer = client.get_action(flat())
            client.__del__()
        np.testing.assert_array_equal(answer["action.robot"], CHUNK)
        (got,) = handler.requests
        assert got.prompt == "pick it up"
        assert got.state == (0.0, 1.0, 2.0, 3.0, 4.0, 0.5)
        assert [image.data.shape for image in got.images] == [(48, 64, 3)]
        assert (got.images[0].data == 7).all()

    def test_its_policy_moves_a_robot_by_our_answers(self, strands: Any) -> None:
        joints = [f"joint_{number}" for number in range(6)]
        handler = Recorder(list(np.arange(12, dtype=np.float32).reshape(2, 6)))
        with serving(handler) as server:
            theirs = strands.Gr00tPolicy("so100", "127.0.0.1", int(server.address.rpartition(":")[2]))
            theirs.set_robot_state_keys(joints)
            seen = {"webcam": np.zeros((48, 64, 3), np.uint8), **dict.fromkeys(joints, 0.25)}
            moves = asyncio.run(theirs.get_actions(seen, "go home"))
            theirs.client.__del__()
        assert [list(move.values()) for move in moves] == [[0, 1, 2, 3, 4, 5], [6, 7, 8, 9, 10, 11]]
        assert handler.requests[0].state == (0.25,) * 6
        assert handler.requests[0].prompt == "go home"

    def test_n1_5_is_answered_flat_with_a_batch_where_it_has_one(self) -> None:
        with serving(Recorder(list(CHUNK))) as server, plain(server.address) as call:
            for frames, batched in ((1, False), (2, True)):
                answer = call("get_action", flat(frames, batched))
                assert list(answer) == ["action.robot"]
                assert answer["action.robot"].shape == ((1, 4, 3) if batched else (4, 3))

    def test_n1_6_is_answered_with_a_list(self) -> None:
        handler = Recorder(list(CHUNK))
        observation = {
            "video": {"front": np.zeros((1, 2, 48, 64, 3), np.uint8), "wrist": np.ones((1, 1, 32, 32, 3), np.uint8)},
            "state": {"arm": np.zeros((1, 1, 5), np.float32)},
            "language": {TASK: [["pick it up"]]},
        }
        with serving(handler) as server, plain(server.address) as call:
            actions, info = call("get_action", {"observation": observation, "options": {"words": "not the prompt"}})
        assert info == {}
        np.testing.assert_array_equal(actions["robot"], CHUNK[np.newaxis])
        (got,) = handler.requests
        assert (got.prompt, got.state) == ("pick it up", (0.0,) * 5)
        assert [image.data.shape for image in got.images] == [(48, 64, 3), (48, 64, 3), (32, 32, 3)]

    def test_other_endpoints_answer_as_gr00ts(self) -> None:
        with serving(Recorder([])) as server, plain(server.address) as call:
            assert call("ping") == {"status": "ok", "message": "Server is running"}
            assert call("reset", {"options": None}) == {}
            assert "Unknown endpoint: 'dance'" in call("dance")["error"]
            configs = call("get_modality_config")
        assert set(configs) == {"video", "state", "action", "language"}
        assert configs["language"]["as_json"]["modality_keys"] == [TASK]

    def test_n1_5s_modalities_are_json(self) -> None:
        with serving(Recorder([]), layout="n1.5") as server, plain(server.address) as call:
            video = call("get_modality_config")["video"]
        assert json.loads(video["as_json"]) == {"delta_indices": [0], "modality_keys": ["video.ego_view"]}

    def test_nobody_ends_the_server_over_the_network(self) -> None:
        with serving(Recorder([])) as server, plain(server.address) as call:
            assert "stop its process" in call("kill")["error"]
            assert call("ping")["status"] == "ok"

    def test_an_engine_of_tokens_is_refused_in_a_line(self) -> None:
        with serving(Recorder(["go"])) as server, plain(server.address) as call:
            assert "choose `answer` actions" in call("get_action", flat())["error"]

    def test_marks_are_for_who_said_an_id_and_once(self) -> None:
        with serving(Recorder(list(CHUNK))) as server, plain(server.address) as call:
            call("get_action", flat())
            assert "not known" in call("s2a_marks", s2a={"id": "observation-0"})["error"]
            call("get_action", flat(), s2a={"id": "mine"})
            assert len(call("s2a_marks", s2a={"id": "mine"})["s2a"]["token_ns"]) == 4
            assert "not known" in call("s2a_marks", s2a={"id": "mine"})["error"]
            with plain(server.address) as other:
                call("get_action", flat(), s2a={"id": "mine"})
                assert "not known" in other("s2a_marks", s2a={"id": "mine"})["error"]


class TestServer:
    def test_it_answers_others_while_a_request_is_under_way(self) -> None:
        held = Held()
        with serving(held) as server, ExitStack() as stack:
            first, second = (stack.enter_context(plain(server.address)) for _ in range(2))
            answers: list[Any] = []
            asking = Thread(target=lambda: answers.append(first("get_action", flat())))
            asking.start()
            assert held.begun.wait(20)
            assert second("ping")["status"] == "ok"
            held.let.set()
            asking.join()
        np.testing.assert_array_equal(answers[0]["action.robot"], CHUNK[:1])

    def test_who_goes_leaves_the_queue(self) -> None:
        held = Held()
        with serving(held, Limits(waiting=1)) as server, ExitStack() as stack:
            turns = server._office.queued.turns  # type: ignore[attr-defined]
            first, last = (stack.enter_context(plain(server.address)) for _ in range(2))
            asking = Thread(target=lambda: first("get_action", flat(), s2a={"id": "first"}))
            asking.start()
            assert held.begun.wait(20)
            for _ in range(5):  # each has the one place, until it goes
                context = zmq.Context()
                gone = context.socket(zmq.REQ)
                gone.connect(server.address)
                gone.send(msgpack.packb({"data": flat(), "s2a": {"id": "gone"}}, default=encoded))
                until(lambda: turns.waiting == 1)
                context.destroy(0)
                until(lambda: turns.waiting == 0)
            held.let.set()
            asking.join()
            assert "action.robot" in last("get_action", flat(), s2a={"id": "last"})
        assert held.ids == ["first", "last"]

    def test_requests_of_several_clients_are_all_answered(self) -> None:
        handler = Recorder(list(CHUNK))
        failed: list[Exception] = []

        def asks(address: str) -> None:
            try:
                with robot(address) as client:
                    for number in range(20):
                        assert len(ask(client, Request(f"{number}", "go", (yuyv_frame(),)))[0]) == 4
            except Exception as error:  # noqa: BLE001 - a finding
                failed.append(error)

        with serving(handler) as server:
            threads = [Thread(target=asks, args=(server.address,)) for _ in range(6)]
            for thread in threads:
                thread.start()
            for thread in threads:
                thread.join(60)
        assert failed == []
        assert len(handler.requests) == 120

    def test_a_full_queue_refuses(self) -> None:
        held = Held()
        with serving(held, Limits(waiting=0)) as server, ExitStack() as stack:
            first = stack.enter_context(plain(server.address))
            asking = Thread(target=lambda: first("get_action", flat()))
            asking.start()
            assert held.begun.wait(20)
            with robot(server.address) as client, pytest.raises(RequestFailed, match="waiting for the engine") as busy:
                ask(client, Request("a", "go"))
            held.let.set()
            asking.join()
        assert busy.value.retry_after_s == 1.0

    def test_a_request_that_waits_too_long_is_given_up(self) -> None:
        held = Held()
        with serving(held, Limits(answer_s=0.3)) as server, ExitStack() as stack:
            first, second = (stack.enter_context(plain(server.address)) for _ in range(2))
            asking = Thread(target=lambda: first("get_action", flat()))
            asking.start()
            assert held.begun.wait(20)
            assert "waiting for the engine" in second("get_action", flat())["error"]
            held.let.set()
            asking.join()

    def test_without_its_key_nothing_is_told(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setenv("ROBOT_KEY", KEY)
        handler = Recorder(list(CHUNK))
        with serving(handler, api_key_env="ROBOT_KEY") as server, plain(server.address) as call:
            for wrong in ({}, {"api_token": "wrong"}, {"api_token": None}, {"api_token": [KEY]}):
                for endpoint in ("ping", "get_action", "get_modality_config", "kill", "s2a_marks"):
                    assert "Unauthorized" in call(endpoint, flat(), **wrong)["error"]
            assert call("ping", api_token=KEY)["status"] == "ok"
            with robot(server.address, api_key_env="ROBOT_KEY") as client:
                assert len(ask(client, Request("a", "go", (yuyv_frame(),)))[0]) == 4
            with robot(server.address) as client, pytest.raises(RequestFailed, match="Unauthorized"):
                ask(client, Request("a", "go"))
        assert len(handler.requests) == 1

    def test_strangers_need_a_key(self) -> None:
        with pytest.raises(UsageError, match="`api_key_env`, or let everybody in with `no_auth`"):
            open_server(wiring("zmq/gr00t", "0.0.0.0:0"), Recorder([]))

    def test_a_port_in_use_is_told(self) -> None:
        with serving(Recorder([])) as server, pytest.raises(PortInUse, match="is in use"):
            open_server(wiring("zmq/gr00t", server.address), Recorder([]))


class TestWatch:
    def test_a_message_is_of_the_connection_that_has_the_descriptor_now(self) -> None:
        context = zmq.Context()
        router = context.socket(zmq.ROUTER)
        watch = Watch(router)
        port = router.bind_to_random_port("tcp://127.0.0.1")
        descriptors = []
        for _ in range(3):
            peer = context.socket(zmq.REQ)
            peer.connect(f"tcp://127.0.0.1:{port}")
            peer.send(b"go")
            descriptor = router.recv_multipart(copy=False)[-1].get(zmq.SRCFD)
            connection = watch.of(descriptor)
            watch.hear()
            assert not connection.gone
            descriptors.append(descriptor)
            watch.monitor.poll(0)
            peer.close(0)
            until(lambda: bool(watch.monitor.poll(1)))  # it has gone, and that is not heard yet
        watch.close()
        context.destroy(0)
        assert len(set(descriptors)) < 3

    def test_what_came_and_is_not_complete_is_counted(self) -> None:
        context = zmq.Context()
        router = context.socket(zmq.ROUTER)
        watch = Watch(router)
        port = router.bind_to_random_port("tcp://127.0.0.1")
        peer = context.socket(zmq.DEALER)
        peer.connect(f"tcp://127.0.0.1:{port}")
        for sizes in ((0, 10), (0, 255), (0, 256), (1, 1 << 20)):
            peer.send_multipart([bytes(size) for size in sizes])
            frames = router.recv_multipart(copy=False)
            connection = watch.of(frames[-1].get(zmq.SRCFD))
            connection.take([len(frame) for frame in frames[1:]])
            assert 0 < connection.look() < 200  # the greeting alone
        watch.close()
        context.destroy(0)


class TestBlackBox:
    @pytest.mark.parametrize("layout", ["n1.5", "n1.6"])
    def test_a_foreign_policy_is_told_what_the_template_says(self, layout: str) -> None:
        told: list[Any] = []

        def answers(request: Any) -> Any:
            told.append(request)
            arm, gripper = CHUNK[:, :2].astype(np.float64), CHUNK[:, 2:].astype(np.float64)
            if layout == "n1.5":
                return {"action.arm": arm, "action.gripper": gripper[:, 0]}
            return [{"arm": arm[np.newaxis], "gripper": gripper[np.newaxis]}, {"seconds": 1.0}]

        frame = yuyv_frame(seed=4)
        with policy(answers) as url, robot("", url=url, layout=layout) as client:
            actions, trace = ask(client, Request("a", "pick it up", (frame,), state=(0.5, 1.5)))
        np.testing.assert_array_equal(np.stack([action.values for action in actions]), CHUNK)  # type: ignore[union-attr]
        (request,) = told
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

    def test_a_template_of_ones_own(self) -> None:
        told: list[Any] = []

        def answers(request: Any) -> Any:
            told.append(request["data"]["observation"])
            return [{"robot": CHUNK[np.newaxis]}, {}]

        frames = (yuyv_frame(seed=1), yuyv_frame(seed=2))
        with policy(answers) as url, robot("", url=url, template="gr00t-so100") as client:
            ask(client, Request("a", "go", frames, state=(1, 2, 3, 4, 5, 6)))
            with pytest.raises(RequestFailed, match=r"video\.wrist.* wants picture 1"):
                ask(client, Request("a", "go", frames[:1], state=(1, 2, 3, 4, 5, 6)))
        assert {key: value.shape for key, value in told[0]["state"].items()} == {
            "single_arm": (1, 1, 5),
            "gripper": (1, 1, 1),
        }

    def test_an_error_is_told_and_the_next_request_goes_on(self) -> None:
        answers = iter([{"error": "no such\nrobot"}, b"ERROR", [{"robot": CHUNK[np.newaxis]}, {}]])
        with policy(lambda _: next(answers)) as url, robot("", url=url) as client:
            with pytest.raises(RequestFailed, match="no such robot"):
                ask(client, Request("a", "go"))
            with pytest.raises(RequestFailed, match="another kind of policy"):
                ask(client, Request("a", "go"))
            assert len(ask(client, Request("a", "go"))[0]) == 4

    def test_a_silent_server_is_given_up_and_the_socket_with_it(self) -> None:
        begun = Event()

        def answers(_: Any) -> Any:
            if begun.is_set():
                return [{"robot": CHUNK[np.newaxis]}, {}]
            begun.set()
            Event().wait(1.0)
            return [{"robot": np.zeros((1, 4, 3), np.float32)}, {}]  # nobody waits for it

        with policy(answers) as url:
            told = wiring("zmq/gr00t", url=url, timeout_s=0.5)
            client = open_client(told)
            with pytest.raises(RequestFailed, match=r"silent for too long: 0\.5 s"):
                ask(client, Request("a", "go"))
            client.close()
            with robot("", url=url) as patient:
                actions, trace = ask(patient, Request("a", "go"))
        np.testing.assert_array_equal(actions[1].values, CHUNK[1])  # type: ignore[union-attr]
        assert trace.facts.get("reconnects") is None

    def test_the_same_client_connects_anew_after_a_failure(self) -> None:
        calls: list[int] = []

        def answers(_: Any) -> Any:
            calls.append(len(calls))
            if len(calls) == 1:
                Event().wait(1.0)
            return [{"robot": (CHUNK + calls[-1])[np.newaxis]}, {}]

        with policy(answers) as url, robot("", url=url, timeout_s=0.7) as client:
            with pytest.raises(RequestFailed, match="silent"):
                ask(client, Request("a", "go"))
            Event().wait(0.5)
            actions, trace = ask(client, Request("b", "go"))
        np.testing.assert_array_equal(actions[0].values, CHUNK[0] + 1)  # type: ignore[union-attr]
        assert trace.facts["reconnects"] == 1.0
        assert "connect" in dict(trace.chain())

    def test_nothing_there_is_told_at_once(self) -> None:
        began = now_ns()
        with robot("", url="tcp://127.0.0.1:1") as client, pytest.raises(ServerDied, match="nothing answers at tcp"):
            ask(client, Request("a", "go"))
        assert now_ns() - began < 10e9

    def test_a_server_that_dies_is_told_at_once(self) -> None:
        alive = Event()
        alive.set()
        with policy(lambda _: None) as url:
            told = wiring("zmq/gr00t", url, timeout_s=30)
            client = open_client(told, alive.is_set)
            failed: list[Any] = []

            def asks() -> None:
                try:
                    ask(client, Request("a", "go"))
                except ServerDied as error:
                    failed.append(error)

            asking = Thread(target=asks)
            asking.start()
            alive.clear()
            asking.join(20)
            client.close()
        assert failed

    @pytest.mark.parametrize("url", ["http://a:1", "tcp://", "tcp://a", "tcp://a:1/x", "tcp://a:b", "tcp://u:p@a:1"])
    def test_other_urls_are_refused(self, url: str) -> None:
        with pytest.raises(UsageError, match="`url`"):
            one_pipeline("zmq", url=url)


class TestDangers:
    def test_who_answers_everybody_is_told_of_by_a_ping(self) -> None:
        told: list[Any] = []

        def answers(request: Any) -> Any:
            told.append(request)
            return {"status": "ok"}

        with policy(answers) as url:
            found = {finding.code: finding for finding in examine(url)}
        assert told == [{"endpoint": "ping"}]
        assert found["no-key"].level == "advice"
        assert "`kill`" in found["no-key"].message
        assert found["pickle"].level == "advice"

    def test_a_key_is_no_danger(self) -> None:
        with policy(lambda _: {"error": "Unauthorized: Invalid API token"}) as url:
            found = {finding.code: finding for finding in examine(url)}
        assert "no-key" not in found
        assert "Invalid API token" in found["server"].message

    def test_where_nothing_answers_it_is_told(self) -> None:
        assert [finding.level for finding in examine("tcp://127.0.0.1:1") if finding.code == "server"] == ["error"]


def test_it_carries_actions_and_state_alone() -> None:
    pipeline = one_pipeline("zmq")
    assert pipeline.answers == ("actions",)
    assert pipeline.transport.takes_state(pipeline.variant, pipeline.options)
    assert pipeline.transport.travels("gr00t", one_pipeline("zmq", url="tcp://127.0.0.1:1").options) == ("raw",)
