"""Server processes of the harness: start, wait until ready, detect their end, stop."""

from __future__ import annotations

import json
import os
import select
import socket
import subprocess
import sys
from abc import abstractmethod
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, suppress
from dataclasses import replace
from pathlib import Path
from selectors import EVENT_READ, DefaultSelector
from typing import IO, Any, cast

import httpx

from s2a_bench import errors
from s2a_bench.clock import SystemClock, now_ns
from s2a_bench.errors import COMPILE_AGAIN, SETUP_AGAIN, EngineError, PortInUse, ServerDied, UsageError, how_it_ended
from s2a_bench.harness import llama_wheel
from s2a_bench.harness.serving import ServerJob
from s2a_bench.inference import EngineConfig
from s2a_bench.inference.models import chat_template, load_headers
from s2a_bench.machine.tuning import start_child
from s2a_bench.provenance import NOT_SENT
from s2a_bench.transport import Program

READY_TIMEOUT_S = 600.0
"""A model of several GB may load from a slow disk."""
NOT_READY = f"was not ready after {READY_TIMEOUT_S:.0f} s"
STOP_TIMEOUT_S = 3.0
POLL_S = 1.0
"""Longest single wait for the end of a process."""


class ServerProcess(AbstractContextManager["ServerProcess"]):
    """A child process that serves; use as a context manager."""

    def __init__(self, name: str, command: list[str], log: Path | None, pass_fds: Sequence[int] = ()) -> None:
        """Start ``command``; its output goes to ``log``, without one to this process's standard error."""
        self.name = name
        self.log = log
        self.address = ""
        self.facts: dict[str, Any] = {}
        self._log: IO[bytes] | None = log.open("wb") if log else None
        self._process = start_child(
            command,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE if self._speaks_json else self._log,
            stderr=self._log,
            pass_fds=pass_fds,
            start_new_session=True,  # Ctrl-C is the harness's to handle
        )

    _speaks_json = True
    _cure = SETUP_AGAIN

    @abstractmethod
    def wait_ready(self) -> None:
        """Return when requests can be sent; raises ServerDied, or the error that the server reports."""

    @property
    def pid(self) -> int:
        return self._process.pid

    def alive(self) -> bool:
        return self._process.poll() is None

    def ends_within(self, timeout_s: float) -> bool:
        try:
            self._process.wait(timeout_s)
        except subprocess.TimeoutExpired:
            return False
        return True

    def wait_end(self) -> None:
        """Wait until the process has ended.

        Popen.wait keeps its lock if a signal arrives while it takes it, and then can never be called again. Every wait
        has an end, as a signal just before a wait does not interrupt it.
        """
        ended = os.pidfd_open(self.pid)
        try:
            while not select.select([ended], [], [], POLL_S)[0]:
                pass
        finally:
            os.close(ended)
        self._process.wait()

    def death(self) -> ServerDied:
        end = how_it_ended(self._process.poll(), self._cure)
        return ServerDied(f"the {self.name} server (pid {self.pid}) died, {end}{self._last_lines(1)}")

    def no_start(self, why: str = "") -> ServerDied:
        """Describe a failed start by the last lines of its output."""
        why = why or f"did not start, {how_it_ended(self._process.poll(), self._cure)}"
        return ServerDied(f"the {self.name} server {why}{self._last_lines(4)}")

    def _last_lines(self, count: int) -> str:
        """Return the end of the log and where it is; a run keeps the folder of a log that its error names."""
        if self.log is None:
            return ""
        lines = self.log.read_text(errors="replace").strip().splitlines()[-count:]
        shown = f": {' / '.join(line.strip()[:200] for line in lines)}" if lines else ""
        return f"{shown}; its log is {self.log}"

    def stop(self) -> None:
        """End the process, by force after `STOP_TIMEOUT_S` or at a second Ctrl-C."""
        try:
            self._ask_to_stop()
            self._process.wait(STOP_TIMEOUT_S)
        except (subprocess.TimeoutExpired, KeyboardInterrupt):
            self._process.kill()
            self._process.wait()
        finally:
            for pipe in (self._process.stdin, self._process.stdout, self._log):
                if pipe is not None:
                    pipe.close()

    def _ask_to_stop(self) -> None:
        self._process.terminate()

    def __exit__(self, *_: object) -> None:
        self.stop()


class OwnProcess(ServerProcess):
    """A module of this package: it reads its job as one line, answers with one, and serves until its input ends."""

    def __init__(self, name: str, module: str, job: str, log: Path | None, pass_fds: Sequence[int] = ()) -> None:
        super().__init__(name, [sys.executable, "-m", module], log, pass_fds)
        self._input, self._output = cast("tuple[IO[bytes], IO[bytes]]", (self._process.stdin, self._process.stdout))
        with suppress(BrokenPipeError):  # it has ended: `wait_ready` says how
            self._input.write(job.encode() + b"\n")
            self._input.flush()

    def _ask_to_stop(self) -> None:
        with suppress(BrokenPipeError):  # it never read its job
            self._input.close()

    def ask(self) -> dict[str, Any]:
        """Send an empty line, and return the JSON line that a relay answers with; raises ServerDied."""
        try:
            self._input.write(b"\n")
            self._input.flush()
            answer: dict[str, Any] = json.loads(self._output.readline())
        except (OSError, ValueError):
            self.ends_within(STOP_TIMEOUT_S)
            raise self.death() from None
        return answer

    def wait_ready(self) -> None:
        with DefaultSelector() as selector:
            selector.register(self._output, EVENT_READ)
            if not selector.select(READY_TIMEOUT_S):
                raise self.no_start(NOT_READY)
        line = self._output.readline()
        if not line.endswith(b"\n"):
            self.ends_within(STOP_TIMEOUT_S)  # dumping core, perhaps
            self._process.kill()
            self._process.wait()
            raise self.no_start()
        answer = json.loads(line)
        if "error" in answer:
            kind = getattr(errors, answer["kind"], EngineError)
            raise kind(answer["error"])
        self.address = answer.pop("address")
        self.facts |= answer


class OwnServer(OwnProcess):
    """The instrumented server, `harness.serving`."""

    def __init__(self, name: str, job: ServerJob, log: Path | None = None) -> None:
        super().__init__(name, "s2a_bench.harness.serving", job.to_json(), log)


def keep_serving(job: ServerJob, ready: Callable[[ServerProcess], None], died: Callable[[str], None]) -> None:
    """Serve until KeyboardInterrupt, restarting the server once; raises ServerDied when it dies again.

    ``ready`` is called after every start, ``died`` with one line after the first death. The second server keeps the
    first one's address.
    """

    def serve(job: ServerJob) -> tuple[str, ServerDied]:
        with OwnServer(job.wiring.transport, job) as server:
            server.wait_ready()
            ready(server)
            server.wait_end()
            return server.address, server.death()

    with suppress(KeyboardInterrupt):  # Ctrl-C is how a user ends it
        address, death = serve(job)
        died(f"{death}; it is started again, once")
        _, death = serve(replace(job, wiring=replace(job.wiring, address=address, restarted=True)))
        raise death


ALL_LAYERS = 999
NO_GPU = "no usable GPU found"
"""llama.cpp's log line when it ignores --n-gpu-layers."""


def llama_flags(engine: EngineConfig) -> list[str]:
    """Return flags under which ``llama-server`` and ``llama-bench`` compute as the llama engine does.

    By default they use every CPU of this process, and no GPU.
    """
    batch = str(min(engine.batch, engine.context))
    flags = {
        "--model": str(engine.model),
        "--threads": str(engine.threads or len(os.sched_getaffinity(0))),
        "--n-gpu-layers": str(engine.gpu_layers if engine.gpu_layers >= 0 else ALL_LAYERS),
        "--batch-size": batch,
        "--ubatch-size": batch,
        "--cache-type-k": engine.kv_type,
        "--cache-type-v": engine.kv_type,
        "--flash-attn": engine.flash_attention,
    }
    return [text for pair in flags.items() for text in pair]


class LlamaServerProcess(ServerProcess):
    """llama.cpp's own server on the same model files: a black box."""

    _speaks_json = False
    _cure = COMPILE_AGAIN

    def __init__(self, program: Program, engine: EngineConfig, log: Path, *, ignore_end: bool) -> None:
        """Start the program on its port, or any free one for 0."""
        port = _free_port(program.port)
        command = [str(program.path.absolute()), *llama_flags(engine)]
        command += ["--mmproj", str(engine.mmproj)] if engine.mmproj else []
        command += ["--jinja", "--chat-template", template] if (template := chat_template(engine)) else []
        command += ["--host", "127.0.0.1", "--port", str(port), "--ctx-size", str(engine.context), "--parallel", "1"]
        self._on_gpu = engine.gpu_layers != 0
        if engine.mmproj and not self._on_gpu:
            command.append("--no-mmproj-offload")
        if ignore_end:
            command.append("--ignore-eos")
        super().__init__("llama-server", command, log)
        self.address = f"http://127.0.0.1:{port}"
        self.facts = {"command": command}

    def wait_ready(self) -> None:
        clock = SystemClock()
        deadline = now_ns() + int(READY_TIMEOUT_S * 1e9)
        while now_ns() < deadline:
            if not self.alive():
                raise self.no_start()
            try:
                # alive: the port was free only until `_free_port` closed it, so another server may answer
                ready = httpx.get(self.address + "/health", trust_env=False).is_success and self.alive()
            except httpx.TransportError:
                ready = False  # it does not listen yet
            if ready and self._on_gpu and self.log is not None and NO_GPU in self.log.read_text(errors="replace"):
                raise UsageError("`gpu_layers`: this `llama_server` finds no GPU; name another, or leave it out")
            if ready:
                return
            clock.sleep_until_ns(now_ns() + 100_000_000)
        raise self.no_start(NOT_READY)


class WheelServer(OwnProcess):
    """llama.cpp's own server from the wheel xllamacpp: a black box in a process of this package."""

    _cure = COMPILE_AGAIN

    def __init__(self, program: Program, engine: EngineConfig, log: Path, *, ignore_end: bool) -> None:
        job = llama_wheel.server_settings(engine, program.port, ignore_end=ignore_end)
        super().__init__("llama-server", llama_wheel.__name__, json.dumps(job), log)
        self.facts = {"told": job}


PROGRAMS: dict[str, Callable[..., ServerProcess]] = {
    "llama-server": LlamaServerProcess,
    "llama-server-wheel": WheelServer,
}
"""Kind of a transport's `Program` -> how it is started."""


def start_program(program: Program, engine: EngineConfig, log: Path, *, has_grammar: bool) -> ServerProcess:
    """Start another server on the model files of ``engine``.

    Dummy weights end at random: without a grammar they generate up to the token limit, as in the llama engine.
    """
    files = load_headers(engine)
    process = PROGRAMS[program.kind](program, engine, log, ignore_end=files.dummy and not has_grammar)
    process.facts["engine"] = {
        "engine": "llama-server",
        **files.describe(),
        **({} if files.mmproj else {"pictures": NOT_SENT}),  # it refuses pictures that its model does not see
    }
    return process


def _free_port(wanted: int) -> int:
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)  # else a connection in TIME_WAIT holds the port
        try:
            probe.bind(("127.0.0.1", wanted))
            probe.listen()
        except OSError as error:
            raise PortInUse(
                f"`port`: {wanted} cannot be had on 127.0.0.1 ({error.strerror}); choose another, or 0 for any free one"
            ) from error
        return int(probe.getsockname()[1])
