"""A replay behind `--url` or `--action` is labelled as one; a black box is unknown."""

from __future__ import annotations

import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from s2a_bench.store.run import StoredRun
from s2a_bench.testing.transport import RecordingHandler
from tests.cli.program import called, command, only_run
from tests.servers.sockets import serving as serving_socket
from tests.servers.speakers import Cloud, answering

SMALL = ("--size", "64x48", "--requests", "2", "--warmup", "1", "--max-tokens", "3", "--data-only")


@contextmanager
def serving(*arguments: str) -> Iterator[str]:
    """Serve and yield the first line."""
    process = subprocess.Popen(
        command("serve", *arguments), stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
    )
    try:
        yield process.stdout.readline()
    finally:
        process.kill()
        process.communicate()


def measured(output: Path, *arguments: str) -> tuple[StoredRun, str]:
    """Measure and return the run with what was printed."""
    done = called("latency", *SMALL, *arguments, "--output", output)
    return only_run(output), done.stdout


def test_a_replay_behind_a_url_is_emulated(tmp_path: Path) -> None:
    with serving("http", "--engine", "replay", "--profile", "rtx-4080", "--port", "0") as line:
        assert "engine replay of rtx-4080 (EMULATED); Ctrl-C ends it" in line
        url = line.split()[2].rstrip(";").split("/v1")[0]
        run, output = measured(tmp_path, "--transport", "http/as-deployed", "--url", url)
    (origin,) = run.origins.every
    assert (origin.engine, origin.tokens, origin.profile) == ("replay", "emulated", "rtx-4080")
    assert set(run.samples["engine"]) == {"replay"}
    assert set(run.samples["provenance"]) == {"replay/none/emulated"}
    assert "EMULATED" in output


def test_a_server_that_does_not_tell_is_unknown_never_the_default(tmp_path: Path) -> None:
    with serving_socket(answering(Cloud(), RecordingHandler(["x", "y"]))) as url:
        run, output = measured(tmp_path, "--transport", "http/as-deployed", "--url", url, "--dialect", "openai")
    assert set(run.samples["engine"]) == {"unknown"}
    assert [(origin.known, origin.link) for origin in run.origins.cells.values()] == [(False, "real")]
    assert "engine UNKNOWN" in output
