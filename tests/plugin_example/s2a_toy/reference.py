"""A reference `toy-study`: light to import, as every command with `--against` reads it."""

from s2a_bench.experiments.references import Reference

TOY_STUDY = Reference(
    title="the toy study",
    source="a study of toys",
    bars={"latency_bars": "s2a_toy.study:BARS"},
    claims="s2a_toy.study:judge",
)
