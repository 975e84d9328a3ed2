"""`s2a-bench serve`: the two servers as a robot's clients meet them."""

from __future__ import annotations

import os
import re
import signal
import subprocess
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

import httpx
import pytest

from s2a_bench.ros import QoS, open_middleware
from s2a_bench.ros import messages as ros
from s2a_bench.testing.transport import ask, wiring_of, yuyv_frame
from s2a_bench.transport import open_client
from s2a_bench.types import Action, Request
from tests.cli.program import command, refused

ONE_BY_ONE = ("--ros-args", "-p", "feedback_interval:=0.0", "--")
"""The echo engine is faster than any model: without this its tokens share feedbacks."""
Start = Callable[..., tuple["subprocess.Popen[str]", str]]


@pytest.fixture
def start() -> Iterator[Start]:
    """Start a server and return it with its first line; it is ended afterwards."""
    with ExitStack() as stack:

        def run(*arguments: str) -> tuple[subprocess.Popen[str], str]:
            process = subprocess.Popen(
                command("serve", *arguments), stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
            )
            stack.callback(process.communicate)
            stack.callback(process.kill)
            line = process.stdout.readline()
            assert line, process.communicate()[1]
            return process, line

        yield run


def child_of(process: subprocess.Popen[str]) -> int:
    """The process that serves."""
    return int(Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()[0])


def test_ros_answers_goals_and_publishes_tokens(start: Start, dds_domain: int, tmp_path: Path) -> None:
    (tmp_path / "node.toml").write_text('engine = "echo"\nnamespace = "/from_file"\nmax-tokens = 5\n')
    _, line = start("ros", "--config", str(tmp_path / "node.toml"), "--namespace", "/robot_llama", *ONE_BY_ONE)
    assert "/robot_llama/generate_response" in line  # flags win
    assert "engine echo" in line
    middleware = open_middleware(domain_id=dds_domain)
    plotted = middleware.subscription("/robot_llama/token", ros.TOKEN, QoS(0))
    client = open_client(wiring_of("ros/action", "/robot_llama", domain_id=dds_domain))
    try:
        while not plotted.matched():
            plotted.take(0.01)
        tokens, trace = ask(client, Request("a", "go to the kitchen", (yuyv_frame(),)))
        assert "".join(token.text for token in tokens) == "go to the kitchen go"
        assert trace.remote is not None
        words = [plotted.unpack(plotted.take(10)).text for _ in tokens]
        assert words == [token.text for token in tokens]
    finally:
        client.close()
        middleware.close()


def test_a_ros_server_that_died_is_started_again_at_once(start: Start, dds_domain: int) -> None:
    process, line = start("ros", "--engine", "echo", "--namespace", "/reborn", "--max-tokens", "5", *ONE_BY_ONE)
    os.kill(child_of(process), signal.SIGKILL)
    assert process.stdout.readline() == line
    client = open_client(wiring_of("ros/action", "/reborn", domain_id=dds_domain))
    try:
        tokens, _ = ask(client, Request("a", "go to the kitchen", (yuyv_frame(),)))
        assert len(tokens) == 5
    finally:
        client.close()


def test_limits_are_flags_and_keys_of_the_file(start: Start, tmp_path: Path) -> None:
    (tmp_path / "limits.toml").write_text('answer-timeout = 0.5\nlatency = "1000"\nmax-body-mib = 0.01\n')
    _, line = start(
        "http", "--engine", "echo", "--port", "0", "--config", str(tmp_path / "limits.toml"), "--max-body-mib", "1"
    )
    url = line.split()[2].rstrip(";")
    body = {"messages": [{"role": "user", "content": "a" * 100_000}], "max_tokens": 4}
    assert httpx.post(url, json=body).status_code == 504
    assert httpx.post(url, content=bytes((1 << 20) + 1)).status_code == 413


def test_a_server_that_died_is_started_again_once(start: Start) -> None:
    process, line = start("http", "--engine", "echo", "--port", "0")
    url = line.split()[2].rstrip(";")
    body = {"messages": [{"role": "user", "content": "hello robot"}], "max_tokens": 2}
    os.kill(child_of(process), signal.SIGSEGV)
    assert "died, killed by signal 11; it is started again, once" in process.stderr.readline()
    assert process.stdout.readline() == line
    assert httpx.post(url, json=body).status_code == 200
    os.kill(child_of(process), signal.SIGSEGV)
    assert process.wait(30) == 1
    lines = process.stderr.read().splitlines()
    assert len(lines) == 1
    assert "died, killed by signal 11" in lines[0]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("colour = 1", "'colour' is not one of engine, model"),
        ("threads = true", "threads = True should be a number"),
        ("= 1", "not TOML"),
        ("max-tokens = 0", "max-tokens: 0 should be greater than or equal to 1"),
        ('max-body-mib = "much"', "--max-body-mib: 'much' should be a valid number"),
        ("result-timeout = inf", "result-timeout: inf should be less than or equal to 86400"),
    ],
)
def test_a_wrong_file_is_one_line(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "node.toml").write_text(text)
    assert message in refused("serve", "ros", "--config", tmp_path / "node.toml")


def test_ros_args_name_the_node_its_topics_and_its_parameters(start: Start, dds_domain: int, tmp_path: Path) -> None:
    (tmp_path / "robot.yaml").write_text("/robot/brain:\n  ros__parameters: {max_tokens: 3, feedback_interval: 0.0}\n")
    rules = ["-r", "__ns:=/robot", "-r", "__node:=brain", "-r", "generate_response:=/ask", "-r", "token:=words"]
    process, line = start(
        "ros", "--engine", "echo", "--camera-topic", "/front/image", "--ros-args", *rules,
        "--params-file", str(tmp_path / "robot.yaml"), "-p", "use_sim_time:=false", "--", "--max-waiting", "7"
    )  # fmt: skip
    assert f"action /ask, camera /front/image, in DDS domain {dds_domain}" in line
    middleware = open_middleware(domain_id=dds_domain)
    try:
        type_name = "rcl_interfaces/srv/GetParameters"
        client = middleware.service_client("/robot/brain/get_parameters", type_name)
        request = ros.default(type_name + "_Request", names=["max_tokens", "max_waiting", "engine"])
        values = client.call(request, 20).values
        assert [value.integer_value for value in values[:2]] == [3, 7]
        assert values[2].string_value == "echo"
        plotted = middleware.subscription("/robot/words", ros.TOKEN, QoS(0))
        action = open_client(replace(wiring_of("ros/action", action="/ask", domain_id=dds_domain), black_box=True))
        try:
            tokens, _ = ask(action, Request("a", "one two three four five", max_tokens=20))
        finally:
            action.close()
        assert len(tokens) == 3
        assert plotted.take(20) is not None
    finally:
        middleware.close()
    process.send_signal(signal.SIGINT)
    assert process.wait(30) == 0


def test_iceoryx2_says_its_service(start: Start) -> None:
    process, line = start("iceoryx2", "--engine", "echo", "--service", "robot/eyes")
    assert line.startswith("serving iceoryx2 at robot/eyes for this user alone; ")
    client = open_client(wiring_of("iceoryx2", "robot/eyes"))
    tokens, _ = ask(client, Request("a", "hello robot", (yuyv_frame(),), max_tokens=2))
    client.close()
    assert "".join(token.text for token in tokens) == "hello robot"
    process.send_signal(signal.SIGTERM)
    assert process.wait(30) in {0, -signal.SIGTERM}


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("websocket/openpi", r"at (ws://\S+), streamed at \1/stream; "),
        ("zmq", r"serving GR00T's protocol at (tcp://127\.0\.0\.1:\d+)"),
    ],
)
def test_a_policy_server_says_where_it_is_and_answers_with_chunks(start: Start, name: str, said: str) -> None:
    process, line = start(name, "--engine", "echo", "--port", "0", "--horizon", "5", "--action-dim", "3")
    address = re.search(said, line)
    client = open_client(wiring_of(name.partition("/")[0], address[1]))
    actions, _ = ask(client, Request("a", "hello robot", (yuyv_frame(),), max_tokens=50))
    client.close()
    assert [action.values.shape for action in actions if isinstance(action, Action)] == [(3,)] * 5
    process.send_signal(signal.SIGTERM)
    assert process.wait(30) in {0, -signal.SIGTERM}
