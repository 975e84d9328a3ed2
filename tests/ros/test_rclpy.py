"""rclpy keeps the contracts, in a sourced ROS 2 environment whose workspace has s2a_msgs and llama_msgs."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack

import pytest

from s2a_bench.ros import Middleware, open_middleware
from s2a_bench.testing.action import ActionSuite
from s2a_bench.testing.middleware import Join, MiddlewareSuite

pytest.importorskip("rclpy", reason="rclpy comes with ROS 2, not from PyPI")


@pytest.fixture
def rclpy_join(dds_domain: int) -> Iterator[Join]:
    with ExitStack() as stack:

        def join() -> Middleware:
            middleware = open_middleware("rclpy", domain_id=dds_domain)
            stack.callback(middleware.close)
            return middleware

        yield join


class TestRclpy(MiddlewareSuite):
    @pytest.fixture
    def join(self, rclpy_join: Join) -> Join:
        return rclpy_join


class TestRclpyActions(ActionSuite):
    @pytest.fixture
    def join(self, rclpy_join: Join) -> Join:
        pytest.importorskip("llama_msgs.action", reason="the workspace has no llama_msgs")
        return rclpy_join
