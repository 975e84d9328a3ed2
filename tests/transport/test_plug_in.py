"""A transport of somebody else's package needs nothing here but its entry point."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from importlib.metadata import EntryPoint
from pathlib import Path
from typing import Any, ClassVar

import pytest

from s2a_bench import registry
from s2a_bench.experiments.latency.config import LatencyConfig
from s2a_bench.experiments.latency.run import run_latency
from s2a_bench.experiments.latency.view import stage_table
from s2a_bench.experiments.latency.view.figures import latency_figures
from s2a_bench.experiments.requests import cells_of
from s2a_bench.inference import EngineConfig
from s2a_bench.options import option
from s2a_bench.store.run import StoredRun, read_run
from s2a_bench.testing import NullProgress
from s2a_bench.trace import Trace
from s2a_bench.transport import (
    SERVER,
    TRANSPORTS,
    Client,
    Handler,
    Server,
    Transport,
    TransportOptions,
    Wiring,
    declared_transport,
)
from s2a_bench.transport.loopback.in_process import LoopbackClient, LoopbackServer
from s2a_bench.types import Request, Token


class ToyOptions(TransportOptions):
    number: int = option(1, "a number", ge=1, side=SERVER)
    greeting: str = option("hello", "a word")


class ToyClient(LoopbackClient):
    def request(self, request: Request, trace: Trace) -> Iterator[Token]:
        trace.mark("greet")
        yield from super().request(request, trace)


class Toy(Transport[ToyOptions]):
    name = "toy"
    options = ToyOptions
    stages: ClassVar[dict[str, str]] = {"greet": "pack", "hand_over": "parse"}
    style: ClassVar[dict[str, tuple[str, str]]] = {"": ("#123456", "-")}
    packages = ("pytest",)
    in_process = True

    def client(self, wiring: Wiring[ToyOptions], alive: Callable[[], bool]) -> Client:
        return ToyClient(wiring, alive)  # type: ignore[arg-type]

    def server(self, wiring: Wiring[ToyOptions], handler: Handler) -> Server:
        return LoopbackServer(wiring, handler)  # type: ignore[arg-type]


TOY = Toy()


def offer(monkeypatch: pytest.MonkeyPatch, offered: object) -> None:
    """Offer an object as the transport ``toy``, as an installed package would."""
    monkeypatch.setattr(EntryPoint, "load", lambda _point: offered)
    point = EntryPoint("toy", "toy:TOY", TRANSPORTS.group)
    monkeypatch.setattr(registry, "entry_points", lambda group: [point] if group == TRANSPORTS.group else [])
    forget()


def forget() -> None:
    vars(TRANSPORTS).pop("_offered", None)
    declared_transport.cache_clear()


@pytest.fixture
def toy(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    offer(monkeypatch, TOY)
    yield
    monkeypatch.undo()
    forget()


@pytest.fixture
def run(toy: None, tmp_path: Path) -> StoredRun:  # noqa: ARG001 - what is measured
    names = ("loopback", "toy", "toy?greeting=servus", "toy?number=2")
    few: dict[str, Any] = {"requests": 3, "warmup": 1, "max_tokens": 3, "sample_resources_hz": 0}
    config = LatencyConfig(transports=names, payload=("raw",), engine=EngineConfig(name="echo"), size=(64, 48), **few)
    return read_run(run_latency(config, tmp_path, NullProgress()))


def test_its_folder_reads_where_the_package_is_not(run: StoredRun, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.undo()
    forget()
    assert "toy" not in TRANSPORTS
    read = read_run(run.path)
    assert [cell.name for cell in cells_of(read)][-3:] == ["toy", "toy?greeting=servus", "toy?number=2"]
    assert ("pack", "greet") in {row[:2] for row in stage_table(read).rows}
    assert [draw() for draw in latency_figures(read).values()]


@pytest.mark.usefixtures("toy")
def test_a_stage_that_nobody_declares_makes_the_sample_an_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Toy, "stages", {})
    engine = EngineConfig(name="echo")
    config = LatencyConfig(
        transports=("toy", "loopback"), payload=("raw",), engine=engine, size=(64, 48), requests=2, warmup=0
    )
    with pytest.raises(Exception, match="toy does not declare the stage greet"):
        run_latency(config, tmp_path, NullProgress())
