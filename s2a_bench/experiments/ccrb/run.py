"""The CCRB run: the policies at one operating point, and where their ordering holds."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from time import process_time
from typing import TYPE_CHECKING, Any

from s2a_bench.experiments.ccrb.config import CcrbConfig
from s2a_bench.experiments.ccrb.plans import prepare
from s2a_bench.experiments.ccrb.point import drive_point
from s2a_bench.experiments.ccrb.rows import FOLLOWER_STUDY, ROLLOUTS, SENSITIVITY, TRAJECTORIES
from s2a_bench.experiments.ccrb.studies import pieces, studies, study_rows
from s2a_bench.experiments.ccrb.variations import VARIED, follower_rows, sensitivity_rows
from s2a_bench.experiments.timeline.rows import SKILLS
from s2a_bench.experiments.timeline.to_rows import token_rows
from s2a_bench.machine import environment
from s2a_bench.provenance import Origins
from s2a_bench.scenario import simulator
from s2a_bench.scenario.ccrb import FOLLOWERS
from s2a_bench.scenario.ccrb.cars import NCAP_DECELS_MPS2, NCAP_GAPS_M
from s2a_bench.store.requests import TOKENS
from s2a_bench.store.run import RunWriter
from s2a_bench.store.schema import Table

if TYPE_CHECKING:
    from s2a_bench.progress import Progress

_BOARD = ("name", "title", "origin", "tokens_per_s", "prompt_s", "prompt_origin")


def run_ccrb(config: CcrbConfig, output: Path, progress: Progress) -> Path:
    """Drive all roll-outs and return the run folder; raises S2AError."""
    if config.asked.live:
        from s2a_bench.experiments.ccrb.live import run_ccrb_live

        return run_ccrb_live(config, output, progress)
    with closing(simulator(config.simulator, **config.world)) as world:
        board, ready = config.timeline.boards[0], prepare(config)
        manifest = {
            "configuration": config.to_manifest(),
            "environment": environment.collect(),
            "seeds": {"plans": config.seed},
            "follower_law": config.scenario.follower_law,
            "boards": [{name: getattr(board, name) for name in _BOARD}],
            "provenance": Origins(board.provenance).to_manifest(),
        }
        if config.openscenario is not None:
            from s2a_bench.scenario.ccrb.openscenario import write_openscenario

            written = write_openscenario(config.openscenario, config.scenario, ready.schedules)
            manifest["openscenario"] = [str(path) for path in written]
        with RunWriter.create(output, "ccrb", manifest, (ROLLOUTS, TRAJECTORIES, SKILLS, TOKENS)) as writer:
            progress.opened(writer.path)
            progress.stage("driving the operating point")
            tokens_s = ready.plans.token_s
            assert tokens_s is not None  # noqa: S101 - drawn plans have tokens
            writer.append(TOKENS, token_rows(ready.setting.name, tokens_s, [ready.request_id]))
            drive_point(config, ready, world, writer)
            _drive_studies(config, writer, progress)
            return writer.path


def _drive_studies(config: CcrbConfig, writer: RunWriter, progress: Progress) -> None:
    """Drive what is asked for besides the operating point, and say how fast that went."""
    work = list(_work(config))
    if not work:
        return
    progress.stage("driving " + " and ".join(dict.fromkeys(name for name, *_ in work)))
    progress.expect(sum(count for _, count, *_ in work))
    driven, spent_s = 0, 0.0
    for _, _, table, rows_of in work:
        while True:
            before = process_time()
            piece = next(rows_of, None)
            spent_s += process_time() - before
            if piece is None:
                break
            driven += piece[0]
            writer.append(table, piece[1])
            progress.advance()
    writer.update(studies={"rollouts": driven, "rollouts_per_cpu_s": driven / spent_s})


def _work(config: CcrbConfig) -> Iterator[tuple[str, int, Table[Any], Iterator[tuple[int, list[Any]]]]]:
    """Yield what each study is called, of how many pieces it is, its table, and what drives it piece by piece."""
    for study, scenes in studies(config):
        yield study, pieces(scenes), ROLLOUTS, study_rows(config, study, scenes)
    if config.all_followers:
        count = len(FOLLOWERS) * len(NCAP_GAPS_M) * len(NCAP_DECELS_MPS2)
        yield "all followers", count, FOLLOWER_STUDY, follower_rows(config)
    if config.sensitivity:
        yield "sensitivity", sum(map(len, VARIED.values())), SENSITIVITY, sensitivity_rows(config)
