"""Car-to-car rear braking under each policy: impacts and their speeds."""

from s2a_bench.experiments import Experiment, RunMode

HERE = "s2a_bench.experiments.ccrb"
LIVE = "take the tokens of a model that really answers, about the rendered scene"
LOOP = "let the world run while the plan arrives: with --live on the clock, else in virtual time"

EXPERIMENT = Experiment(
    name="ccrb",
    about="Drive car-to-car rear braking with a car behind, under each policy: who hits whom, and when.",
    config=f"{HERE}.config:CcrbComputed",
    run=f"{HERE}.run:run_ccrb",
    mode="computed",
    modes=(
        RunMode("live", f"{HERE}.config:CcrbLive", f"{HERE}.live:run_live", {"live": LIVE}),
        RunMode("closed-loop", f"{HERE}.config:CcrbClosedLoop", f"{HERE}.run:run_closed_loop", {"closed_loop": LOOP}),
        RunMode(
            "live-loop", f"{HERE}.config:CcrbLiveLoop", f"{HERE}.live:run_live_loop", {"live": "", "closed_loop": ""}
        ),
    ),
    view=f"{HERE}.view.tables:show",
    cell=f"{HERE}.rows:RolloutRow",
    unit="parts",
)
