"""An engine that plays a hardware profile: its tokens arrive at that board's times. Emulated, never measured.

The first token arrives ``prompt_s`` (with its spread) and one mean gap after the request, the others at the gaps that
``--gaps`` names. Every token has an absolute deadline, so that late wake-ups do not change the rate.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from itertools import accumulate, count, islice
from random import Random

import numpy as np

from s2a_bench.boards.gaps import Constant, Gaps, Lognormal, Recorded, to_table
from s2a_bench.boards.profile import Profile, load_profile
from s2a_bench.clock import Clock, SystemClock
from s2a_bench.errors import UsageError
from s2a_bench.facts import PREDICTED_MS, PREDICTED_N, PROMPT_MS
from s2a_bench.inference import Engine, EngineConfig, chunk
from s2a_bench.text import none_of
from s2a_bench.types import Piece, Request, Token

_PLACES = ("kitchen", "table", "shelf", "sofa")
_OBJECTS = ("cup", "box", "bottle", "jar")
_ARGUMENTS = {"go_to": _PLACES, "open": _OBJECTS, "close": _OBJECTS, "pick": _OBJECTS}
"""Skills of the household set with one argument, so that its parser accepts the plans."""


def _trace(profile: Profile) -> Gaps:
    if not profile.trace_s:
        raise UsageError(
            f"`gaps` trace: profile {profile.name} holds no recording; choose parametric or constant, "
            "or record one with 's2a-bench profile capture'"
        )
    return Recorded.of(profile.trace_s)


GAPS: dict[str, Callable[[Profile], Gaps]] = {
    "constant": lambda profile: Constant(profile.gaps.mean_s),
    "parametric": lambda profile: profile.gaps,
    "trace": _trace,
}
"""Value of ``--gaps`` -> where the gaps come from."""


def _settings(config: EngineConfig) -> tuple[Profile, str, Gaps]:
    if not config.profile:
        raise UsageError("`engine` replay needs `profile` NAME ('s2a-bench profile list' names them)")
    profile = load_profile(config.profile)
    gaps = config.gaps or ("trace" if profile.trace_s else "parametric")
    if gaps not in GAPS:
        raise UsageError(f"`gaps`: {none_of(gaps, GAPS)}")
    return profile, gaps, GAPS[gaps](profile)


class ReplayEngine(Engine):
    """Writes numbered skill calls of six tokens each, or actions, at a profile's speed; ignores the rest.

    Text depends on ``request.seed`` alone. Times are drawn from the seed and the number of earlier requests, as equal
    times for all requests of a run would hide the spread; a recording continues where the last request ended.
    """

    declared_facts = (PROMPT_MS, PREDICTED_N, PREDICTED_MS)
    acts = True
    needs_model = False
    exclusive_options = ("profile", "gaps")
    plays = ("household", 6)

    @classmethod
    def check(cls, config: EngineConfig) -> None:
        _settings(config)

    def __init__(self, config: EngineConfig, clock: Clock | None = None) -> None:
        self._profile, self._gaps, self._source = _settings(config)
        self._config = config
        self._clock = clock or SystemClock()
        self._requests = 0
        self._played = 0

    def generate(self, request: Request) -> Iterator[Piece]:
        self.need_open()
        if request.max_tokens <= 0:
            return
        started_ns = self._clock.now_ns()
        rng = np.random.default_rng((request.seed % 2**32, self._requests))
        self._requests += 1
        prompt_s = self._prompt_s(rng)
        most = min(request.max_tokens, self._config.horizon) if self._config.chunks else request.max_tokens
        due_ns = accumulate(round(gap * 1e9) for gap in self._gaps_s(rng, prompt_s, most))
        self._facts = {PROMPT_MS: prompt_s * 1e3, PREDICTED_N: 0.0, PREDICTED_MS: 0.0}
        for index, (piece, due) in enumerate(zip(self._pieces(request), due_ns, strict=True)):
            self._clock.sleep_until_ns(started_ns + due)
            self._played += index > 0
            self._facts[PREDICTED_N] = float(index + 1)
            self._facts[PREDICTED_MS] = (self._clock.now_ns() - started_ns) / 1e6 - self._facts[PROMPT_MS]
            yield piece

    def _gaps_s(self, rng: np.random.Generator, prompt_s: float, pieces: int) -> Iterator[float]:
        """Yield the time to the first piece, then the gaps, all drawn together when the second is needed."""
        yield prompt_s + self._profile.gaps.mean_s
        if self._gaps == "trace" and isinstance(self._source, Recorded):
            yield from self._source.in_order(pieces - 1, self._played).tolist()
        else:
            yield from self._source.sample(rng, pieces - 1, 1)[:, 0].tolist()

    def _pieces(self, request: Request) -> Iterator[Piece]:
        if self._config.chunks:
            return chunk(self._config, request)
        return (Token(index, text) for index, text in enumerate(islice(_plan(request.seed), request.max_tokens)))

    def _prompt_s(self, rng: np.random.Generator) -> float:
        profile = self._profile
        if not profile.prompt_s or not profile.prompt_cv or self._gaps == "constant":
            return profile.prompt_s
        return float(Lognormal(profile.prompt_s, profile.prompt_cv).sample(rng, 1, 1)[0, 0])

    def describe(self) -> dict[str, str | int | float | bool]:
        profile = self._profile
        return {
            "engine": "replay",
            "emulated": True,
            "dummy": profile.dummy,  # of the recorded model
            **({"pictures": unseen} if (unseen := profile.provenance.pictures) else {}),
            "profile": profile.name,
            "title": profile.title,
            "origin": profile.origin,
            "assumed": ", ".join(profile.assumed),
            "gaps": self._gaps,
            "family": str(to_table(profile.gaps)["family"]) if self._gaps == "parametric" else self._gaps,
            "tokens_per_s": profile.tokens_per_s,
            "prompt_s": profile.prompt_s,
            "grammar": "ignored",
            **({"answer": self._config.pieces} if self._config.chunks else {}),
        }


def _plan(seed: int) -> Iterator[str]:
    """Yield the tokens of an endless plan, six a skill: ``1. go_to(table)`` and a line's end."""
    random = Random(seed)  # noqa: S311 - words, not secrets
    for number in count(1):
        skill = random.choice(tuple(_ARGUMENTS))
        yield from (str(number), ".", f" {skill}", "(", random.choice(_ARGUMENTS[skill]), ")\n")
