"""What of a timeline run is judged at once, and what the claims about execution need of it."""

from __future__ import annotations

from itertools import groupby
from typing import TYPE_CHECKING, Final

from s2a_bench.experiments.paper import paper_throughput
from s2a_bench.report.claims.claim import CONTRADICTED, SUPPORTED, UNDECIDED, Need, Part, within
from s2a_bench.report.claims.intervals import LIKE, change
from s2a_bench.report.claims.needs import PAPERS_MODEL, either, on_board

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    from s2a_bench.experiments.timeline.view.cells import Timelines
    from s2a_bench.stats import Ratio
    from s2a_bench.stats.change import Change
    from s2a_bench.store.run import Run

NAIVE, WAIT, OURS = "naive", "wait-then-act", "stream-to-act"
RTX, ORIN, NANO = (claim.name for claim in paper_throughput())
PROFILES: Final = {RTX: "rtx-4080", ORIN: "jetson-agx-orin", NANO: "jetson-orin-nano"}
_RATES: Final = {claim.name: claim.tokens_per_s for claim in paper_throughput()}
_LENGTHS: Final = (6, 4, 2, 1)
_PROMISED: Final = 0.01


def groups(run: Run) -> Iterator[Part]:
    """Yield the timelines of one source of tokens, N and T_nom: every L and policy, from long to short skills."""
    from s2a_bench.experiments.timeline.view.cells import timelines_of

    def setting(cell: Timelines) -> tuple[str, int, float]:
        title, _, n_skills, t_nom_s = cell.setting
        return title, n_skills, t_nom_s

    for (title, n_skills, t_nom_s), found in groupby(sorted(timelines_of(run), key=setting), key=setting):
        cells = sorted(found, key=lambda cell: -cell.setting[1])
        origins = tuple(run.origins.of(str(cell.about("cell"))) for cell in cells)
        yield Part(run, f"{title}, N = {n_skills}, T_nom = {t_nom_s:g} s", cells, origins)


def by_length(part: Part) -> dict[int, dict[str, Timelines]]:
    """Return L -> policy -> timelines."""
    found: dict[int, dict[str, Timelines]] = {}
    for cell in part.cells:
        found.setdefault(cell.setting[1], {})[cell.policy] = cell
    return found


def of_policies(part: Part, *policies: str) -> dict[int, dict[str, Timelines]]:
    """Return the same for those L at which all these policies ran."""
    return {length: cells for length, cells in by_length(part).items() if set(policies) <= set(cells)}


def ran(*policies: str) -> Need:
    """Need these policies beside one another at some L."""

    def look(part: Part) -> tuple[bool, str]:
        return bool(of_policies(part, *policies)), ", ".join(dict.fromkeys(cell.policy for cell in part.cells))

    return Need("policies", ", ".join(policies), look)


def figure_5(board: str, *policies: str) -> tuple[Need, ...]:
    """Return what a claim about a board's timelines needs: its tokens, the four L, and our reading of T_nom."""

    def lengths(part: Part) -> tuple[bool, str]:
        found = of_policies(part, *policies)
        listed = ", ".join(map(str, found)) or "none"
        return set(_LENGTHS) <= set(found), f"L = {listed} with {', '.join(policies)}"

    wanted = f"L = {', '.join(map(str, _LENGTHS))} with {', '.join(policies)}"
    return (_source(board), Need("settings", wanted, lengths), _T_NOM)


def _source(board: str) -> Need:
    """Need tokens of a board: emulated at table II's rate, or of the paper's model on it, at about that rate."""
    rate = _RATES[board]

    def emulated(part: Part) -> tuple[bool, str]:
        papers = [each for each in part.run.manifest.get("boards", []) if each.get("origin") == "paper"]
        named = any(each["name"] == PROFILES[board] and each["tokens_per_s"] == rate for each in papers)
        met = named and all(origin.emulated and origin.profile == PROFILES[board] for origin in part.origins)
        return met, f"EMULATED after {PROFILES[board]}, {rate:g} tokens/s of table II"

    def as_fast(part: Part) -> tuple[bool, str]:
        found = float(part.cells[0].about("tokens_per_s"))
        return abs(found / rate - 1) <= LIKE, f"{found:g} tokens/s"

    first = Need("tokens", f"the profile {PROFILES[board]} with table II's rate", emulated)
    rate_like = Need("rate", f"within {LIKE:.0%} of {rate:g} tokens/s", as_fast)
    return either("source", first, (on_board(board), *PAPERS_MODEL, rate_like))


def _one_second(part: Part) -> tuple[bool, str]:
    _, _, n_skills, t_nom_s = part.cells[0].setting
    spread = part.run.manifest.get("configuration", {}).get("t_nom_cv") or 0.0
    found = f"N = {n_skills}, T_nom = {t_nom_s:g} s" + (f", cv {spread:g}" if spread else "")
    return t_nom_s == 1 and not spread and n_skills > 1, found


_T_NOM: Final = Need("reading", "T_nom = 1 s for every skill, N >= 2; the paper gives neither", _one_second)


def is_exact(part: Part) -> bool:
    """Whether all plans of a cell are the same, computed in virtual time."""
    asked = part.run.manifest.get("configuration", {})
    even = asked.get("jitter") == "none" and not asked.get("t_nom_cv")
    return even and all(cell.about("mode") == "virtual" for cell in part.cells)


def promised(part: Part) -> float:
    """Return the share of plans that may stall: epsilon, but no promise of more counts as none."""
    return min(float(part.run.manifest.get("configuration", {}).get("epsilon") or _PROMISED), _PROMISED)


def keeps_promise(part: Part, cells: Iterable[Timelines]) -> tuple[str, str]:
    """Judge whether the share of plans that stall is as promised in all cells, by its Clopper-Pearson interval."""
    from s2a_bench.experiments.ccrb.view.outcomes import Share

    verdicts, said = [], []
    for cell in cells:
        share = Share(round(cell.p_any_stall * cell.n), cell.n)
        low, high = (share.value, share.value) if is_exact(part) else share.interval
        verdicts.append(within(low, high, 0, promised(part)))
        if share.k or verdicts[-1] != SUPPORTED:
            spread = "" if is_exact(part) else f" [{low:.1%}, {high:.1%}]"
            many = f"{share.k} of {share.n} plans stall{spread}"
            said.append(
                f"{cell.policy} at L = {cell.setting[1]}: {many}, {cell.mean('stall_s') or 0:.2f} s in the mean"
            )
    return all_of(verdicts), "; ".join(said) or "no plan stalls"


def all_of(verdicts: Iterable[str]) -> str:
    """Return the verdict on what is claimed of all: one that contradicts is enough."""
    found = set(verdicts)
    return CONTRADICTED if CONTRADICTED in found else SUPPORTED if found == {SUPPORTED} else UNDECIDED


def compared(part: Part, above: Timelines, below: Timelines, metric: str) -> Change:
    """Compare a metric's mean; plan by plan where both ran the same plans."""
    one, other = above.values(metric), below.values(metric)
    same = above.setting == below.setting and len(one) == len(other)
    return change(one, other, part.run.bootstrap_seed, paired=same, exact=is_exact(part))


def end_over(part: Part, policy: str, than: str) -> dict[int, Ratio]:
    """Return L -> a policy's mean end over that of another."""
    return {
        length: compared(part, cells[policy], cells[than], "end_s").ratio
        for length, cells in of_policies(part, policy, than).items()
    }


def basis(part: Part) -> str:
    """Return whose timelines these are, and where their numbers come from."""
    lines = "; ".join(dict.fromkeys(origin.line for origin in part.origins))
    jitter = part.run.manifest.get("configuration", {}).get("jitter", "none")
    gaps = "" if jitter == "none" else f", jitter {jitter}, {part.cells[0].n} plans a cell"
    return f"{part.name} (an assumption: the paper gives neither N nor T_nom){gaps}; {lines}."
