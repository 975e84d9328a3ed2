"""rclpy keeps the contracts, in a sourced ROS 2 environment whose workspace has s2a_msgs and llama_msgs."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from s2a_bench.ros import open_middleware
from tests.ros.action_suite import ActionSuite
from tests.ros.middleware_suite import Join, MiddlewareSuite, joining

pytest.importorskip("rclpy", reason="rclpy comes with ROS 2, not from PyPI")


@pytest.fixture(autouse=True)
def on_loopback(monkeypatch: pytest.MonkeyPatch) -> None:
    """rclpy's own default is the subnet."""
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    monkeypatch.setenv("ROS_LOCALHOST_ONLY", "1")  # Humble's name for it


@pytest.fixture
def join(dds_domain: int) -> Iterator[Join]:
    with joining(lambda: open_middleware("rclpy", domain_id=dds_domain)) as join:
        yield join


class TestRclpy(MiddlewareSuite):
    """In a workspace that has s2a_msgs."""


class TestRclpyActions(ActionSuite):
    @pytest.fixture(autouse=True)
    def llama_msgs(self) -> None:
        pytest.importorskip("llama_msgs.action", reason="the workspace has no llama_msgs")
