"""A stand-in of the part of rclpy that the glue around it uses, inside this process. It is not rclpy.

It has the calls that the glue makes, with rclpy's signatures, its type checks on messages, one kind of each message
taken at a time, done callbacks run by the executor, wait sets, and the order of steps in rclpy's action server. Its
generated classes and its CDR are rosbags'. So it cannot show: DDS, discovery and QoS; rclpy's serialiser and the fields
of real generated classes; threads inside rclpy, its locks, teardown and time spent; exceptions of rcl; a Humble that
differs from Jazzy. For these tests/plugins/rclpy/test_rclpy.py runs the same suites on the real one.
"""

from __future__ import annotations

import inspect
from array import array
from collections import defaultdict, deque
from collections.abc import Callable
from copy import copy
from enum import Enum
from functools import cache
from queue import SimpleQueue
from threading import Condition
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from s2a_bench.clock import now_ns
from s2a_bench.ros import messages as ros
from s2a_bench.ros.action import CANCEL_GOAL, Goals, Status

GRAPH: list[Node] = []
OLD_ENDS: list[bool] = []
"""Not empty: a goal's state is set without its result, as before rclpy 7.1.8."""
Verdict = Enum("Verdict", ["REJECT", "ACCEPT"])


@cache
def generated(type_name: str, version: str = "6.0") -> Any:
    """What rosidl generates for a message: made without arguments, then assigned to."""

    def build(self: Any, **fields: Any) -> None:
        vars(self).update(vars(ros.default(type_name, version)) | fields)

    fields = {name: "" for name, _ in ros.typestore(version).fielddefs[type_name][1]}
    methods = {"__init__": build, "get_fields_and_field_types": classmethod(lambda _: dict(fields)), "version": version}
    return type(type_name, (ros.typestore(version).types[type_name],), methods)


@cache
def service(type_name: str) -> Any:
    return SimpleNamespace(Request=generated(type_name + "_Request"), Response=generated(type_name + "_Response"))


@cache
def action(type_name: str, version: str = "6.0") -> Any:
    parts = {part: generated(f"{type_name}_{part}", version) for part in ("Goal", "Result", "Feedback")}
    services = {name + "Service": service(f"{type_name}_{name}") for name in ("SendGoal", "GetResult")}
    return SimpleNamespace(
        **parts, Impl=SimpleNamespace(**services, FeedbackMessage=generated(type_name + "_FeedbackMessage"))
    )


def with_ndarrays(value: Any) -> Any:
    """A copy that rosbags takes: bytes of generated messages may be an ``array``."""
    if isinstance(value, array):
        assert value.typecode == "B"
        return np.frombuffer(value, np.uint8)
    if isinstance(value, list):
        return [with_ndarrays(item) for item in value]
    if not hasattr(value, "__msgtype__"):
        return value
    made = copy(value)
    vars(made).update({name: with_ndarrays(item) for name, item in vars(value).items()})
    return made


def serialize_message(message: Any) -> bytes:
    message = with_ndarrays(message)
    return bytes(ros.serialise(message, message.__msgtype__, getattr(message, "version", "6.0")))


def deserialize_message(cdr: bytes, cls: Any) -> Any:
    assert isinstance(cdr, bytes)
    message = cls()
    vars(message).update(vars(ros.deserialise(memoryview(cdr), cls.__msgtype__, cls.version)))
    return message


class Future:
    """rclpy's calls back at once where no executor has made it its own."""

    def __init__(self, executor: Executor | None) -> None:
        self.executor, self.callbacks, self.value = executor, [], []
        self.done = lambda: bool(self.value)
        self.result = lambda: self.value[0]

    def add_done_callback(self, callback: Callable[[Any], None]) -> None:
        self.callbacks.append(callback)
        if self.value:
            self.call(callback)

    def set_result(self, value: Any) -> None:
        self.value.insert(0, value)  # the last one counts, for those who ask later
        callbacks, self.callbacks = self.callbacks, []
        for callback in callbacks:
            self.call(callback)

    def call(self, callback: Callable[[Any], None]) -> None:
        if self.executor is None:
            callback(self)
        else:
            self.executor.create_task(callback, self)


CAME = Condition()
"""Something came to an entity that no executor serves, or a guard condition was triggered."""


class CallbackGroup:
    def add_entity(self, entity: Any) -> None:
        assert entity

    def can_execute(self, _entity: Any) -> bool:
        return True


class Guard:
    def __init__(self, callback_group: CallbackGroup) -> None:
        assert not callback_group.can_execute(self)
        self.handle, self.triggered = self, False

    def is_ready(self) -> bool:
        ready, self.triggered = self.triggered, False  # a wait resets it
        return ready

    def trigger(self) -> None:
        with CAME:
            self.triggered = True
            CAME.notify_all()


class WaitSet:
    """It has room for what it was made for, and forgets what it has after each wait."""

    def __init__(self, *counts_and_context: Any) -> None:
        *self.counts, context = counts_and_context
        assert len(self.counts) == 6
        assert context == "context handle"
        self.clear_entities()

    def clear_entities(self) -> None:
        self.subscriptions: list[Any] = []
        self.guards: list[Any] = []
        self.waitables: list[Any] = []

    def add_subscription(self, handle: Any) -> None:
        self.subscriptions.append(handle)

    def add_guard_condition(self, handle: Any) -> None:
        self.guards.append(handle)

    def wait(self, timeout_ns: int) -> None:
        assert (len(self.subscriptions) + 2 * len(self.waitables), len(self.guards)) == tuple(self.counts[:2])
        held = [*self.subscriptions, *self.waitables]
        assert all(entity.held for entity in held), "rclpy may destroy what is not held"
        with CAME:
            CAME.wait_for(lambda: sum(end.is_ready() for end in (*held, *self.guards)), timeout_ns / 1e9)
        self.clear_entities()


class Held:
    """Something of rclpy's that is not destroyed while it is a context."""

    held = 0

    def __enter__(self) -> None:
        self.held += 1

    def __exit__(self, *_: object) -> None:
        self.held -= 1


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
        self.context, self.default_callback_group = context, CallbackGroup()
        self.handlers: list[Any] = []
        self.domain, self.executor = context.domain, Executor(context)
        self.topics: dict[str, list[Any]] = defaultdict(list)
        self.subscribed: dict[str, list[Any]] = defaultdict(list)
        self.waitables: list[Any] = []
        self.services: dict[str, Any] = {}
        GRAPH.append(self)

    def destroy_node(self) -> None:
        GRAPH.remove(self)

    def peers(self) -> list[Node]:
        return [node for node in GRAPH if node.domain == self.domain]

    def servers(self, name: str) -> list[Any]:
        every = [(node, end) for node in self.peers() for end in node.waitables]
        return [(node, end) for node, end in every if isinstance(end, ActionServer) and end.name == name]

    def deliver(self, end: Any, kind: str, data: Any) -> None:
        assert not end.callback_group.can_execute(end), "an executor would take it, too"
        with CAME:
            end.ready[kind].append(data)
            CAME.notify_all()

    def create_guard_condition(self, _callback: Any, callback_group: CallbackGroup) -> Guard:
        return Guard(callback_group)

    def create_publisher(self, cls: Any, topic: str, qos: Any) -> Any:
        def receivers() -> list[Subscribed]:
            return [subscribed for node in self.peers() for subscribed in node.subscribed[topic]]

        def publish(message: bytes) -> None:
            assert isinstance(message, bytes)  # rclpy: of the class, or bytes
            with CAME:
                for receiver in receivers():
                    receiver.messages.append(message)
                CAME.notify_all()

        self.topics[topic].append(SimpleNamespace(topic_type=cls.__msgtype__, qos_profile=qos))
        return SimpleNamespace(publish=publish, get_subscription_count=lambda: len(receivers()), topic_name=topic)

    def create_subscription(
        self, cls: Any, topic: str, _callback: Any, qos: Any, *, callback_group: CallbackGroup, raw: bool
    ) -> Any:
        assert raw
        assert not callback_group.can_execute(self)
        self.subscribed[topic].append(Subscribed(cls, qos))
        self.handlers.append(SimpleNamespace(callback_group=callback_group))  # of an incompatible QoS
        return SimpleNamespace(handle=self.subscribed[topic][-1], event_handlers=self.handlers[-1:])

    def count_publishers(self, topic: str) -> int:
        return sum(len(node.topics[topic]) for node in self.peers())

    def get_topic_names_and_types(self) -> list[tuple[str, list[str]]]:
        every = {
            topic: {each.topic_type for each in ends} for node in self.peers() for topic, ends in node.topics.items()
        }
        return [(topic, sorted(types)) for topic, types in every.items()]

    def get_publishers_info_by_topic(self, topic: str) -> list[Any]:
        return [end for node in self.peers() for end in node.topics[topic]]

    def create_service(self, kind: Any, name: str, callback: Any, *, qos_profile: Any) -> None:
        assert qos_profile
        self.services[name] = (kind, callback)

    def create_client(self, kind: Any, name: str) -> Any:
        if name.endswith("/_action/cancel_goal"):
            return self.canceller(name.removesuffix("/_action/cancel_goal"))

        def servers() -> list[tuple[Node, Any]]:
            return [(node, node.services[name]) for node in self.peers() if name in node.services]

        def call_async(request: Any) -> Future:
            assert isinstance(request, kind.Request)
            future = Future(self.executor)

            def answer(service: Any, callback: Any) -> None:
                response = callback(request, service.Response())
                assert isinstance(response, service.Response)
                future.set_result(response)

            for node, offered in servers():
                node.executor.create_task(answer, *offered)
            return future

        return SimpleNamespace(call_async=call_async, service_is_ready=lambda: bool(servers()))

    def canceller(self, server: str) -> Any:

        def call_async(request: Any) -> Future:
            future = Future(self.executor)
            for node, end in self.servers(server):
                node.deliver(end, "cancel", (future.set_result, request))
            return future

        return SimpleNamespace(call_async=call_async, service_is_ready=lambda: bool(self.servers(server)))


class Subscribed(Held):
    """What rclpy calls a subscription's handle, with rmw's history."""

    def __init__(self, cls: Any, qos: Any) -> None:
        self.cls, self.messages = cls, deque[bytes](maxlen=getattr(qos, "depth", None))

    def is_ready(self) -> bool:
        return bool(self.messages)

    def take_message(self, cls: Any, raw: bool) -> tuple[bytes, Any] | None:
        assert (cls, raw) == (self.cls, True)
        return (self.messages.popleft(), "info") if self.messages else None


class Waitable(Held):
    def __init__(self, node: Node, kind: Any, name: str, callback_group: CallbackGroup) -> None:
        self.node, self.action, self.name, self.callback_group = node, kind, name, callback_group
        self.ready: dict[str, deque[Any]] = defaultdict(deque)
        node.waitables.append(self)

    def get_num_entities(self) -> Any:
        kinds = ("guard_conditions", "timers", "clients", "services", "events")
        return SimpleNamespace(num_subscriptions=2, **{f"num_{kind}": 0 for kind in kinds})

    def add_to_wait_set(self, wait_set: WaitSet) -> None:
        wait_set.waitables.append(self)

    def is_ready(self, wait_set: WaitSet | None = None) -> bool:
        assert self.held or wait_set is None
        return any(self.ready.values())

    def take_data(self) -> dict[str, Any]:
        return {kind: queue.popleft() for kind, queue in self.ready.items() if queue}

    def destroy(self) -> None:
        self.node.waitables.remove(self)


class ActionClient(Waitable):
    def __init__(
        self, node: Node, kind: Any, name: str, *, callback_group: CallbackGroup, feedback_sub_qos_profile: Any
    ) -> None:
        assert feedback_sub_qos_profile
        super().__init__(node, kind, name, callback_group)
        self.server_is_ready = lambda: bool(node.servers(name))

    def ask(self, kind: str, request: Any) -> Future:
        future = Future(None)
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
        self.server, self.goal_id, self.result = server, goal_id, Future(None)
        self.id = bytes(goal_id.uuid)
        for name, end in (("succeed", Status.SUCCEEDED), ("abort", Status.ABORTED), ("canceled", Status.CANCELED)):
            setattr(self, name, self.until_7_1_7(end) if OLD_ENDS else self.from_7_1_8(end))

    def until_7_1_7(self, end: Status) -> Callable[[], None]:
        return lambda: self.server.goals.end(self.id, end, None, now_ns())

    def from_7_1_8(self, end: Status) -> Callable[..., None]:
        def set_state(response: Any = None) -> None:
            self.server.goals.end(self.id, end, None, now_ns())
            self.result.set_result(response or self.server.action.Result())

        return set_state

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
    def __init__(
        self,
        node: Node,
        kind: Any,
        name: str,
        *,
        callback_group: CallbackGroup,
        result_timeout: float,
        **callbacks: Any,
    ) -> None:
        super().__init__(node, kind, name, callback_group)
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
        infos = [ros.default("action_msgs/msg/GoalInfo", goal_id=ros.uuid(goal.id)) for goal in goals]
        reply(ros.default(CANCEL_GOAL + "_Response", return_code=int(code), goals_canceling=infos))

    def on_result(self, header: Any, request: Any) -> None:
        handle = self._goal_handles.get(bytes(request.goal_id.uuid))
        response = self.action.Impl.GetResultService.Response
        if handle is None:
            header[1](response(status=0))
        else:
            handle.result.add_done_callback(
                lambda done: header[1](response(status=int(handle.status), result=done.result()))
            )

    async def _execute_goal(self, execute_callback: Any, handle: ServerGoalHandle) -> None:
        handle.result.set_result(execute_callback(handle))


def modules() -> dict[str, dict[str, Any]]:
    """The modules the glue imports, with what it takes from them."""
    profile = SimpleNamespace(KEEP_ALL=1, KEEP_LAST=2, RELIABLE=3, BEST_EFFORT=4, VOLATILE=5, TRANSIENT_LOCAL=6)
    return {
        "rclpy": {
            "init": lambda *, args, context, domain_id: args or setattr(context, "domain", domain_id),
            "create_node": Node,
            "get_rmw_implementation_identifier": lambda: "rmw_stand_in",
        },
        "rclpy.callback_groups": {"CallbackGroup": CallbackGroup},
        "rclpy.impl": {},
        "rclpy.impl.implementation_singleton": {"rclpy_implementation": SimpleNamespace(WaitSet=WaitSet)},
        "rclpy.duration": {"Duration": SimpleNamespace},
        "rclpy.context": {"Context": type("Context", (), {"try_shutdown": lambda _: None, "handle": "context handle"})},
        "rclpy.executors": {
            "SingleThreadedExecutor": Executor,
            "ExternalShutdownException": type("ExternalShutdownException", (Exception,), {}),
        },
        "rclpy.qos": {
            **dict.fromkeys(("DurabilityPolicy", "HistoryPolicy", "ReliabilityPolicy"), profile),
            "QoSProfile": SimpleNamespace,
        },
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
PACKAGES = (
    "action_msgs",
    "builtin_interfaces",
    "diagnostic_msgs",
    "llama_msgs",
    "rcl_interfaces",
    "s2a_msgs",
    "sensor_msgs",
    "std_msgs",
)
