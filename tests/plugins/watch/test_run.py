"""A watch as a user has it: a server, a tap and a robot; what it keeps, and what others make of that."""

from __future__ import annotations

import json
import re
import signal
import socket
import subprocess
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from threading import Thread
from time import sleep
from typing import Any

import httpx
import numpy as np
import pytest

import s2a_bench as s2a
from s2a_bench.experiments.cells import Cells
from s2a_bench.plugins.watch.config import WatchTap
from s2a_bench.plugins.watch.rows import EXCHANGES, ExchangeRow
from s2a_bench.plugins.watch.run import run_tap
from s2a_bench.plugins.watch.view import SEEN
from s2a_bench.progress import NullProgress
from s2a_bench.provenance import AT_TAP
from s2a_bench.store.run import StoredRun, read_run
from s2a_bench.testing.transport import RecordingHandler, ask, served, wiring_of, yuyv_frame
from s2a_bench.transport import open_client
from s2a_bench.types import Request
from tests.cli.program import command, only_run, refused
from tests.waiting import until

OPENPI = "websocket/openpi"
CHUNK = RecordingHandler(list(np.ones((8, 7), np.float32)))
LINE = re.compile(r"listening at (\S+):")


class Said(NullProgress):
    def __init__(self) -> None:
        self.lines: list[str] = []

    def say(self, line: str) -> None:
        self.lines.append(line)

    @property
    def address(self) -> str:
        until(lambda: self.lines)
        found = LINE.match(self.lines[0])
        assert found
        return found[1]


@contextmanager
def watched(to: str, output: Path, **options: Any) -> Iterator[Said]:
    """Watch in this process, until ``requests`` have been seen."""
    said, failed = Said(), list[Exception]()

    def run() -> None:
        try:
            run_tap(WatchTap(to=to, **options), output, said)
        except Exception as error:  # noqa: BLE001 - raised below
            failed.append(error)
            said.lines.append("listening at nothing:")

    thread = Thread(target=run)
    thread.start()
    yield said
    thread.join()
    if failed:
        raise failed[0]


def rows_of(run: StoredRun) -> list[ExchangeRow]:
    return Cells.of(run, EXCHANGES).rows


@pytest.fixture(scope="module")
def robot(tmp_path_factory: pytest.TempPathFactory) -> tuple[StoredRun, StoredRun]:
    """Return the run of a watch, and that of the client that it watched: the same 12 requests."""
    folder = tmp_path_factory.mktemp("robot")
    with served(wiring_of(OPENPI), CHUNK) as (server, _):
        with watched(server.address, folder / "tap", requests=12, control_hz=50) as said:
            given: dict[str, Any] = {"url": said.address, "horizon": 8, "size": "64x48", "payload": "raw"}
            client = s2a.latency(transport=OPENPI, requests=10, warmup=2, output=folder / "client", **given)
        return only_run(folder / "tap"), read_run(client.path)


def test_each_exchange_lies_within_what_its_client_saw(robot: tuple[StoredRun, StoredRun]) -> None:
    """On one clock: the request after it was packed and before its answer, whose end the client marks as last."""
    tap, client = robot
    samples = client.samples.sort_values("position")
    assert len(samples) == len(rows_of(tap)) == 12
    for row, (_, sample) in zip(rows_of(tap), samples.iterrows(), strict=True):
        marks = dict(json.loads(sample["marks"]))
        spent_ns = (row.upload_ns or 0) + (row.server_ns or 0) + (row.inference_ns or 0)
        assert marks["msgpack_pack"] <= row.request_ns
        assert row.request_ns + spent_ns <= max(marks.values())
        assert (row.error, row.pieces, row.horizon, row.dim) == ("", 0, 8, 7)
        assert row.up_bytes == sample["payload_bytes"]


def test_the_parts_add_up_to_the_period(robot: tuple[StoredRun, StoredRun]) -> None:
    before, *others = rows_of(robot[0])
    for row in others:
        parts = (before.upload_ns, before.server_ns, before.inference_ns, before.download_ns, row.think_ns)
        assert row.period_ns == sum(part or 0 for part in parts)
        before = row


def test_what_it_shows_says_where_it_was_seen(robot: tuple[StoredRun, StoredRun]) -> None:
    run = s2a.load(robot[0].path)
    assert run.manifest["sends"] == {"websocket /": "1 picture 64x48 uint8, 2 texts, 1 number; as JPEG about 2 kB"}
    assert AT_TAP.upper() in robot[0].origins.line
    assert "8 actions last 160 ms at 50 Hz" in " ".join(run._shown.sentences)
    assert SEEN in run._shown.tables["watch"].notes
    (cell,) = run.json()["cells"]
    assert (cell["cell"], cell["n"], cell["errors"], cell["horizon"]["median"]) == ("websocket /", 12, 0, 8)


def test_its_run_is_food_for_the_others(robot: tuple[StoredRun, StoredRun], tmp_path: Path) -> None:
    cell = f"{robot[0].path}#websocket /"
    chunks = s2a.chunks(latency=cell, horizon=8, cycles=20, output=tmp_path)
    assert chunks.table("chunks").shape[0]
    predicted = s2a.capacity(mode="predicted", predict=cell, robots="1..2", seconds=1, output=tmp_path)
    assert "from the engine's start to its last piece" in " ".join(predicted._shown.sentences)
    assert {"period_s", "server_s"} <= {*s2a.compare(robot[0].path, robot[0].path).table()["metric"]}


def test_no_key_and_no_body_is_written(tmp_path: Path) -> None:
    secret, body = "sk-very5ecretkey", "what the robot was told"
    with (
        served(wiring_of("http"), RecordingHandler(["le", "ft"])) as (server, _),
        watched(server.address, tmp_path, requests=3) as said,
        httpx.Client(base_url=said.address) as client,
    ):
        asked = {"messages": [{"role": "user", "content": body}], "stream": True}
        for path in ("/v1/chat/completions", f"/v1/chat/completions?key={secret}"):
            answer = client.post(path, json=asked, headers={"Authorization": f"Bearer {secret}"})
            assert "le" in answer.text
        assert client.get(f"/{secret}?key={secret}").status_code == 404
    run = only_run(tmp_path)
    assert [row.pieces for row in rows_of(run)] == [2, 2, 0]
    assert [row.error for row in rows_of(run)] == ["", "", "HTTP 404"]
    written = b"".join(path.read_bytes() for path in run.path.rglob("*") if path.is_file())
    assert body.encode() not in written
    assert secret.encode() not in written
    assert [*run.tokens.groupby("request_id").size()] == [2, 2]


@pytest.mark.parametrize("sleep_ms", [5, 50, 200])
def test_a_server_that_sleeps_is_as_slow_as_it_is(sleep_ms: int, tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as listener:

        def answer() -> None:
            with listener.accept()[0] as connection:
                while connection.recv(100):
                    sleep(sleep_ms / 1e3)
                    connection.sendall(b"y")

        serving = Thread(target=answer)
        serving.start()
        to = "tcp://{}:{}".format(*listener.getsockname())
        with watched(to, tmp_path, requests=4) as said:
            host, _, port = said.address.partition("//")[2].rpartition(":")
            with socket.create_connection((host, int(port))) as client:
                for _ in range(4):
                    client.sendall(b"x")
                    client.recv(1)
                    sleep(0.02)
        serving.join()
    rows = rows_of(only_run(tmp_path))
    assert [row.cell for row in rows] == ["turns"] * 4
    assert all(sleep_ms * 1e6 <= (row.server_ns or 0) for row in rows)
    assert all((row.think_ns or 0) >= 20 * 1e6 for row in rows[1:])
    assert "read by turns" in said.lines[1]


@contextmanager
def program(to: str, output: Path, *more: str) -> Iterator[tuple[subprocess.Popen[str], str]]:
    """Watch in a process of its own; return it and its address."""
    line = command("watch", "--to", to, "--output", output, *more)
    with subprocess.Popen(line, stderr=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        assert process.stderr
        found = LINE.match(process.stderr.readline())
        assert found
        yield process, found[1]
        process.kill()


@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGTERM, signal.SIGKILL])
def test_what_was_seen_is_kept_however_it_ends(how: signal.Signals, tmp_path: Path) -> None:
    with served(wiring_of(OPENPI), CHUNK) as (server, _), program(server.address, tmp_path) as (process, address):
        with closing(open_client(wiring_of(OPENPI, address))) as client:
            for number in range(5):
                ask(client, Request(f"r-{number}", "go", (yuyv_frame(),), 8))
            run = only_run(tmp_path)
            until(lambda: (run.path / "tokens.csv").exists() and len(rows_of(read_run(run.path))) == 5)
            process.send_signal(how)
            process.wait()
        printed = process.stdout.read() if process.stdout else ""
    run = only_run(tmp_path)
    assert len(rows_of(run)) == len(run.samples) == 5
    killed = how is signal.SIGKILL
    assert run.manifest["state"] == ("running" if killed else "finished")
    assert (run.path / "exchanges.parquet").exists() != killed
    assert ("Where a cycle's time goes" in printed) != killed
    assert process.returncode == (-how if killed else 0)


def test_nothing_seen_is_one_line_and_no_folder(tmp_path: Path) -> None:
    with served(wiring_of(OPENPI), CHUNK) as (server, _):
        line = refused("watch", "--to", server.address, "--seconds", "0.2", "--output", tmp_path / "out", code=1)
    assert re.search(r"no exchange was seen over 0 connections; let the robot connect to ws://127.0.0.1:\d+", line)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("options", "line"),
    [
        ((), "--to is needed"),
        (("--to", "ftp://a"), "--to: 'ftp://a' should start with http://"),
        (("--to", "ros://a"), "--to: 'ros://a' should start with http://"),
        (("--to", "tcp://a"), "--to: 'tcp://a' should end with a port"),
        (("--to", "ws://a", "--listen", "0.0.0.0:0"), "--listen: others reach 0.0.0.0, and the server through it; "),
        (("--to", "ws://localhost:81", "--listen", "81"), "--listen: 81 is the server's own port"),
        (("--to", "ws://a", "--listen", "127.0.0.1:99999"), "--listen: cannot bind 127.0.0.1:99999"),
        (("--to", "ws://a", "--listen", "here"), "--listen: 'here' should match"),
        (("--to", "ws://a", "--control-hz", "0"), "--control-hz: 0"),
    ],
)
def test_wrong_use_is_one_line(options: tuple[str, ...], line: str, tmp_path: Path) -> None:
    said = refused("watch", *options, "--output", tmp_path / "out", code=1 if "cannot bind" in line else 2)
    assert said.startswith(f"error: {line}")
    assert not (tmp_path / "out").exists()


def test_a_plain_port_listens_on_this_machine() -> None:
    with WatchTap(to="http://gpu-box", listen="0").bound() as listener:
        assert listener.getsockname()[0] == "127.0.0.1"
    assert WatchTap(to="http://gpu-box").server == ("gpu-box", 80)
    with WatchTap(to="http://gpu-box", listen="0.0.0.0:0", no_auth=True).bound() as listener:
        assert listener.getsockname()[0] == "0.0.0.0"  # noqa: S104
