"""Every transport's two ends outlive one hostile peer after the other."""

from __future__ import annotations

from s2a_bench.testing.hostile import HostileSuite, http, ros


class TestHttp(HostileSuite):
    name = "http"
    clients = http.CLIENTS
    servers = http.SERVERS


class TestRosTopic(HostileSuite):
    name = "ros/topic"
    clients = ros.SERVER_CLIENTS
    servers = ros.TOPIC_SERVERS


class TestRosAction(HostileSuite):
    name = "ros/action"
    servers = ros.ACTION_SERVERS
