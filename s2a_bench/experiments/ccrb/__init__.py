"""Car-to-car rear braking under each policy: impacts and their speeds."""

from s2a_bench.experiments import Experiment, RunMode

EXPERIMENT = Experiment(
    name="ccrb",
    about="Drive car-to-car rear braking with a car behind, under each policy: who hits whom, and when.",
    config="s2a_bench.experiments.ccrb.config:CcrbComputed",
    run="s2a_bench.experiments.ccrb.run:run_computed",
    mode="computed",
    modes=(
        RunMode(
            "live",
            "s2a_bench.experiments.ccrb.config:CcrbLive",
            "s2a_bench.experiments.ccrb.live:run_live",
            {"live": "take the tokens of a model that really answers, about the rendered scene"},
        ),
        RunMode(
            "closed-loop",
            "s2a_bench.experiments.ccrb.config:CcrbClosedLoop",
            "s2a_bench.experiments.ccrb.run:run_closed_loop",
            {"closed_loop": "let the world run while the plan arrives: with --live on the clock, else in virtual time"},
        ),
        RunMode(
            "live-loop",
            "s2a_bench.experiments.ccrb.config:CcrbLiveLoop",
            "s2a_bench.experiments.ccrb.live:run_live_loop",
            {"live": "", "closed_loop": ""},
        ),
    ),
    view="s2a_bench.experiments.ccrb.view.tables:show",
    cell="s2a_bench.experiments.ccrb.view.tables:CcrbCell",
    unit="parts",
)
