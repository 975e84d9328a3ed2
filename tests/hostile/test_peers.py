"""Every transport's two ends outlive one hostile peer after the other."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from s2a_bench.transport import Wiring
from s2a_bench.transport.limits import Limits
from tests.hostile.suite import HostileSuite
from tests.hostile.wires import http, ros, shm, websocket, zmq


class TestHttp(HostileSuite):
    name = "http"
    clients = http.CLIENTS
    servers = http.SERVERS


class TestHttpBestEffort(HostileSuite):
    name = "http/best-effort"
    clients = http.FAST
    servers = http.SERVERS


class TestRosTopic(HostileSuite):
    name = "ros/topic"
    clients = ros.CLIENTS
    targets = 1  # a case is for the first participants of the domain


class TestZmq(HostileSuite):
    name = "zmq/gr00t"
    clients = zmq.CLIENTS
    servers = zmq.SERVERS


class TestShm(HostileSuite):
    name = "shm"
    clients = shm.CLIENTS


class TestWebsocket(HostileSuite):
    name = "websocket/openpi"
    clients = websocket.CLIENTS
    servers = websocket.SERVERS[:-1]

    @classmethod
    def wiring(cls) -> Wiring[Any]:
        return replace(super().wiring(), limits=Limits(head_s=2))  # one case waits for it


class TestWebsocketStreamed(HostileSuite):
    name = "websocket/openpi-stream"
    servers = websocket.SERVERS[-1:]
