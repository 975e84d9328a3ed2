"""`s2a-bench latency --url` against servers that are not ours, as a user runs it."""

from __future__ import annotations

import csv
import json
import signal
import subprocess
from collections.abc import Iterator
from pathlib import Path
from threading import Event

import pytest

from s2a_bench.testing.transport import RecordingHandler
from s2a_bench.types import Token
from tests.cli.program import called, command, only_run, printed
from tests.servers.sockets import Received, head, serving
from tests.servers.speakers import Cloud, Ollama, answering

SMALL = ["--transport", "http", "--size", "64x48", "--requests", "2", "--warmup", "1", "--max-tokens", "3"]
KEY = "sekret-0123456789"


def run(*arguments: str, output: Path, code: int = 0) -> subprocess.CompletedProcess[str]:
    return called("latency", *SMALL, *arguments, "--output", output, code=code)


def test_ollama_is_measured_and_its_key_is_kept_nowhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MY_KEY", KEY)
    keys = []
    reply = answering(Ollama(), RecordingHandler(["go", "_to"]))

    def keyed(received: Received) -> object:
        keys.append(received.headers["authorization"])
        return reply(received)

    with serving(keyed) as url:  # type: ignore[arg-type]
        done = run("--url", url, "--dialect", "ollama", "--api-key-env", "MY_KEY", "--json", output=tmp_path)
    assert set(keys) == {f"Bearer {KEY}"}
    result = printed(done)
    assert [(cell["variant"], cell["n"], cell["errors"]) for cell in result["cells"]] == [
        ("as-deployed", 2, 0),
        ("best-effort", 2, 0),
    ]
    assert all("server" in cell["stages_ms"] and "inference" not in cell["stages_ms"] for cell in result["cells"])
    folder = Path(result["run"])
    manifest = json.loads((folder / "manifest.json").read_text())
    assert manifest["asked"]["http/as-deployed"] == {"url": url + "/api/chat", "dialect": "ollama"}
    with (folder / "samples.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert {row["server_prompt_ms"] for row in rows} == {"100.0"}
    assert all(json.loads(row["facts"])["outside_model_ms"] == pytest.approx(10.0) for row in rows)
    assert not [path for path in folder.rglob("*") if path.is_file() and KEY.encode() in path.read_bytes()]
    assert KEY not in done.stdout + done.stderr


def test_a_request_under_way_when_the_run_is_interrupted_has_its_row(tmp_path: Path) -> None:
    requests, under_way, over = 0, Event(), Event()
    speaker = Cloud()

    def reply(received: Received) -> Iterator[bytes]:
        nonlocal requests
        if received.method != "POST":
            yield head("404 Not Found")
            return
        requests += 1
        yield head(kind=speaker.kind) + speaker.token(Token(0, "go"))
        if requests == 3:
            under_way.set()
            over.wait(60)
        yield speaker.closing([Token(0, "go")])

    flags = (*SMALL, "--transport", "http/as-deployed", "--output", tmp_path)
    with serving(reply) as url:
        process = subprocess.Popen(command("latency", *flags, "--url", url), stderr=subprocess.PIPE, text=True)
        assert under_way.wait(60)
        process.send_signal(signal.SIGINT)
        _, output = process.communicate(timeout=60)
        over.set()
    assert process.returncode == 130, output
    run = only_run(tmp_path)
    assert run.manifest["state"] == "interrupted"
    *before, last = run.samples["error"]
    assert before == ["", ""]
    assert last.startswith("Interrupted: the run was ended during this request")
    assert "failed-samples" not in output
