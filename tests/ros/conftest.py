"""A DDS domain of Cyclone's that tests of ROS join, several times if need be."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from s2a_bench.ros import open_middleware
from tests.ros.middleware_suite import Join, joining


@pytest.fixture
def join(dds_domain: int) -> Iterator[Join]:
    with joining(lambda: open_middleware("cyclonedds", domain_id=dds_domain)) as join:
        yield join
