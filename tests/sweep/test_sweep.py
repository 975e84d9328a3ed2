"""Sweeps without processes: files, expansion, plans, and what is kept of cells that finish, fail or never come back."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from dataclasses import replace
from itertools import cycle, product
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from s2a_bench.clock import VirtualClock
from s2a_bench.errors import StoreError, UsageError
from s2a_bench.store.run import RunWriter
from s2a_bench.store.sweep import CELLS, read_sweep
from s2a_bench.sweep import Outcome, SweepCell, SweepCommand
from s2a_bench.sweep.file import SweepFile, expand, read_sweep_file, rounds
from s2a_bench.sweep.plan import SweepPlan, plan_sweep
from s2a_bench.sweep.run import SweepRun, check_resume, difference, only_one, start_sweep
from s2a_bench.testing import NullProgress

values = st.lists(st.integers(0, 9), min_size=1, max_size=4, unique=True)
axes = st.dictionaries(st.sampled_from("abc"), values, max_size=3)


@st.composite
def zipped_axes(draw: st.DrawFn) -> dict[str, list[int]]:
    length = draw(st.integers(1, 4))
    names = draw(st.sets(st.sampled_from("xyz"), max_size=3))
    return {name: draw(st.lists(st.integers(0, 9), min_size=length, max_size=length)) for name in sorted(names)}


patterns = st.lists(st.dictionaries(st.sampled_from("abcxyz"), st.integers(0, 9) | values, min_size=1, max_size=2))


@given(grid=axes, zipped=zipped_axes(), excluded=patterns)
def test_a_grid_is_every_combination_with_every_zipped_row_less_the_excluded(
    grid: dict[str, list[int]], zipped: dict[str, list[int]], excluded: list[dict[str, Any]]
) -> None:
    rows = range(len(next(iter(zipped.values()), [0])))
    expected = []
    for point in product(*grid.values()):
        for row in rows:
            setting = dict(zip(grid, point, strict=True))
            setting.update({name: column[row] for name, column in zipped.items()})
            out = False
            for pattern in excluded:
                hits = 0
                for key, value in pattern.items():
                    wanted = value if isinstance(value, list) else [value]
                    hits += key in setting and setting[key] in wanted
                out = out or hits == len(pattern)
            if not out:
                expected.append(setting)
    assert expand(grid, zipped, excluded) == expected


@given(items=st.lists(st.integers(), unique=True, max_size=20), repeats=st.integers(1, 4), seed=st.integers(0, 99))
def test_every_round_has_every_cell_once_and_rounds_follow_each_other(
    items: list[int], repeats: int, seed: int
) -> None:
    order = list(rounds(items, repeats, seed))
    assert [repeat for repeat, _ in order] == [each for each in range(1, repeats + 1) for _ in items]
    for repeat in range(1, repeats + 1):
        assert sorted(item for each, item in order if each == repeat) == sorted(items)
    assert order == list(rounds(items, repeats, seed))


def test_rounds_have_orders_of_their_own() -> None:
    order = list(rounds(list(range(30)), 2, 0))
    assert [item for _, item in order[:30]] != [item for _, item in order[30:]]
    assert [item for _, item in order[:30]] != list(range(30))


def write(folder: Path, text: str) -> Path:
    path = folder / "s.toml"
    path.write_text(text)
    return path


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("command = ", "not TOML"),
        ('comand = "timeline"', "comand: there is no such key; did you mean command?"),
        ("repeats = 2", "command: is missing"),
        ("command = 3", "command: 3 should be a text"),
        ('command = "t"\nrepeats = 0', "repeats: 0 should be greater than or equal to 1"),
        ('command = "t"\nrest = inf', "rest: inf should be a finite number"),
        ('command = "t"\ngrid = 3', "grid: 3 should be a table"),
        ('command = "t"\n[grid]\nrate = 3', "grid.rate: 3 should be a list"),
        ('command = "t"\n[grid]\nrate = []', "grid.rate: is empty"),
        ('command = "t"\n[grid]\nrate = [3, 3]', "an axis has a value twice; use repeats"),
        ('command = "t"\n[settings]\nrate = 1\n[grid]\nrate = [3]', "'rate' is in [settings] and in [grid]"),
        ('command = "t"\n[grid]\nrate = [3]\n[zip]\nrate = [3]', "'rate' is in [grid] and in [zip]"),
        ('command = "t"\n[zip]\na = [1, 2]\nb = [1]', "zip: axes go side by side and need one length, but have a 2"),
        ('command = "t"\n[settings]\nseed = 1', "settings.seed: the seed is a key at the top of the file"),
        ('command = "t"\n[settings]\noutput = "x"', "settings.output: --output of 's2a-bench sweep'"),
        ('command = "t"\n[grid]\nrate = [3]\n[[exclude]]\nrates = 3', "exclude.rates: it is not an axis; did you mean"),
        ('command = "t"\n[grid]\nrate = [3]\n[[exclude]]\nrate = 4', "exclude.rate: 4 is not a value of that axis"),
        ('command = "t"\n[grid]\nrate = [3]\n[[exclude]]\nrate = 3', "exclude: no cell is left"),
        ('command = "t"\nrepeats = 60000\n[grid]\nrate = [3, 4]', "120000 cells are more than 100000"),
    ],
)
def test_a_wrong_file_is_refused_in_one_line_that_names_file_and_key(text: str, message: str, tmp_path: Path) -> None:
    path = write(tmp_path, text)
    with pytest.raises(UsageError) as refused:
        read_sweep_file(path)
    assert message in str(refused.value)
    assert str(path) in str(refused.value)
    assert "\n" not in str(refused.value)


def test_a_file_that_is_not_there_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"`file`: cannot read .*none\.toml: "):
        read_sweep_file(tmp_path / "none.toml")


FLAGS = {
    "rate": "value",
    "live": "switch",
    "film": "toggle",
    "name": "argument",
    "profile": "value",
    "seed": "value",
    "data-only": "switch",
}
COMMAND = SweepCommand("fly", FLAGS, lambda argv: "--live" not in argv)  # type: ignore[arg-type]


def plan_of(*settings: dict[str, Any], repeats: int = 1, rest_s: float = 0.0, seed: int = 0, **of: Any) -> SweepPlan:
    return plan_sweep(SweepFile(Path("s.toml"), "fly", repeats, rest_s, seed, settings), COMMAND, **of)


def test_a_cell_is_the_command_line_that_its_command_reads() -> None:
    (cell,) = plan_of({"rate": [3, 4.5], "live": False, "name": "x"}, seed=7).cells
    assert cell.argv == ("fly", "x", "--rate=3,4.5", "--seed=7", "--data-only")
    assert cell.settings == {"rate": "3,4.5", "live": False, "name": "x"}
    assert cell.virtual
    (cell,) = plan_of({"film": False}).cells
    assert cell.argv[1] == "--no-film"
    (cell,) = plan_of({"live": True}).cells
    assert cell.argv == ("fly", "--live", "--seed=0", "--data-only")
    assert not cell.virtual


def test_cells_of_one_repeat_share_its_seed_so_that_they_are_compared_on_the_same_draws() -> None:
    seeds = {(cell.repeat, cell.argv[-2]) for cell in plan_of({"rate": 1}, {"rate": 2}, repeats=3, seed=5).cells}
    assert seeds == {(1, "--seed=5"), (2, "--seed=6"), (3, "--seed=7")}


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ({"rat": 1}, "s.toml: 'rat' is not a flag of s2a-bench fly; did you mean rate?"),
        ({"zzz": 1}, "s.toml: 'zzz' is not a flag of s2a-bench fly; it has board, film, live, name, profile, rate"),
        ({"live": 1}, "s.toml: live: 1 should be true or false"),
        ({"rate": True}, "s.toml: rate: True should be text or a number"),
        ({"rate": [{"a": 1}]}, "s.toml: rate: {'a': 1} should be text or a number"),
        ({"board": 3}, "s.toml: board: 3 should be the name of a machine"),
        ({"profile": "abacus"}, "'abacus' is not one of"),
    ],
)
def test_a_setting_that_the_command_does_not_have_is_refused(setting: dict[str, Any], message: str) -> None:
    with pytest.raises(UsageError) as refused:
        plan_of(setting)
    assert message in str(refused.value)


def test_what_the_commands_parser_refuses_names_the_file_and_the_cell() -> None:
    def refuse(_: object) -> None:
        raise UsageError("--rate: 'fast' is no number")

    with pytest.raises(UsageError, match=r"s\.toml: rate=fast: --rate: 'fast' is no number"):
        plan_sweep(SweepFile(Path("s.toml"), "fly", 1, 0.0, 0, ({"rate": "fast"},)), replace(COMMAND, check=refuse))


def test_cells_for_other_boards_are_left_out_and_none_at_all_is_refused() -> None:
    settings = {"rate": 1, "board": "orin"}, {"rate": 2, "board": "nano"}, {"rate": 3}
    assert [cell.number for cell in sorted(plan_of(*settings, boards=["nano"]).cells, key=lambda c: c.number)] == [2, 3]
    assert len(plan_of(*settings, boards=None).cells) == 3
    assert {cell.board for cell in plan_of(*settings).cells if cell.board} == {"orin", "nano"}
    with pytest.raises(UsageError, match=r"`board`: s\.toml has cells for orin, nano only"):
        plan_of(*settings[:2], boards=())


def test_whatever_changes_the_cells_changes_the_hash(tmp_path: Path) -> None:
    one = {"rate": 1}
    hashes = [
        plan.config_hash
        for plan in (
            plan_of(one),
            plan_of({"rate": 2}),
            plan_of(one, {"rate": 2}),
            plan_of(one, repeats=2),
            plan_of(one, seed=1),
            plan_of(one, rest_s=1.0),
            plan_of({"rate": 1, "board": "orin"}),
        )
    ]
    assert len(set(hashes)) == len(hashes)
    assert plan_of(one).config_hash == hashes[0]
    file = tmp_path / "prompt.txt"
    file.write_text("one")
    before = plan_of({"rate": f"@{file}"}).config_hash
    file.write_text("two")
    assert plan_of({"rate": f"@{file}"}).config_hash != before


def test_unlike_machines_are_told_apart_by_name() -> None:
    there = {"host": "a", "cpu": "x", "cores": 4, "gpus": [{"name": "G1", "driver": "1"}]}
    assert difference(there, dict(there)) == ""
    assert difference(there | {"cores": 8}, there) == "cores is 8, was 4"
    assert difference({"host": "b"}, {"host": "a", "gpus": [{"name": "G1"}]}) == (
        "host is b, was a, gpus is unknown, was G1"
    )


class Fake:
    """Workers that carry cells out at once, as `go` says."""

    width = 3

    def __init__(self, go: Callable[[SweepCell], str] = lambda _: "", *machines: dict[str, Any]) -> None:
        self.go = go
        self.machines = cycle(machines or [{"host": "h", "cpu": "c"}])
        self.ran: list[SweepCell] = []

    def submit(self, cell: SweepCell, folder: Path) -> Future[Outcome]:
        future: Future[Outcome] = Future()
        self.ran.append(cell)
        error = self.go(cell)
        machine = next(self.machines)
        folder.mkdir(parents=True)
        with RunWriter.create(folder, "fly", {"environment": machine}, ()):
            pass
        future.set_result(Outcome(error, 0.5, "now", machine))
        return future

    def collect(self, future: Future[Outcome], folder: Path) -> Outcome:
        assert folder.exists()
        return future.result()

    def __enter__(self) -> Fake:  # noqa: PYI034
        return self

    def __exit__(self, *_: object) -> None:
        pass


PLAN = plan_of({"rate": 1}, {"rate": 2}, {"rate": 3, "live": True}, repeats=2)


@pytest.fixture
def folder(tmp_path: Path) -> Iterator[Path]:
    writer = start_sweep(PLAN, write(tmp_path, "x"), tmp_path, ())
    writer.finish("interrupted")
    return writer.path  # type: ignore[return-value]


def sit(
    folder: Path, workers: Fake, *, plan: SweepPlan = PLAN, retry: bool = False, clock: VirtualClock | None = None
) -> NullProgress:
    progress = NullProgress()
    with RunWriter.reopen(folder, [CELLS]) as writer:
        run = SweepRun(writer, plan, progress, clock)
        run.work(workers, retry_failed=retry)
        run.finish()
    return progress


def test_every_cell_is_kept_once_with_its_settings_and_its_run(folder: Path) -> None:
    workers = Fake()
    progress = sit(folder, workers)
    assert progress.expected == progress.done == 6
    assert [cell.virtual for cell in workers.ran] == [False] * 2 + [True] * 4
    sweep = read_sweep(folder)
    assert sweep.manifest["state"] == "finished"
    assert [tuple(row) for row in sweep.cells[["cell", "repeat", "rate", "state"]].to_numpy()] == [
        (f"{number:04d}", repeat, number, "finished") for number in (1, 2, 3) for repeat in (1, 2)
    ]
    runs = list(sweep.runs())
    assert [setting["rate"] for setting, _ in runs] == [1, 1, 2, 2, 3, 3]
    assert all(run.manifest["command"] == "fly" for _, run in runs)
    assert sweep.manifest["machines"] == {"h": {"host": "h", "cpu": "c"}}
    assert not (folder / ".under-way").exists()
    assert (folder / "cells.parquet").exists()


def test_a_sweep_that_breaks_off_goes_on_with_the_cells_it_has_not_kept(folder: Path) -> None:
    def stop(_: SweepCell) -> str:
        if len(first.ran) == 4:
            raise KeyboardInterrupt
        return ""

    first = Fake(stop)
    with pytest.raises(KeyboardInterrupt):
        sit(folder, first)
    assert read_sweep(folder).manifest["state"] == "interrupted"
    kept = read_sweep(folder).cells
    second = Fake()
    sit(folder, second)
    assert {(row.cell, row.repeat) for row in kept.itertuples()}.isdisjoint(cell.key for cell in second.ran)
    assert len(kept) + len(second.ran) == 6
    whole = read_sweep(folder)
    assert len(whole.attempts) == len(whole.cells) == 6


def test_a_torn_row_and_a_moved_folder_without_a_row_count_as_not_done(folder: Path) -> None:
    sit(folder, Fake())
    path = folder / "cells.csv"
    whole = path.read_bytes()
    path.write_bytes(whole[:-10])
    last = read_sweep(folder).attempts  # parquet: still all
    assert len(last) == 6
    again = Fake()
    sit(folder, again)
    assert len(again.ran) == 1
    assert len(read_sweep(folder).attempts) == 6
    assert len(path.read_bytes().splitlines()) == 7


def test_failed_cells_are_kept_with_their_error_and_run_again_only_when_told(folder: Path) -> None:
    sit(folder, Fake(lambda cell: 'it broke, "quite"' if cell.key == ("0002", 1) else ""))
    sweep = read_sweep(folder)
    assert sweep.manifest["state"] == "failed"
    assert sweep.manifest["error"] == "1 of 6 cells failed"
    (failed,) = sweep.cells[sweep.cells["state"] == "failed"].to_dict("records")
    assert failed["error"] == 'it broke, "quite"'
    assert (folder / failed["folder"] / "manifest.json").exists()
    idle = Fake()
    sit(folder, idle)
    assert idle.ran == []
    again = Fake()
    sit(folder, again, retry=True)
    assert [cell.key for cell in again.ran] == [("0002", 1)]
    sweep = read_sweep(folder)
    assert sweep.manifest["state"] == "finished"
    assert len(sweep.attempts) == 7
    assert list(sweep.cells["attempt"]) == [1, 1, 2, 1, 1, 1]
    assert {path.name for path in (folder / "cells").iterdir()} >= {"0002-r1", "0002-r1-2"}


def test_measured_cells_rest_in_between_and_virtual_ones_do_not(folder: Path) -> None:
    clock = VirtualClock()
    at: list[tuple[bool, int]] = []
    plan = replace(PLAN, rest_s=10.0)
    sit(folder, Fake(lambda cell: at.append((cell.virtual, clock.now_ns())) or ""), plan=plan, clock=clock)  # type: ignore[func-returns-value]
    assert [time for virtual, time in at if not virtual] == [0, 10_000_000_000]
    assert {time for virtual, time in at if virtual} == {10_000_000_000}


def test_boards_have_lanes_of_their_own_and_one_cell_at_a_time(folder: Path) -> None:
    plan = plan_of(
        *({"rate": rate, "board": board, "live": True} for rate in (1, 2) for board in ("a", "b")), boards=None
    )
    workers = Fake()
    sit(folder, workers, plan=plan)
    assert sorted(cell.board for cell in workers.ran[:2]) == ["a", "b"]  # both boards at once, then both again
    assert sorted(cell.board for cell in workers.ran[2:]) == ["a", "b"]


def test_a_board_that_is_another_machine_later_is_not_mixed_in(folder: Path) -> None:
    plan = plan_of({"rate": 1, "board": "orin", "live": True}, {"rate": 2, "board": "orin", "live": True}, boards=None)
    sit(folder, Fake(lambda _: "", {"host": "a", "cpu": "x"}, {"host": "b", "cpu": "y"}), plan=plan)
    sweep = read_sweep(folder)
    assert sorted(sweep.cells["error"]) == ["", "orin is another machine than before: cpu is y, was x"]
    assert sweep.manifest["machines"].keys() == {"a", "b"}


def test_a_changed_configuration_another_machine_and_no_sweep_are_refused(folder: Path, tmp_path: Path) -> None:
    check_resume(folder, PLAN)
    with pytest.raises(UsageError, match=r"`resume`: the sweep in .* was another one"):
        check_resume(folder, replace(PLAN, seed=3))
    path = folder / "manifest.json"
    manifest = json.loads(path.read_text())
    manifest["environment"] |= {"host": "elsewhere", "cpu": "Z80"}
    path.write_text(json.dumps(manifest))
    with pytest.raises(
        UsageError, match=r"was measured on another machine: host is .*, was elsewhere, cpu is .*, was Z80; resume it"
    ):
        check_resume(folder, PLAN)
    with RunWriter.create(tmp_path, "latency", {}) as writer:
        pass
    with pytest.raises(UsageError, match="is the folder of a latency run, not of a sweep"):
        check_resume(writer.path, PLAN)
    with pytest.raises(StoreError, match="is the folder of a latency run"):
        read_sweep(writer.path)


def test_two_processes_do_not_write_one_sweep(folder: Path) -> None:
    with only_one(folder), pytest.raises(StoreError, match="another s2a-bench sweep is writing it"), only_one(folder):
        pass
    with only_one(folder):
        pass
