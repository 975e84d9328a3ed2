"""A field of a configuration is its flag, its bounds, its help and the name in its errors."""

from __future__ import annotations

import inspect
from pathlib import Path
from typing import Annotated, Any

import pytest
import typer
from typer.testing import CliRunner

from s2a_bench.cli.adapter import command, distinct, flags_of
from s2a_bench.errors import UsageError
from s2a_bench.options import SEVERAL, Names, Options, Size, TextOrFile, group, option, placed


class Engine(Options):
    threads: int = option(0, "CPU threads; 0: all", ge=0)
    model: Path | None = option(None, "a GGUF file")


class Asked(Options):
    runs: int = option(50, "samples", ge=1, le=100)
    t_nom_s: float = option(1.0, "seconds a skill takes", flag="t-nom", gt=0)
    names: Names = option(("a", "b"), "several with commas")
    lengths: Annotated[tuple[int, ...], SEVERAL] = option((6,), "L")
    quick: bool = option(False, "a first look")
    engine: Engine = Engine()

    def check(self) -> None:
        if self.quick and self.runs > 10:
            raise UsageError("`runs`: 10 at most with `quick`, and `t_nom_s` as it is")


class Named(Options):
    name: str = option(..., "what to do", argument=True, pattern="^[a-z]+$")
    times: int = option(1, "how often", argument=True)
    task: TextOrFile = option("", "text, or @FILE")
    size: Size = option((640, 480), "WIDTHxHEIGHT [default: 640x480]")
    engine: Engine = group(Engine, only=("threads",), about="the model's ")


class Here(Options):
    port: int = option(0, "port of the server", ge=0)
    own: bool = option(False, "what nobody else has")


class There(Options):
    port: int = option(8, "port of the server", ge=0)


class Both(Options):
    here: Here = group(Here, about="here: ")
    there: There = group(There, about="there: ")


def run(*arguments: str, options: type[Options] = Asked) -> Any:
    got: list[Options] = []
    app = typer.Typer()
    app.command()(command(got.append, options, about="Try it."))
    result = CliRunner().invoke(app, arguments, catch_exceptions=True)
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    return got[0]


def test_flags_reach_their_fields_and_groups() -> None:
    config = run("--runs", "7", "--t-nom", "2", "--names", "x, y,x", "--lengths", "4,2", "--quick", "--threads", "3")
    assert config == Asked(runs=7, t_nom_s=2, names=["x", "y"], lengths=(4, 2), quick=True, engine=Engine(threads=3))
    assert run("--model", "m.gguf").engine.model == Path("m.gguf")


def test_an_argument_is_given_by_its_place() -> None:
    assert run("go", "3", "--task", "a", options=Named) == Named(name="go", times=3, task="a")
    assert run("go", options=Named).times == 1
    with pytest.raises(UsageError, match=r"^NAME: 'GO' should match pattern"):
        run("GO", options=Named)
    with pytest.raises(UsageError, match=r"^`name` is needed$"):
        Named()


def test_of_a_group_only_some_fields_may_be_flags() -> None:
    assert run("go", "--threads", "2", options=Named).engine == Engine(threads=2)
    about = {flag.name: flag.prefix + flag.about for flag in flags_of(Named)}
    assert about["threads"].startswith("the model's CPU threads; 0: all")
    assert "model" not in about


def test_groups_beside_each_other_share_a_flag() -> None:
    config = run("--port", "7", "--own", options=Both)
    assert (
        config
        == Both(here=Here(port=7, own=True), there=There(port=7))
        == Both(**placed(Both, {"port": 7, "own": True}))
    )
    about = {flag.name: flag.prefix + flag.about for flag in distinct([*flags_of(Both)])}
    assert about == {
        "port": "here, there: port of the server [default: here 0; there 8]",
        "own": "here: what nobody else has",
    }


def test_a_text_may_come_from_a_file(tmp_path: Path) -> None:
    path = tmp_path / "task.txt"
    path.write_text("home")
    assert run("go", "--task", f"@{path}", options=Named).task == "home"
    with pytest.raises(UsageError, match=r"^--task: cannot read /no/such: "):
        run("go", "--task", "@/no/such", options=Named)


@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        (["--runs", "0"], "--runs: 0 should be greater than or equal to 1"),
        (["--t-nom", "0"], "--t-nom: 0.0 should be greater than 0"),
        (["--lengths", "4,x"], "--lengths: 'x' should be a valid integer, unable to parse string as an integer"),
        (["--threads", "-1"], "--threads: -1 should be greater than or equal to 0"),
        (["--quick"], "--runs: 10 at most with --quick, and --t-nom as it is"),
    ],
)
def test_a_value_out_of_bounds_is_one_line_that_names_the_flag(arguments: list[str], line: str) -> None:
    with pytest.raises(UsageError) as caught:
        run(*arguments)
    assert str(caught.value) == line


def test_the_library_names_the_field() -> None:
    with pytest.raises(UsageError, match=r"^`t_nom_s`: -1 should be greater than 0$"):
        Asked(t_nom_s=-1)
    with pytest.raises(UsageError, match=r"^`speed` is not one of the options runs, t_nom_s, names"):
        Asked(speed=1)


def test_a_changed_copy_is_checked_like_a_new_one() -> None:
    assert Asked(runs=5).but(quick=True).runs == 5
    with pytest.raises(UsageError, match="10 at most"):
        Asked().but(quick=True)


def test_help_tells_the_default_of_every_field() -> None:
    about = {flag.name: flag.about for flag in flags_of(Asked)}
    assert about["runs"] == "samples [default: 50]"
    assert about["names"] == "several with commas [default: a,b]"
    assert about["t-nom"] == "seconds a skill takes [default: 1]"
    assert list(about) == ["runs", "t-nom", "names", "lengths", "quick", "threads", "model"]
    assert inspect.signature(command(print, Asked, about="Try it.")).parameters["runs"].default is None


class Keyword(Options):
    in_: str = option("", "a topic", flag="in", pattern="^/")


def test_a_flag_may_be_a_keyword_of_python() -> None:
    (flag,) = flags_of(Keyword)
    assert (flag.key, flag.spelled, flag.path) == ("in_", "--in", ("in_",))
    assert run("--in", "/a", options=Keyword) == Keyword(in_="/a")
    with pytest.raises(UsageError, match=r"^--in: 'a' should match pattern"):
        run("--in", "a", options=Keyword)
