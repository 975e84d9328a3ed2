"""A DDS domain of Cyclone's that tests of ROS join, several times if need be."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack

import pytest

from s2a_bench.ros import Middleware, open_middleware
from s2a_bench.testing.middleware import Join


@pytest.fixture
def join(dds_domain: int) -> Iterator[Join]:
    with ExitStack() as stack:

        def join() -> Middleware:
            middleware = open_middleware("cyclonedds", domain_id=dds_domain)
            stack.callback(middleware.close)
            return middleware

        yield join
