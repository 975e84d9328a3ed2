"""Fixtures for every test: a DDS domain and a model cache of this test run's own."""

from __future__ import annotations

import os

import pytest
from hypothesis import settings

from tests.made_runs import black_box, make_row, make_run, plausible  # noqa: F401 - fixtures

settings.register_profile("s2a", deadline=None)  # these machines are shared: time is not judged
settings.load_profile("s2a")

DOMAINS = range(101, 201)
"""Far from ROS's default 0, and with valid ports."""


@pytest.fixture(scope="session", autouse=True)
def dds_domain() -> int:
    """Keep DDS on loopback, in a domain that another test run on this machine is unlikely to use."""
    domain = DOMAINS[os.getpid() % len(DOMAINS)]
    os.environ["ROS_DOMAIN_ID"] = str(domain)
    for name in ("ROS_AUTOMATIC_DISCOVERY_RANGE", "ROS_STATIC_PEERS", "CYCLONEDDS_URI"):
        os.environ.pop(name, None)
    return domain
