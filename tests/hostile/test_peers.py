"""Every transport's two ends outlive one hostile peer after the other."""

from __future__ import annotations

from s2a_bench.testing.hostile import HostileSuite, http, ros, ros_servers


class TestHttp(HostileSuite):
    name = "http"
    clients = http.CLIENTS
    servers = http.SERVERS


class TestRosTopic(HostileSuite):
    name = "ros/topic"
    clients = ros.CLIENTS
    servers = ros_servers.TOKENS


class TestRosAction(HostileSuite):
    name = "ros/action"
    servers = ros_servers.GOALS
