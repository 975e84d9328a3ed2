"""Fixtures for every test: a DDS domain of this test run's own, and models that cannot end the run."""

from __future__ import annotations

import functools
import os
import signal
from collections.abc import Iterator

import pytest
from hypothesis import settings

from s2a_bench.inference.llama_cpp import LlamaCppEngine
from s2a_bench.inference.smoke import smoke_test
from tests.made_runs import black_box, make_row, make_run, plausible  # noqa: F401 - fixtures

# These machines are shared: time is not judged. What is drawn is the same each time, as what judges a change must be;
# S2A_RANDOM=1 draws anew, and so does `make fuzz`.
settings.register_profile("s2a", deadline=None, derandomize="S2A_RANDOM" not in os.environ)
settings.load_profile("s2a")

DOMAINS = range(101, 201)
"""Far from ROS's default 0, and with valid ports."""


@pytest.fixture(scope="session", autouse=True)
def dds_domain() -> int:
    """Keep DDS on loopback, in a domain that another test run on this machine is unlikely to use.

    In a sourced ROS 2 environment, too, the middleware is Cyclone DDS from PyPI unless a test names another.
    """
    domain = DOMAINS[os.getpid() % len(DOMAINS)]
    os.environ["ROS_DOMAIN_ID"] = str(domain)
    for name in (
        "ROS_AUTOMATIC_DISCOVERY_RANGE",
        "ROS_STATIC_PEERS",
        "CYCLONEDDS_URI",
        "ROS_LOCALHOST_ONLY",
        "ROS_DISTRO",
    ):
        os.environ.pop(name, None)
    return domain


@pytest.fixture(scope="session", autouse=True)
def interrupts_reach_the_processes_of_tests() -> None:
    """Undo what a shell does to background jobs: a process that inherits an ignored SIGINT cannot be interrupted."""
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.fixture(scope="session", autouse=True)
def models_that_die_fail_their_test() -> Iterator[None]:
    """Let llama.cpp answer in a process of its own before the first model is loaded in this one.

    Where that process dies, as of an illegal instruction, each test that loads a model fails, and the run goes on.
    """
    load = LlamaCppEngine._load
    smoke = functools.cache(smoke_test)

    def load_what_lives(self: LlamaCppEngine, *files: object) -> object:
        if message := smoke().message:
            pytest.fail(message, pytrace=False)
        return load(self, *files)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(LlamaCppEngine, "_load", load_what_lives)
        yield
