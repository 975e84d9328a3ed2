"""``--ros-args``: what ROS 2's own arguments say to `serve ros`."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import Any

import pytest

from s2a_bench.cli.ros_args import Read, folded, read
from s2a_bench.errors import UsageError

KNOWN = ["engine", "max_tokens", "feedback_interval", "publish_tokens", "namespace", "node_name", "qos", "use_sim_time"]
NODE = {"namespace": "/llama", "node_name": "server"}


def parsed(*arguments: str) -> Read:
    return read(shlex.join(arguments), KNOWN, NODE)


@pytest.fixture
def file(tmp_path: Path) -> Path:
    return tmp_path / "with space.yaml"


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("serve ros --engine echo", "serve ros --engine echo"),
        ("serve ros --ros-args -r a:=b", "serve ros '--ros-args=-r a:=b'"),
        ("serve ros --ros-args -r a:=b -- --qos reliable", "serve ros --qos reliable '--ros-args=-r a:=b'"),
        ("serve ros --ros-args -r a:=b -- x --ros-args -p c:=d", "serve ros x '--ros-args=-r a:=b -p c:=d'"),
        ("serve ros --ros-args -r a:=b --ros-args -p c:=d", "serve ros '--ros-args=-r a:=b -p c:=d'"),
        ("serve ros --ros-args", "serve ros --ros-args="),
    ],
)
def test_they_become_the_value_of_one_flag(line: str, expected: str) -> None:
    assert folded(shlex.split(line)) == shlex.split(expected)


@pytest.mark.parametrize(
    ("arguments", "options"),
    [
        (["-r", "__ns:=/robot", "--remap", "__node:=brain"], {"namespace": "/robot", "node_name": "brain"}),
        (["-r", "a:=/b", "-r", "server:c:=d", "-r", "other:e:=f"], {"remap": ["a:=/b", "c:=d"]}),
        (["-p", "max_tokens:=7", "--param", "feedback_interval:=0.5"], {"max_tokens": 7, "feedback_interval": 0.5}),
        (["-p", "publish_tokens:=false", "-p", "engine:=echo"], {"publish_tokens": False, "engine": "echo"}),
        (["-p", "server:max_tokens:=7", "-p", "other:max_tokens:=8"], {"max_tokens": 7}),
        (["-p", "max_tokens:=7", "-p", "max_tokens:=8"], {"max_tokens": 8}),
        (["--log-level", "DEBUG"], {"log_level": "debug"}),
        (["--log-level", "llama.server:=warn", "--disable-stdout-logs"], {"log_level": "warn"}),
        ([], {}),
    ],
)
def test_each_says_an_option(arguments: list[str], options: dict[str, Any]) -> None:
    assert parsed(*arguments) == Read(options)


def test_an_enclave_reaches_rclpy_by_its_variable() -> None:
    assert parsed("--enclave", "/robot/brain").environ == {"ROS_SECURITY_ENCLAVE_OVERRIDE": "/robot/brain"}


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["-e"], "-e needs a value"),
        (["-r", "a=b"], "-r a=b should look like from:=to"),
        (["-p", "max_tokens"], "-p max_tokens should look like name:=value"),
        (["-p", "max_toks:=7"], "-p: 'max_toks' is not one of engine, max_tokens"),
        (["-p", "engine:=[a"], "-p engine:=.* is not YAML"),
        (["-p"], "-p needs a value"),
        (["--enclav", "x"], "--enclav is not one of -r, --remap"),
        (["--params-file", "/nowhere/x.yaml"], "`params_file`: cannot read /nowhere/x.yaml"),
    ],
)
def test_what_is_none_is_refused(arguments: list[str], message: str) -> None:
    with pytest.raises(UsageError, match=message):
        parsed(*arguments)


@pytest.mark.parametrize(
    "key", ["/llama/server", "/llama:\n  server", "/llama/*", "/**", "/**/server", "llama:\n  server"]
)
def test_a_file_has_sections_for_nodes(file: Path, key: str) -> None:
    indent = "    " if "\n" in key else "  "
    file.write_text(
        f"{key}:\n{indent}ros__parameters:\n{indent}  max_tokens: 9\n/other:\n  ros__parameters: {{x: 1}}\n"
    )
    assert parsed("--params-file", str(file)) == Read({"max_tokens": 9})


def test_sections_are_those_of_the_node_by_its_new_name(file: Path) -> None:
    file.write_text("/robot/brain:\n  ros__parameters: {qos: reliable}\n")
    assert parsed("--params-file", str(file), "-r", "__ns:=/robot", "-r", "__node:=brain").options["qos"] == "reliable"


def test_what_all_nodes_share_may_be_for_others(file: Path) -> None:
    others = "start_type_description_service: true, wheel: {radius: 1}"
    file.write_text(f"/**:\n  ros__parameters: {{use_sim_time: true, {others}, max_tokens: 4}}\n")
    found = parsed("--params-file", str(file))
    assert found.options == {"use_sim_time": True, "max_tokens": 4}
    (note,) = found.notes
    assert "wheel.radius is not a parameter of this node" in note


def test_a_file_for_others_is_said_to_be(file: Path) -> None:
    file.write_text("server:\n  ros__parameters: {max_tokens: 9}\n")
    assert parsed("--params-file", str(file)).notes == [
        f"--params-file {file} has nothing for /llama/server, only for /server"
    ]


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("a: [", "is not YAML"),
        ("a: 1", "has no 'ros__parameters'"),
        ("- a", "has no 'ros__parameters'"),
        ("", "has no 'ros__parameters'"),
        ("/llama/server:\n  ros__parameters: {wheel: 1}", r"/llama/server: 'wheel' is not one of engine"),
        ("!!python/object:os.system a", "is not YAML"),
    ],
)
def test_a_file_that_is_none_is_refused(file: Path, content: str, message: str) -> None:
    file.write_text(content)
    with pytest.raises(UsageError, match=message):
        parsed("--params-file", str(file))


def test_bytes_that_are_no_text_are_refused(file: Path) -> None:
    file.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(UsageError, match="`params_file`: cannot read"):
        parsed("--params-file", str(file))
