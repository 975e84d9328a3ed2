"""What the toy study has beside measurements: a bar, and one claim."""

from collections.abc import Sequence

from s2a_bench.experiments.references import GreyBars
from s2a_bench.report.verdicts import ClaimVerdict, Evidence, Met
from s2a_bench.store.run import StoredRun
from s2a_bench.writers.figures import Bar

BARS = GreyBars("the toy study, another machine", (Bar("toy study:\nbest", 1.0, None, "1.0"),), ("Grey: of toys.",))


def judge(runs: Sequence[StoredRun]) -> list[ClaimVerdict]:
    """Judge the claim that toys end by every run."""
    found = []
    for run in runs:
        state = str(run.manifest["state"])
        need = Met(f"state: {state}", state == "finished")
        found.append(Evidence(f"{run.path.name} is {state}.", run.origins.labels, (need,)))
    tested = any(need.met for evidence in found for need in evidence.needs)
    verdict = "supported" if tested else "undecided"
    rule = "One finished run supports it."
    return [ClaimVerdict("I", "Toys end", rule, verdict, "state: finished", found, (), tested)]
