"""The ROS server: sources receive requests, handlers answer them, the camera's newest frame is at hand.

A source is one variant's way in. Its threads take turns in waiting for a request; the one that got it answers it
while another waits, so that no request changes threads, and one that comes meanwhile waits for the engine (stage
`queue`), not in the network. All sources share one queue, which a request joins as it arrives: a source's lock is held
until it has its place and the client is informed, so requests are accepted, answered and ended in one order.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack
from dataclasses import replace
from functools import partial
from typing import Any, TypeAlias

from s2a_bench.errors import MissingInterface, TransportError
from s2a_bench.ros import QoS
from s2a_bench.ros import messages as ros
from s2a_bench.trace import Trace
from s2a_bench.transport import Handler, Wiring
from s2a_bench.transport.ros import ACTION
from s2a_bench.transport.ros.action import ActionSource
from s2a_bench.transport.ros.camera import POLL_S, CameraCache
from s2a_bench.transport.ros.exchange import Shared
from s2a_bench.transport.ros.joining import join, namespace_of, refuse_company, server_name, settled
from s2a_bench.transport.ros.node import Activity, NodeApi, PartHealth, declared
from s2a_bench.transport.ros.options import RosOptions
from s2a_bench.transport.ros.topic import TopicSource
from s2a_bench.transport.ros.wire import PROVENANCE_TOPIC, provenance_message
from s2a_bench.transport.serving import Core, SharedSourceWorkers

_log = logging.getLogger(__name__)


RequestSource: TypeAlias = TopicSource | ActionSource
"""One variant's way in: `take` waits for the next request and returns it packed, `exchange` unpacks it."""


class RosServer:
    def __init__(self, wiring: Wiring[RosOptions], handler: Handler) -> None:
        """Join the domain and create all topics; raises TransportError where another server answers already."""
        wiring, host = settled(wiring)
        self.address = wiring.address if host else namespace_of(wiring)
        namespace = namespace_of(wiring)
        self._core = Core(handler, wiring.limits)
        queued = self._core.queued
        if not (wiring.restarted or host):
            refuse_company(wiring, namespace)
        self.middleware = join(wiring, "server", host=host)
        self._cache = CameraCache(self.middleware, namespace, wiring.options, wiring.limits)
        self._sources: list[RequestSource] = [TopicSource(self.middleware, namespace, wiring.limits)]
        self._action: ActionSource | None = None
        try:
            self._action = ActionSource(self.middleware, wiring, queued.honours)
            self._sources.append(self._action)
        except MissingInterface as missing:  # of llama_msgs, which topics do not need
            if wiring.variant == ACTION or wiring.options.llama_msgs:  # wanted by name
                self.middleware.close()
                raise
            _log.warning("the action is not served: %s", missing)
        self._origin = self.middleware.publisher(  # kept: what is latched goes with its writer
            namespace + PROVENANCE_TOPIC, ros.PROVENANCE, QoS(depth=1, latched=True)
        )
        self._origin.send(self._origin.pack(provenance_message(queued.provenance)))
        self._options = wiring.options
        activity = Activity(lambda: queued.turns.waiting, wiring.limits.waiting, queued.turns.silent_s)
        self._shared = Shared(self._cache, activity)
        self._node: NodeApi | None = None
        if wiring.options.node_api:
            spoken = wiring.options.but(llama_msgs=self._action.version if self._action else "")
            logged, level = declared(replace(wiring, options=spoken), queued.settings), wiring.options.log_level
            name = server_name(wiring)
            self._node = NodeApi(self.middleware, name, logged, self._change, self._findings, level)

    def serve(self) -> None:
        sources = [SharedSourceWorkers(partial(self._take, source), self._shared.stopped) for source in self._sources]
        self._cache.start()
        for workers in sources:
            workers.start()
        if self._node:
            self._node.start(self._shared.stopped)
        self._shared.stopped.wait()
        for workers in sources:
            workers.join()
        self._cache.join()
        if self._node:
            self._node.close()
        self.middleware.close()

    def stop(self) -> None:
        self._shared.stopped.set()
        for source in self._sources:
            source.interrupt()
        self._cache.interrupt()

    def describe(self) -> dict[str, str | int]:
        return self.middleware.describe()

    def _change(self, wanted: Mapping[str, Any]) -> None:
        self._options = self._options.but(**wanted)
        if self._action is not None:
            self._action.tune(self._options)

    def _findings(self) -> Iterator[PartHealth]:
        frames, frame_ns = self._cache.seen()
        return self._shared.activity.findings(frames, frame_ns, self._cache.silence, self._options.max_frame_age)

    def _take(self, source: RequestSource) -> Callable[[], object] | None:
        """Wait for a request and give it its place in the queue; return what answers it."""
        packed = source.take(POLL_S)
        if packed is None:
            return None
        trace = Trace()
        trace.mark("network")
        with ExitStack() as held:
            try:
                held.enter_context(self._core.in_flight.counted())(source.size_bytes(packed))
                exchange = source.exchange(packed, self._shared, trace)
                turn = self._core.join(exchange)
            except TransportError as error:
                self._shared.activity.failed(str(error), logged=source is self._action)
                source.refuse(packed, str(error))
                return None
            exchange.held = held.pop_all()
        return partial(self._core.answer, exchange, turn)
