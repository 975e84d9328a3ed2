"""Every code block of the pages is run: those of a page in their order, in one folder.

The first word after three backticks says what a block is. `console` is commands after ``$ ``, with what they print;
`python` and `sql` run as they stand; `toml` and `json` are parsed; `text` and `latex` are only shown. The words after
it say what the block needs: the extras by their names, and `NEEDS`. The command of a `SERVER` block runs until it is
ended, as in a terminal of its own; a `CLIENT` block runs beside the last of them before it. A block that begins with
``# NAME.EXT`` is a file of the page's folder. `make docs` runs the slow ones too. Of lines that stand in by four
spaces, which set a machine up, the commands are parsed.
"""

from __future__ import annotations

import json
import os
import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext, suppress
from importlib.metadata import PackageNotFoundError, distribution, requires
from itertools import dropwhile, groupby
from pathlib import Path
from typing import Any, Final, NamedTuple

import pytest
import typer
from packaging.requirements import Requirement
from typer.main import get_command

from s2a_bench import extras
from s2a_bench.cli import app
from s2a_bench.cli.ros_args import folded
from s2a_bench.toml_file import loads

ROOT: Final = Path(__file__).parent.parent
PAGES: Final = sorted(
    path
    for pattern in ("*.md", "docs/**/*.md", "studies/*.md", "results/reference/*.md")
    for path in ROOT.glob(pattern)
    if path.name != "CHANGELOG.md"
)
FENCE: Final = re.compile(r"^```(\w*)(.*)\n((?s:.*?))^```$", re.MULTILINE)
NEEDS: Final[dict[str, tuple[Callable[[], object], str]]] = {
    "slow": (lambda: "S2A_DOCS" in os.environ, "some seconds: make docs"),
    "minutes": (lambda: "S2A_DOCS" in os.environ, "minutes: make docs"),
    "camera": (lambda: Path("/dev/video0").exists(), "a camera"),
    "duckdb": (lambda: extras.installed("duckdb"), "DuckDB"),
    "gpu": (lambda: shutil.which("nvidia-smi"), "an NVIDIA GPU"),
    "metaworld": (lambda: extras.installed("metaworld"), "Meta-World"),
    "link": (lambda: os.access("/dev/net/tun", os.R_OK | os.W_OK), "TUN devices and network namespaces"),
    "pdflatex": (lambda: shutil.which("pdflatex"), "pdflatex"),
    "internet": (lambda: False, "the internet"),
    "peer": (lambda: False, "a robot, a server or another machine of the reader's"),
    "setup": (lambda: False, "changes the machine; CI does it, or tests/recipes"),
}
"""Word -> whether it is there, and what it is, for people."""
SERVER: Final = "server"
CLIENT: Final = "client"
COMMENT: Final = re.compile(r"(?:^|\s)#\s(.*)$")
WAIT_S: Final = 900


class Block(NamedTuple):
    """A code block of a page."""

    page: Path
    line: int
    language: str
    needs: list[str]
    code: str
    before: str
    """The text between the block before and this one."""

    def __str__(self) -> str:
        return f"{self.page.relative_to(ROOT)}:{self.line}"

    @property
    def commands(self) -> list[str]:
        """The commands of a session, whole."""
        if self.language != "console":
            return []
        wrapped = re.findall(r"^\$ ((?:.*\\\n> )*.*)$", self.code, re.MULTILINE)
        return [command.replace("\\\n> ", "") for command in wrapped]

    @property
    def server(self) -> Block | None:
        """The block whose server runs meanwhile."""
        if SERVER in self.needs:
            return self
        before = (each for each in BLOCKS if each.page == self.page and each.line < self.line and SERVER in each.needs)
        return [*before][-1] if CLIENT in self.needs else None


def blocks() -> Iterator[Block]:
    for page in PAGES:
        text, end = page.read_text(encoding="utf-8"), 0
        for found in FENCE.finditer(text):
            line = text.count("\n", 0, found.start()) + 1
            needs = [word.strip(",") for word in found[2].split()]
            yield Block(page, line, found[1], needs, found[3], text[end : found.start()])
            end = found.end()


BLOCKS: Final = [*blocks()]
RUN: Final = [block for block in BLOCKS if block.language in {"console", "python", "sql"}]


def there(extra: str) -> bool:
    """Whether all that an extra brings is installed."""
    for each in map(Requirement, requires("s2a-bench") or ()):
        if each.marker and each.marker.evaluate({"extra": extra}) and not each.marker.evaluate({"extra": ""}):
            try:
                distribution(each.name)
            except PackageNotFoundError:
                return False
            if not all(map(there, each.extras)):
                return False
    return True


def lacking(block: Block) -> Iterator[str]:
    for need in block.needs:
        if need in NEEDS:
            found, what = NEEDS[need]
            if not found():
                yield what
        elif need not in {SERVER, CLIENT} and not there(need):
            yield f"the extra {need}"


@pytest.fixture(scope="module")
def folders(tmp_path_factory: pytest.TempPathFactory) -> Callable[[Path], Path]:
    """Return each page's folder, with the reference runs, two runs A and B, two environments, a board, a model."""
    made: dict[Path, Path] = {}

    def folder(page: Path) -> Path:
        if page not in made:
            made[page] = found = tmp_path_factory.mktemp(page.stem)
            (found / "results").mkdir()
            (found / "results" / "reference").symlink_to(ROOT / "results" / "reference")
            for run in "AB":
                (found / run).symlink_to(ROOT / "results" / "reference" / "bench-raw")
            for environment in ("old", "new"):
                (found / environment).symlink_to(sys.prefix)
            (found / "profiles").mkdir()
            shutil.copy(ROOT / "results/reference/vm-2core-full-dummy.toml", found / "profiles" / "my-board.toml")
            if there("model"):
                from s2a_bench.inference.models import tiny_dummy

                for name, file in zip(("model.gguf", "mmproj.gguf"), tiny_dummy(), strict=True):
                    (found / name).symlink_to(file)
        return made[page]

    return folder


@pytest.mark.slow
@pytest.mark.parametrize("block", RUN, ids=str)
def test_an_example_runs(block: Block, folders: Callable[[Path], Path]) -> None:
    if without := ", ".join(lacking(block)):
        pytest.skip(f"{block} needs: {without}")
    folder = folders(block.page)
    for other in BLOCKS:
        if other.page == block.page and (name := re.match(r"# ([\w-]+\.\w+)$", other.code, re.MULTILINE)):
            (folder / name[1]).write_text(other.code)
    if block.language == "sql":
        duckdb: Any = pytest.importorskip("duckdb")
        with pytest.MonkeyPatch.context() as patch:
            patch.chdir(folder)
            assert duckdb.sql(block.code).fetchall()
    if block.language == "python":
        run([sys.executable, "-W", "error", "-c", block.code], folder)
    with serving(block.server.commands[0], folder) if block.server else nullcontext():
        for command in block.commands if block.server != block else ():
            run(["bash", "-c", command], folder)


def environ() -> dict[str, str]:
    path = f"{Path(sys.executable).parent}:{os.environ['PATH']}"
    return os.environ | {"PATH": path, "PYTHONPATH": str(ROOT), "XDG_CONFIG_HOME": "."}


def run(command: list[str], folder: Path) -> None:
    """Run a program, which succeeds or ends with one of the exit codes that its comment names."""
    done = subprocess.run(
        command, cwd=folder, env=environ(), capture_output=True, text=True, check=False, timeout=WAIT_S
    )
    codes = [
        0,
        *(int(code) for comment in COMMENT.findall(command[-1]) for code in re.findall(r"exit code (\d)", comment)),
    ]
    assert done.returncode in codes, f"{command[-1]}\n{done.stdout[-2000:]}\n{done.stderr[-2000:]}"


@contextmanager
def serving(command: str, folder: Path) -> Iterator[None]:
    """Start a server, wait until it says that it serves, and end it afterwards."""
    with subprocess.Popen(
        ["bash", "-c", f"exec {command}"], cwd=folder, env=environ(), stdout=subprocess.PIPE, text=True
    ) as server:
        try:
            assert "serving" in server.stdout.readline()
            yield
        finally:
            server.terminate()
            server.communicate()


def written() -> Iterator[tuple[str, str]]:
    """Yield where each s2a-bench command of the pages is, and the command; of those in prose the ones with flags."""
    for block in BLOCKS:
        yield from ((str(block), command) for command in block.commands)
    for page in PAGES:
        prose = FENCE.sub("", page.read_text(encoding="utf-8"))
        for command in re.findall(r"(?m)`(s2a-bench [a-z][^`]* --[^`]+)`|^ {4}(\S*s2a-bench .*)", prose):
            yield str(page.relative_to(ROOT)), "".join(command)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_every_command_of_a_page_can_be_given(page: Path) -> None:
    """Those that cannot run here too have flags that there are."""
    for where, line in written():
        if where.partition(":")[0] == str(page.relative_to(ROOT)):
            words = shlex.shlex(COMMENT.sub("", line), posix=True, punctuation_chars=True)
            words.whitespace_split, words.commenters = True, ""
            for punctuation, command in groupby(words, lambda word: {*word} <= {*"();<>|&"}):
                given = [*dropwhile(lambda word: re.match(r"\w+=|do$", word), command)]
                if not punctuation and given and Path(given[0]).name == "s2a-bench":
                    with suppress(typer.Exit):  # as of --help
                        parse(given[1:])


def parse(words: list[str]) -> None:
    """Parse a command line as `s2a_bench.cli.main` does, and run nothing."""
    command: Any = get_command(app)
    context, rest = command.make_context("s2a-bench", folded(words)), folded(words)
    while hasattr(command, "resolve_command"):
        name, command, rest = command.resolve_command(context, rest)
        command.make_context(name, list(rest), parent=context, resilient_parsing=hasattr(command, "resolve_command"))


@pytest.mark.parametrize("block", BLOCKS, ids=str)
def test_a_block_is_what_it_says(block: Block) -> None:
    assert block.language in {"console", "python", "sql", "toml", "json", "text", "latex"}
    assert {*block.needs} <= {*NEEDS, *extras.purposes(), SERVER, CLIENT}
    assert CLIENT not in block.needs or block.server, "no server before it"
    assert SERVER not in block.needs or len(block.commands) == 1
    assert not any(COMMENT.sub("", command).rstrip().endswith("&") for command in block.commands), "a server's block"
    if block.language == "toml":
        loads(block.code, str(block))
    if block.language == "json":
        json.loads(block.code)
    assert "minutes" not in block.needs or "minute" in block.before, "say before it how long it takes"
