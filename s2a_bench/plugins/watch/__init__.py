"""A tap between a robot and its server: what each exchange is made of, without a change to either."""

from s2a_bench.experiments import Experiment, RunMode

HERE = "s2a_bench.plugins.watch"
EXPERIMENT = Experiment(
    name="watch",
    about="Measure a robot that runs already: a tap between it and its server, ROS 2 topics, or a recording of them.",
    config=f"{HERE}.config:WatchTap",
    run=f"{HERE}.run:run_tap",
    mode="tap",
    modes=(
        RunMode("topics", f"{HERE}.config:WatchTopics", f"{HERE}.topics:run_topics", {"in_": ""}),
        RunMode("bag", f"{HERE}.config:WatchBag", f"{HERE}.topics:run_bag", {"bag": "", "in_": ""}),
    ),
    view=f"{HERE}.view:show",
    compared=f"{HERE}.rows:COMPARED",
    unit="exchanges",
)
