"""Zenoh keeps the contract of middlewares and actions, in the names of rmw_zenoh."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack

import pytest

from s2a_bench.ros import Middleware, open_middleware
from s2a_bench.ros.router import Router, free_endpoint
from s2a_bench.testing.action import ActionSuite
from s2a_bench.testing.middleware import Join, MiddlewareSuite

zenoh = pytest.importorskip("zenoh", reason="the extra zenoh is not installed")


@pytest.fixture
def endpoint() -> str:
    return free_endpoint()


@pytest.fixture
def join(endpoint: str, dds_domain: int) -> Iterator[Join]:
    """Join sessions of which the first is the router."""
    with ExitStack() as stack:
        joined: list[Middleware] = []

        def join() -> Middleware:
            middleware = open_middleware("zenoh", domain_id=dds_domain, router=Router(endpoint, host=not joined))
            joined.append(middleware)
            stack.callback(middleware.close)
            return middleware

        yield join


@pytest.fixture
def routed(endpoint: str, dds_domain: int) -> Iterator[Join]:
    """Join sessions that meet at a router that is none of them."""
    with ExitStack() as stack:

        def join(host: bool = False) -> Middleware:
            middleware = open_middleware("zenoh", domain_id=dds_domain, router=Router(endpoint, host=host))
            stack.callback(middleware.close)
            return middleware

        join(host=True)
        yield join


class TestZenoh(MiddlewareSuite):
    @pytest.fixture
    def join(self, join: Join) -> Join:
        return join


class TestZenohThroughARouter(MiddlewareSuite):
    @pytest.fixture
    def join(self, routed: Join) -> Join:
        return routed


class TestZenohActions(ActionSuite):
    @pytest.fixture
    def join(self, join: Join) -> Join:
        return join


class TestZenohActionsThroughARouter(ActionSuite):
    @pytest.fixture
    def join(self, routed: Join) -> Join:
        return routed
