"""The glue around rclpy keeps the contracts, on a stand-in for rclpy inside this process.

The stand-in has the calls that the glue makes, with rclpy's signatures, its type checks on messages, one kind of each
message taken at a time, done callbacks and waitables run by the executor, and the order of steps in rclpy's action
server. Its generated classes and its CDR are rosbags'. So it cannot show: DDS, discovery and QoS; rclpy's serialiser
and the fields of real generated classes; threads inside rclpy, its locks, teardown and time spent; exceptions of rcl;
a Humble that differs from Jazzy. For these tests/ros/test_rclpy.py runs the same contracts on the real one.
"""

from __future__ import annotations

import inspect
import os
import sys
from collections import defaultdict, deque
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from enum import Enum
from functools import cache
from queue import SimpleQueue
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest

from s2a_bench.clock import now_ns
from s2a_bench.errors import TransportError
from s2a_bench.ros import Accepted, Feedback, Middleware, QoS, Result, default_middleware, llama, open_middleware
from s2a_bench.ros import messages as ros
from s2a_bench.ros.action import Goals, Status
from s2a_bench.testing.action import NAME, ActionSuite
from s2a_bench.testing.middleware import Join, MiddlewareSuite
from s2a_bench.types import Frame

GRAPH: list[Node] = []
Verdict = Enum("Verdict", ["REJECT", "ACCEPT"])
GLUE = ("client", "middleware", "node", "server", "types")


@cache
def generated(type_name: str, version: str = "6.0") -> Any:
    """What rosidl generates for a message: made without arguments, then assigned to."""

    def build(self: Any, **fields: Any) -> None:
        vars(self).update(vars(ros.default(type_name, version)) | fields)

    fields = {name: "" for name, _ in ros.typestore(version).fielddefs[type_name][1]}
    methods = {"__init__": build, "get_fields_and_field_types": classmethod(lambda _: dict(fields)), "version": version}
    return type(type_name, (ros.typestore(version).types[type_name],), methods)


def service(type_name: str) -> Any:
    return SimpleNamespace(Request=generated(type_name + "_Request"), Response=generated(type_name + "_Response"))


@cache
def action(type_name: str, version: str = "6.0") -> Any:
    parts = {part: generated(f"{type_name}_{part}", version) for part in ("Goal", "Result", "Feedback")}
    services = {name + "Service": service(f"{type_name}_{name}") for name in ("SendGoal", "GetResult")}
    return SimpleNamespace(
        **parts, Impl=SimpleNamespace(**services, FeedbackMessage=generated(type_name + "_FeedbackMessage"))
    )


def serialize_message(message: Any) -> bytes:
    return bytes(ros.serialise(message, message.__msgtype__, getattr(message, "version", "6.0")))


def deserialize_message(cdr: bytes, cls: Any) -> Any:
    assert isinstance(cdr, bytes)
    message = cls()
    vars(message).update(vars(ros.deserialise(memoryview(cdr), cls.__msgtype__, cls.version)))
    return message


class Future:
    def __init__(self, executor: Executor) -> None:
        self.executor, self.callbacks, self.value = executor, [], []
        self.done = lambda: bool(self.value)
        self.result = lambda: self.value[0]

    def add_done_callback(self, callback: Callable[[Any], None]) -> None:
        self.callbacks.append(callback)
        if self.value:
            self.executor.create_task(callback, self)

    def set_result(self, value: Any) -> None:
        self.value.append(value)
        for callback in self.callbacks:
            self.executor.create_task(callback, self)


class Executor:
    def __init__(self, context: Any) -> None:
        self.tasks: SimpleQueue[Any] = SimpleQueue()
        self.context = context

    def add_node(self, node: Node) -> None:
        node.executor = self

    def create_task(self, function: Any, *arguments: Any) -> None:
        self.tasks.put((function, arguments))

    def spin_once(self) -> None:
        function, arguments = self.tasks.get()
        coroutine = function(*arguments)
        if inspect.iscoroutine(coroutine):
            with pytest.raises(StopIteration):  # nothing here ever suspends
                coroutine.send(None)

    def shutdown(self) -> None:
        self.tasks = SimpleQueue()


class Node:
    def __init__(self, name: str, context: Any, namespace: str, **_: bool) -> None:
        assert "/" not in name
        assert namespace.startswith("/")
        self.domain, self.executor = context.domain, Executor(context)
        self.topics: dict[str, list[Any]] = defaultdict(list)
        self.subscribed: dict[str, list[Any]] = defaultdict(list)
        self.waitables: list[Any] = []
        GRAPH.append(self)

    def destroy_node(self) -> None:
        GRAPH.remove(self)

    def peers(self) -> list[Node]:
        return [node for node in GRAPH if node.domain == self.domain]

    def servers(self, name: str) -> list[Any]:
        every = [(node, end) for node in self.peers() for end in node.waitables]
        return [(node, end) for node, end in every if isinstance(end, ActionServer) and end.name == name]

    def deliver(self, end: Any, kind: str, data: Any) -> None:
        async def handle() -> None:
            await end.execute(end.take_data())

        end.ready[kind].append(data)
        self.executor.create_task(handle)

    def create_publisher(self, _cls: Any, topic: str, _qos: Any) -> Any:
        def receivers() -> list[tuple[Node, Any]]:
            return [(node, receive) for node in self.peers() for receive in node.subscribed[topic]]

        def publish(message: bytes) -> None:
            assert isinstance(message, bytes)  # rclpy: of the class, or bytes
            for node, receive in receivers():
                node.executor.create_task(receive, message)

        self.topics[topic].append(publish)
        return SimpleNamespace(publish=publish, get_subscription_count=lambda: len(receivers()), topic_name=topic)

    def create_subscription(self, _cls: Any, topic: str, callback: Any, _qos: Any, *, raw: bool) -> None:
        assert raw
        self.subscribed[topic].append(callback)

    def count_publishers(self, topic: str) -> int:
        return sum(len(node.topics[topic]) for node in self.peers())

    def create_client(self, _service: Any, name: str) -> Any:
        server = name.removesuffix("/_action/cancel_goal")

        def call_async(request: Any) -> Future:
            future = Future(self.executor)
            for node, end in self.servers(server):
                node.deliver(end, "cancel", (future.set_result, request))
            return future

        return SimpleNamespace(call_async=call_async, service_is_ready=lambda: bool(self.servers(server)))


class Waitable:
    def __init__(self, node: Node, kind: Any, name: str) -> None:
        self.node, self.action, self.name = node, kind, name
        self.ready: dict[str, deque[Any]] = defaultdict(deque)
        node.waitables.append(self)

    def take_data(self) -> dict[str, Any]:
        return {kind: queue.popleft() for kind, queue in self.ready.items() if queue}

    def destroy(self) -> None:
        self.node.waitables.remove(self)


class ActionClient(Waitable):
    def __init__(self, node: Node, kind: Any, name: str, *, feedback_sub_qos_profile: Any) -> None:
        assert feedback_sub_qos_profile
        super().__init__(node, kind, name)
        self.server_is_ready = lambda: bool(node.servers(name))

    def ask(self, kind: str, request: Any) -> Future:
        future = Future(self.node.executor)
        for node, end in self.node.servers(self.name):
            reply = lambda value: self.node.deliver(self, kind, (future, value))  # noqa: E731
            node.deliver(end, kind, ((self, reply), request))
        return future

    def send_goal_async(self, goal: Any, feedback_callback: Any = None, goal_uuid: Any = None) -> Future:
        assert isinstance(goal, self.action.Goal)
        assert feedback_callback is None
        return self.ask("goal", self.action.Impl.SendGoalService.Request(goal_id=goal_uuid, goal=goal))

    async def execute(self, taken_data: dict[str, Any]) -> None:
        for future, response in taken_data.values():
            future.set_result(response)


class ClientGoalHandle:
    def __init__(self, client: ActionClient, goal_id: Any, _response: Any) -> None:
        request = client.action.Impl.GetResultService.Request(goal_id=goal_id)
        self.get_result_async = lambda: client.ask("result", request)


class ServerGoalHandle:
    def __init__(self, server: ActionServer, goal_id: Any) -> None:
        self.server, self.goal_id, self.result = server, goal_id, Future(server.node.executor)
        self.id = bytes(goal_id.uuid)
        for name, end in (("succeed", Status.SUCCEEDED), ("abort", Status.ABORTED), ("canceled", Status.CANCELED)):
            setattr(self, name, lambda end=end: server.goals.end(self.id, end, None, now_ns()))

    status = property(lambda self: self.server.goals.status(self.id))
    is_cancel_requested = property(lambda self: self.status == Status.CANCELING)

    def execute(self, execute_callback: Any = None) -> None:
        self.server.goals.move(self.id, Status.EXECUTING)
        self.server.notify_execute(self, execute_callback)

    def publish_feedback(self, feedback: Any) -> None:
        assert isinstance(feedback, self.server.action.Feedback)
        for node in self.server.node.peers():
            for end in node.waitables:
                if isinstance(end, ActionClient) and end.name == self.server.name:
                    message = self.server.action.Impl.FeedbackMessage(goal_id=self.goal_id, feedback=feedback)
                    node.deliver(end, "feedback", message)


class ActionServer(Waitable):
    def __init__(self, node: Node, kind: Any, name: str, *, result_timeout: float, **callbacks: Any) -> None:
        super().__init__(node, kind, name)
        self.goals, self.callbacks = Goals(int(result_timeout * 1e9)), callbacks
        self._goal_handles: dict[bytes, ServerGoalHandle] = {}

    async def execute(self, taken_data: dict[str, Any]) -> None:
        self.goals.expire(now_ns())
        self._goal_handles = {key: handle for key, handle in self._goal_handles.items() if self.goals.find(key)}
        for kind, (header, request) in taken_data.items():
            getattr(self, "on_" + kind)(header, request)

    def on_goal(self, header: Any, request: Any) -> None:
        key = bytes(request.goal_id.uuid)
        accepted = key not in self._goal_handles and self.callbacks["goal_callback"](request.goal) is Verdict.ACCEPT
        if accepted:
            self.goals.offer(key)
            self.goals.accept(key, now_ns())
            self._goal_handles[key] = ServerGoalHandle(self, request.goal_id)
        header[1](SimpleNamespace(accepted=accepted))

    def on_cancel(self, reply: Any, request: Any) -> None:
        code, goals = self.goals.cancel(bytes(request.goal_info.goal_id.uuid), 0)
        infos = [SimpleNamespace(goal_id=SimpleNamespace(uuid=goal.id)) for goal in goals]
        reply(SimpleNamespace(return_code=int(code), goals_canceling=infos))

    def on_result(self, header: Any, request: Any) -> None:
        handle = self._goal_handles.get(bytes(request.goal_id.uuid))
        response = self.action.Impl.GetResultService.Response
        if handle is None:
            header[1](response(status=0))
        else:
            handle.result.add_done_callback(
                lambda done: header[1](response(status=int(handle.status), result=done.result()))
            )

    def notify_execute(self, handle: ServerGoalHandle, execute_callback: Any) -> None:
        self.node.executor.create_task(lambda: handle.result.set_result(execute_callback(handle)))


def modules() -> dict[str, dict[str, Any]]:
    """The modules the glue imports, with what it takes from them."""
    profile = SimpleNamespace(KEEP_ALL=1, KEEP_LAST=2, RELIABLE=3, BEST_EFFORT=4)
    return {
        "rclpy": {
            "init": lambda *, args, context, domain_id: args or setattr(context, "domain", domain_id),
            "create_node": Node,
            "get_rmw_implementation_identifier": lambda: "rmw_stand_in",
        },
        "rclpy.context": {"Context": type("Context", (), {"try_shutdown": lambda _: None})},
        "rclpy.executors": {
            "SingleThreadedExecutor": Executor,
            "ExternalShutdownException": type("ExternalShutdownException", (Exception,), {}),
        },
        "rclpy.qos": {"HistoryPolicy": profile, "ReliabilityPolicy": profile, "QoSProfile": SimpleNamespace},
        "rclpy.serialization": {"serialize_message": serialize_message, "deserialize_message": deserialize_message},
        "rclpy.action": {
            "ActionClient": ActionClient,
            "ActionServer": ActionServer,
            "GoalResponse": Verdict,
            "CancelResponse": Verdict,
        },
        "rclpy.action.client": {"ClientGoalHandle": ClientGoalHandle},
    }


INTERFACES: dict[str, Callable[[str], Any]] = {"msg": generated, "srv": service, "action": action}
PACKAGES = ("action_msgs", "builtin_interfaces", "llama_msgs", "s2a_msgs", "sensor_msgs", "std_msgs")


@pytest.fixture(scope="module", autouse=True)
def ros_2() -> Iterator[None]:
    """A sourced environment, as far as the glue sees it."""
    with pytest.MonkeyPatch.context() as patch:
        for name, content in modules().items():
            patch.setitem(sys.modules, name, ModuleType(name))
            vars(sys.modules[name]).update(content)
        for package in (*PACKAGES, "unique_identifier_msgs"):
            for kind, make in INTERFACES.items():
                name = f"{package}.{kind}"
                patch.setitem(sys.modules, name, ModuleType(name))
                prefix = f"{package}/{kind}/"
                vars(sys.modules[name])["__getattr__"] = lambda part, make=make, prefix=prefix: make(prefix + part)
        for part in GLUE:
            patch.delitem(sys.modules, f"s2a_bench.ros.rclpy_{part}", raising=False)
        yield
        for part in GLUE:
            sys.modules.pop(f"s2a_bench.ros.rclpy_{part}", None)


@pytest.fixture
def rclpy_join() -> Iterator[Join]:
    with ExitStack() as stack:

        def join() -> Middleware:
            middleware = open_middleware("rclpy", domain_id=7, node_name="/robot/bench")
            stack.callback(middleware.close)
            return middleware

        yield join
    assert GRAPH == []


class TestRclpyGlue(MiddlewareSuite):
    @pytest.fixture
    def join(self, rclpy_join: Join) -> Join:
        return rclpy_join


class TestRclpyActionGlue(ActionSuite):
    @pytest.fixture
    def join(self, rclpy_join: Join) -> Join:
        return rclpy_join


def test_an_image_is_published_as_ready_cdr_and_its_pixels_are_views_of_what_arrives(rclpy_join: Join) -> None:
    publisher = rclpy_join().publisher("/image", ros.IMAGE, QoS(1))
    subscription = rclpy_join().subscription("/image", ros.IMAGE, QoS(1))
    pixels = np.random.default_rng(1).integers(0, 256, (480, 640, 3), np.uint8)
    packed = publisher.pack(ros.image_message(Frame(0, 0, 640, 480, "bgr8", pixels), 0, "camera"))
    assert type(packed) is bytes
    publisher.send(packed)
    got = subscription.take(5)
    assert got is not None
    data = subscription.unpack(got).data
    assert data.tobytes() == pixels.tobytes()
    assert not data.flags.owndata
    assert np.shares_memory(data, np.frombuffer(got, np.uint8))


def test_an_inbox_keeps_the_newest_as_its_qos_says(rclpy_join: Join) -> None:
    publisher = rclpy_join().publisher("/number", "std_msgs/msg/String", QoS(10))
    middleware = rclpy_join()
    newest = middleware.subscription("/number", "std_msgs/msg/String", QoS(2))
    every = middleware.subscription("/number", "std_msgs/msg/String", QoS(0))
    for number in range(5):
        publisher.send(publisher.pack(ros.message("std_msgs/msg/String", data=str(number))))
    assert [every.unpack(every.take(5)).data for _ in range(5)] == ["0", "1", "2", "3", "4"]
    assert [newest.unpack(newest.take(5)).data for _ in range(2)] == ["3", "4"]


def test_a_result_is_given_out_after_all_feedback(rclpy_join: Join) -> None:
    server = rclpy_join().action_server(NAME, llama.GENERATE_RESPONSE)
    client: Any = rclpy_join().action_client(NAME, llama.GENERATE_RESPONSE)
    goal_id = client.send(client.pack(llama.generate_goal("p")))
    goal = server.next_goal(5)
    assert goal is not None
    goal.accept()
    goal.executing()
    with client.lock:  # the client's thread stops after its first take, while all of this arrives
        for number in range(30):
            goal.feedback(llama.token_feedback(str(number), number))
        goal.succeed(llama.text_result("..."))
    events = [client.next_event(5) for _ in range(32)]
    assert [type(event) for event in events] == [Accepted, *[Feedback] * 30, Result]
    assert {event.goal_id for event in events} == {goal_id}


def test_a_package_that_is_not_built_is_named_with_the_way_out(
    rclpy_join: Join, monkeypatch: pytest.MonkeyPatch
) -> None:
    middleware = rclpy_join()
    monkeypatch.setitem(sys.modules, "s2a_msgs.msg", None)
    with pytest.raises(TransportError, match=r"s2a_msgs/msg/Token is not in.*colcon build --packages-select s2a_msgs"):
        middleware.publisher("/token", ros.TOKEN, QoS())


def test_an_interface_with_other_fields_is_refused(rclpy_join: Join, monkeypatch: pytest.MonkeyPatch) -> None:
    fields = classmethod(lambda _: {"id": "string", "index": "uint32"})
    older = type("Token", (generated(ros.TOKEN),), {"get_fields_and_field_types": fields})
    monkeypatch.setitem(vars(sys.modules["s2a_msgs.msg"]), "Token", older)
    with pytest.raises(TransportError, match="s2a_msgs/msg/Token of this ROS 2 workspace has other fields than ours"):
        rclpy_join().publisher("/token", ros.TOKEN, QoS())


def test_the_version_of_llama_msgs_is_the_workspaces(rclpy_join: Join, monkeypatch: pytest.MonkeyPatch) -> None:
    older = lambda part: generated(f"llama_msgs/msg/{part}", "4.4")  # noqa: E731
    monkeypatch.setitem(vars(sys.modules["llama_msgs.msg"]), "__getattr__", older)
    monkeypatch.setitem(
        vars(sys.modules["llama_msgs.action"]), "GenerateResponse", action(llama.GENERATE_RESPONSE, "4.4")
    )
    client = rclpy_join().action_client(NAME, llama.GENERATE_RESPONSE)
    assert client.server_version() == "4.4"
    with pytest.raises(TransportError, match=r"this workspace has llama_msgs 4\.4, not 6\.0"):
        client.pack(llama.generate_goal("p"))
    with pytest.raises(TransportError, match=r"this workspace has llama_msgs 4\.4, not 6\.0"):
        rclpy_join().action_server(NAME, llama.GENERATE_RESPONSE)


def test_a_closed_middleware_says_so(rclpy_join: Join) -> None:
    middleware = rclpy_join()
    publisher = middleware.publisher("/x", "std_msgs/msg/String", QoS())
    middleware.close()
    with pytest.raises(TransportError, match="closed"):
        publisher.send(publisher.pack(ros.message("std_msgs/msg/String", data="")))
    with pytest.raises(TransportError, match="closed"):
        middleware.subscription("/x", "std_msgs/msg/String", QoS())
    assert publisher.matched() == 0


@pytest.mark.parametrize(
    ("environ", "found", "expected"),
    [
        ({"ROS_DISTRO": "jazzy", "AMENT_PREFIX_PATH": "/opt/ros/jazzy"}, True, "rclpy"),
        ({"ROS_DISTRO": "jazzy", "AMENT_PREFIX_PATH": "/opt/ros/jazzy"}, False, "cyclonedds"),
        ({"ROS_DISTRO": "jazzy"}, True, "cyclonedds"),
        ({"AMENT_PREFIX_PATH": "/ws/install"}, True, "cyclonedds"),
        ({}, True, "cyclonedds"),
    ],
)
def test_rclpy_is_chosen_in_a_sourced_environment_that_has_it(
    monkeypatch: pytest.MonkeyPatch, environ: dict[str, str], found: bool, expected: str
) -> None:
    monkeypatch.setattr("s2a_bench.ros.find_spec", lambda name: object() if found and name == "rclpy" else None)
    assert default_middleware(environ) == expected


def test_without_a_name_the_environment_chooses(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("s2a_bench.ros.default_middleware", lambda environ: "rclpy" if environ is os.environ else "")
    middleware = open_middleware(domain_id=7)
    assert middleware.describe()["middleware"] == "rclpy"
    middleware.close()
