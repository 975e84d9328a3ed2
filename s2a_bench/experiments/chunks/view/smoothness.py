"""Tracking error and jerk against mean latency, a line a mode; PNG and PDF."""

from __future__ import annotations

from typing import TYPE_CHECKING

from s2a_bench.experiments.chunks.rows import SMOOTHNESS
from s2a_bench.experiments.chunks.view.figures import LOOKS, title_of
from s2a_bench.experiments.chunks.view.lanes import short
from s2a_bench.writers.figures import LINE_CHARS, new_figure

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from s2a_bench.store.run import Run


def build_smoothness(run: Run) -> Figure:
    """Draw both, and dashed what the plant alone does, asked in every tick and answered at once."""
    rows = run.table(SMOOTHNESS)
    modes = [str(mode) for mode in rows["mode"].unique()][: len(LOOKS)]
    what = "Following a target"
    columns = 2 if max(map(len, modes)) <= LINE_CHARS // 3 else 1
    foot_in = 0.17 * -(-(len(modes) + 1) // columns)
    figure = new_figure(3.5 + foot_in, title_of(run, what, f"shape of {rows['latency'].iloc[0]}"))
    panels = figure.subplots(2, 1, sharex=True)
    latency_ms = rows["latency_s"].to_numpy(dtype="float64") * 1e3
    for axes, name, label in zip(
        panels, ("tracking_rms", "jerk_rms"), ("tracking error (sd)", "jerk (sd/s$^3$)"), strict=True
    ):
        values = rows[name].to_numpy(dtype="float64")
        for mode, (colour, line, _) in zip(modes, LOOKS, strict=False):
            mine = (rows["mode"] == mode).to_numpy()
            label_of = short(mode, LINE_CHARS - 8)
            axes.plot(latency_ms[mine], values[mine], line, color=colour, label=label_of)
        ideal = rows.groupby("latency_s")[f"{name}_ideal"].mean()
        axes.plot(
            ideal.index.to_numpy(dtype="float64") * 1e3,
            ideal.to_numpy(dtype="float64"),
            "--",
            color="black",
            label="asked in every tick, answered at once",
        )
        axes.set_ylim(bottom=0)
        axes.ticklabel_format(axis="y", scilimits=(-3, 5))
        axes.set_ylabel(label)
    panels[-1].set_xlim(0, float(latency_ms.max()))
    panels[-1].set_xlabel("mean latency, L (ms)")
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=columns, columnspacing=1.0)
    return figure
