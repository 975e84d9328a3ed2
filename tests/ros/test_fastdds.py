"""Images cross between our Cyclone DDS and Fast DDS, ROS 2's default middleware, both ways; actions are told apart.

The peer is a C++ program of its own (tests/ros/fastdds) on Debian's Fast DDS: its discovery, its types by name without
XTypes information, and Fast CDR, as in rmw_fastrtps_cpp.
"""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import TypeAlias, TypeVar

import numpy as np
import pytest

from s2a_bench.clock import now_ns
from s2a_bench.errors import TransportError
from s2a_bench.ros import Middleware, QoS, open_middleware
from s2a_bench.ros import messages as ros
from s2a_bench.ros.llama import GENERATE_RESPONSE
from s2a_bench.testing.transport import wiring_of
from s2a_bench.transport import open_client
from s2a_bench.types import Frame
from tests.ros.middleware_suite import until

pytest.importorskip("cyclonedds", reason="cyclonedds has wheels for x86-64 only")

SOURCES = Path(__file__).parent / "fastdds"
HEADERS = (Path("/usr/include/fastrtps/utils/IPLocator.h"), Path("/usr/include/fastcdr/Cdr.h"))  # Fast DDS 2, not 3
MISSING = [str(path) for path in HEADERS if not path.exists()]
MISSING += [tool for tool in ("cmake", "c++") if shutil.which(tool) is None]
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(
        bool(MISSING),
        reason=f"no {', '.join(MISSING)}: apt-get install cmake g++ libfastrtps-dev libfastcdr-dev",
    ),
]
COUNT = 5
SIZES = {"reliable": (640, 480), "best_effort": (64, 48)}
"""A VGA image is more than a socket's default buffer holds: without reliability only a small one surely arrives."""
QOS = {"reliable": QoS(depth=10), "best_effort": QoS(depth=10, reliable=False)}
Peer: TypeAlias = "subprocess.Popen[str]"
Start: TypeAlias = Callable[..., Peer]
End = TypeVar("End")


def pixels(n: int, width: int, height: int) -> np.ndarray:
    """The bytes of the peer's image ``n``, as its source says."""
    i = np.arange(width * height * 3)
    return ((i * 31 + i // 251 + n * 7) % 256).astype(np.uint8).reshape(height, width, 3)


@pytest.fixture(scope="module")
def program(tmp_path_factory: pytest.TempPathFactory) -> Path:
    build = tmp_path_factory.mktemp("fastdds")
    for command in (
        ["cmake", "-S", str(SOURCES), "-B", str(build), "-DCMAKE_BUILD_TYPE=Release"],
        ["cmake", "--build", str(build)],
    ):
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stdout + done.stderr
    return build / "fastdds_peer"


@pytest.fixture
def start(program: Path, dds_domain: int) -> Iterator[Start]:
    """Start the peer with a discovery range and a role; whatever happens, it is gone after the test."""
    with ExitStack() as stack:

        def start(*arguments: object) -> Peer:
            peer = subprocess.Popen(
                [str(program), str(dds_domain), *map(str, arguments)],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                text=True,
            )
            stack.enter_context(peer)
            stack.callback(peer.kill)
            return peer

        yield start


@pytest.fixture
def middleware(dds_domain: int) -> Iterator[Middleware]:
    joined = open_middleware("cyclonedds", domain_id=dds_domain)
    yield joined
    joined.close()


def opened(first: str, ours: Callable[[], End], theirs: Callable[[], Peer]) -> tuple[End, Peer]:
    """Open our end and start the peer, one of them first."""
    if first == "cyclone":
        return ours(), theirs()
    peer = theirs()
    return ours(), peer


@pytest.mark.parametrize("reliability", list(QOS))
@pytest.mark.parametrize("first", ["fastdds", "cyclone"])
@pytest.mark.parametrize("discovery", ["localhost", "subnet"])
def test_fast_dds_images_reach_us(
    start: Start, middleware: Middleware, reliability: str, discovery: str, first: str
) -> None:
    # Cyclone takes the first heartbeat after matching as the start of a volatile topic. Where that heartbeat comes amid
    # the fragments of the first image, the image counts as older and is passed over; the later ones all arrive.
    width, height = SIZES[reliability]
    topic = f"/from_fastdds/{reliability}/{discovery}/{first}"
    arguments = (discovery, "pub", topic, reliability, width, height, COUNT)
    subscribe = partial(middleware.subscription, topic, ros.IMAGE, QOS[reliability])
    subscription, peer = opened(first, subscribe, partial(start, *arguments))
    assert peer.stdin is not None
    assert peer.stdout is not None
    assert peer.stdout.readline() == "matched\n"
    until(subscription.matched, lambda: subscription.take(0.01))
    for n in range(COUNT):
        peer.stdin.write("next\n")
        peer.stdin.flush()
        packed = subscription.take(20 if n else 5)
        if packed is None and n == 0 and reliability == "reliable":
            continue
        assert packed is not None
        image = subscription.unpack(packed)
        assert (image.header.stamp.sec, image.header.stamp.nanosec, image.header.frame_id) == (n, n + 1, f"fastdds_{n}")
        frame = ros.frame_of_image(image)
        assert (frame.width, frame.height, frame.encoding) == (width, height, "bgr8")
        np.testing.assert_array_equal(frame.data, pixels(n, width, height))
    peer.stdin.close()
    assert peer.wait(20) == 0


@pytest.mark.parametrize("reliability", list(QOS))
@pytest.mark.parametrize("first", ["fastdds", "cyclone"])
@pytest.mark.parametrize("discovery", ["localhost", "subnet"])
def test_our_images_reach_fast_dds(
    start: Start, middleware: Middleware, reliability: str, discovery: str, first: str
) -> None:
    width, height = SIZES[reliability]
    topic = f"/to_fastdds/{reliability}/{discovery}/{first}"
    arguments = (discovery, "sub", topic, reliability, COUNT)
    publish = partial(middleware.publisher, topic, ros.IMAGE, QOS[reliability])
    publisher, peer = opened(first, publish, partial(start, *arguments))
    assert peer.stdout is not None
    assert peer.stdout.readline() == "matched\n"
    until(publisher.matched)
    for n in range(COUNT):
        message = ros.image_message(
            Frame(n, 0, width, height, "bgr8", pixels(n, width, height)), n * 1_000_000_000 + n + 1, f"cyclone_{n}"
        )
        publisher.send(publisher.pack(message))
        line = peer.stdout.readline()
        assert (
            line
            == f"{n} {n + 1} cyclone_{n} {width}x{height} bgr8 step {3 * width} bytes {3 * width * height} wrong 0\n"
        )
    assert peer.wait(20) == 0


GOAL_TYPE = "llama_msgs::action::dds_::GenerateResponse_SendGoal_Request_"


def test_a_fast_dds_client_of_our_action_is_named_in_the_log(
    start: Start, middleware: Middleware, caplog: pytest.LogCaptureFixture
) -> None:
    server = middleware.action_server("/llama/generate_response", GENERATE_RESPONSE)
    topic = f"rq/llama/generate_response/_action/send_goalRequest={GOAL_TYPE}"
    peer = start("localhost", "pub", topic, "reliable", 8, 8, 100)
    assert peer.stdin is not None
    assert peer.stdout is not None
    assert peer.stdout.readline() == "matched\n"
    said: list[str] = []
    deadline = now_ns() + 20_000_000_000
    while not said and now_ns() < deadline:  # what is sent before our reader knows the writer is lost
        peer.stdin.write("next\n")
        peer.stdin.flush()
        assert server.next_goal(0.5) is None
        said = [message for message in caplog.messages if "Fast DDS" in message]
    for _ in range(2):
        peer.stdin.write("next\n")
    peer.stdin.flush()
    assert server.next_goal(1) is None
    (line,) = [message for message in caplog.messages if "Fast DDS" in message]
    assert "/llama/generate_response: a client on Fast DDS waits in vain" in line
    assert "RMW_IMPLEMENTATION=rmw_cyclonedds_cpp" in line
    peer.stdin.close()
    assert peer.wait(20) == 0


def test_a_fast_dds_server_of_an_action_is_named(
    start: Start, dds_domain: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("s2a_bench.transport.ros.joining.MATCH_TIMEOUT_S", 5.0)
    topic = f"rq/llama/generate_response/_action/send_goalRequest={GOAL_TYPE}"
    start("localhost", "sub", topic, "reliable", 1)
    wiring = wiring_of("ros/action", action="/llama/generate_response", domain_id=dds_domain)
    with pytest.raises(
        TransportError, match="/llama/generate_response is on Fast DDS, whose services have another form"
    ):
        open_client(wiring)
