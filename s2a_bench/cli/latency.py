"""`s2a-bench latency`: what the transport costs, stage by stage."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from s2a_bench.cli.options import engine_config, file_text, listed, size_of, text_or_file
from s2a_bench.cli.output import console as open_console
from s2a_bench.cli.output import print_json
from s2a_bench.errors import S2AError, UsageError
from s2a_bench.frames import SOURCES
from s2a_bench.inference import ENGINES

if TYPE_CHECKING:
    from s2a_bench.cli.progress import RunProgress

QUICK = {"runs": 10, "warmup": 2, "max_tokens": 8}
FULL = {"runs": 50, "warmup": 5, "max_tokens": 32}
WIRES = {"bgr": "raw", "compressed": "jpeg"}
"""Values of the former --wire -> those of --payload."""


def latency(
    transport: Annotated[
        str,
        typer.Option(
            help="http, ros, loopback; several with commas, with /VARIANT and ?OPTION=VALUE: ros/topic?payload=yuyv"
        ),
    ] = "http,ros",
    source: Annotated[str, typer.Option(help=f"{', '.join(SOURCES)}, as video:FILE")] = "synthetic",
    size: Annotated[str, typer.Option(help="WIDTHxHEIGHT of the frames")] = "640x480",
    payload: Annotated[
        str,
        typer.Option(help="how a picture travels: raw, yuyv, jpeg, jpeg-preencoded, png [default: http jpeg, ros raw]"),
    ] = "",
    http: Annotated[
        str, typer.Option(help="as-deployed, best-effort, binary; several with commas [default: all]")
    ] = "",
    ros: Annotated[str, typer.Option(help="topic, action; several with commas")] = "topic",
    action: Annotated[
        str, typer.Option(help="an action that runs already, as /llama/generate_response of llama_ros (a black box)")
    ] = "",
    result_timeout: Annotated[float, typer.Option(help="seconds an action's result is kept")] = 60.0,
    wire: Annotated[str, typer.Option(hidden=True, help="gone: see --payload")] = "",
    url: Annotated[str, typer.Option(help="a server that runs already (a black box)")] = "",
    dialect: Annotated[
        str,
        typer.Option(help="what --url speaks: openai, llama-server, vllm, ollama, tgi, gemini, openvla [default: ask]"),
    ] = "",
    api_key_env: Annotated[str, typer.Option(help="NAME of the environment variable with the API key of --url")] = "",
    extra_body: Annotated[str, typer.Option(help="JSON, or @FILE, merged into every request to --url")] = "",
    served_model: Annotated[str, typer.Option(help="the model's name at --url")] = "default",
    llama_server: Annotated[
        Path | None, typer.Option(help="start this llama.cpp server on the same model files (a black box)")
    ] = None,
    port: Annotated[int, typer.Option(min=0, max=65535, help="port of the HTTP server; 0: any free one")] = 0,
    dds_tuning: Annotated[str, typer.Option(help="tuned, default")] = "tuned",
    middleware: Annotated[
        str, typer.Option(help="cyclonedds, rclpy [default: rclpy in a sourced ROS 2 environment]")
    ] = "",
    qos: Annotated[str, typer.Option(help="the camera topic's: reliable, sensor_data (best effort)")] = "reliable",
    namespace: Annotated[str, typer.Option(help="ROS namespace of the topics")] = "/s2a_bench",
    connection: Annotated[str, typer.Option(help="HTTP: keep-alive, per-request, client-per-request")] = "keep-alive",
    engine: Annotated[
        str,
        typer.Option(
            help=f"{', '.join(ENGINES)}; echo leaves the transport alone, replay plays --profile (EMULATED) "
            "[default: llama where installed, else echo]"
        ),
    ] = "",
    profile: Annotated[str, typer.Option(help="replay: the board to play, a name of 'profile list' or a path")] = "",
    gaps: Annotated[str, typer.Option(help="replay: trace, parametric, constant [default: trace if recorded]")] = "",
    model: Annotated[Path | None, typer.Option(help="GGUF model [default: the tiny dummy]")] = None,
    mmproj: Annotated[Path | None, typer.Option(help="GGUF vision tower that goes with --model")] = None,
    threads: Annotated[int, typer.Option(min=0, help="CPU threads of the model; 0: all")] = 0,
    gpu_layers: Annotated[int, typer.Option(min=-1, help="model layers on the GPU; -1: all")] = 0,
    context: Annotated[int, typer.Option(min=256, help="context length in tokens")] = 4096,
    runs: Annotated[int | None, typer.Option(help="samples a pipeline [default: 50, quick: 10]")] = None,
    warmup: Annotated[int | None, typer.Option(help="warm-ups a pipeline, kept and marked [default: 5]")] = None,
    mode: Annotated[str, typer.Option(help="request (a frame each), stream (a camera runs)")] = "request",
    fps: Annotated[float, typer.Option(help="rate of the camera in --mode stream")] = 30.0,
    max_tokens: Annotated[int | None, typer.Option(help="tokens an answer [default: 32, quick: 8]")] = None,
    prompt: Annotated[str | None, typer.Option(help="text, or @FILE [default: the paper's prompt]")] = None,
    grammar: Annotated[Path | None, typer.Option(help="GBNF file that every answer obeys")] = None,
    seed: Annotated[int, typer.Option(help="seed of the order, the source and the sampling")] = 0,
    timeout: Annotated[float, typer.Option(help="longest silence of a server, in seconds")] = 300.0,
    sample_resources: Annotated[
        float, typer.Option(help="readings a second of CPU, memory, GPU and power beside the run; 0: none")
    ] = 10.0,
    record: Annotated[
        Path | None, typer.Option(help="also record frames, requests and tokens, as run.mcap (rosbag2)")
    ] = None,
    output: Annotated[Path, typer.Option(help="folder for run folders")] = Path("results"),
    against: Annotated[str, typer.Option(help="paper: draw the paper's figures beside ours")] = "",
    quick: Annotated[bool, typer.Option("--quick", help="fewer samples: a first look")] = False,
    data_only: Annotated[
        bool, typer.Option("--data-only", help="write no tables and figures into the run folder")
    ] = False,
    json_: Annotated[bool, typer.Option("--json", help="one JSON object on standard output")] = False,
    verbose: Annotated[bool, typer.Option("--verbose", help="also what measuring costs, and the environment")] = False,
) -> None:
    """Measure what the transport costs: HTTP/JSON + Base64 against ROS 2-native, every stage, one interleaved run."""
    from s2a_bench.cli.progress import RunProgress
    from s2a_bench.experiments.latency.run import run_latency
    from s2a_bench.harness.plan import DEFAULT_PROMPT, LatencyConfig
    from s2a_bench.inference import default_engine
    from s2a_bench.transport.http import HTTP
    from s2a_bench.transport.ros import ROS

    if wire:
        now = WIRES.get(wire, wire)
        raise UsageError(f"--wire is gone: write --payload {now}, or for ROS alone --transport 'ros?payload={now}'")
    if against not in {"", "paper"}:
        raise UsageError(f"--against: '{against}' should be paper")
    few = QUICK if quick else FULL
    width, height = size_of(size)
    config = LatencyConfig(
        transports=listed(transport),
        variants={HTTP.name: listed(http), ROS.name: listed(ros)},
        options={
            HTTP.name: {
                "connection": connection,
                "url": url,
                "served_model": served_model,
                "dialect": dialect,
                "api_key_env": api_key_env,
                "extra_body": text_or_file(extra_body, "--extra-body"),
                "llama_server": llama_server,
                "port": port,
            },
            ROS.name: {
                "action": action,
                "result_timeout": result_timeout,
                "middleware": middleware,
                "qos": qos,
                "dds_tuning": dds_tuning,
                "namespace": namespace,
            },
        },
        payload=payload,
        tuned=dds_tuning == "tuned",
        record=record,
        source=source,
        width=width,
        height=height,
        engine=engine_config(
            name=engine or "llama",
            model=model,
            mmproj=mmproj,
            threads=threads,
            gpu_layers=gpu_layers,
            context=context,
            profile=profile,
            gaps=gaps,
        ),
        runs=few["runs"] if runs is None else runs,
        warmup=few["warmup"] if warmup is None else warmup,
        mode=mode,
        fps=fps,
        max_tokens=few["max_tokens"] if max_tokens is None else max_tokens,
        prompt=DEFAULT_PROMPT if prompt is None else text_or_file(prompt),
        grammar=file_text(grammar, "--grammar") if grammar else "",
        seed=seed,
        timeout_s=timeout,
        sample_resources_hz=sample_resources,
    )
    if not engine and config.own_engine and not llama_server:
        chosen = default_engine(partial(typer.echo, err=True))
        config = replace(config, engine=config.engine.but(name=chosen))
    config.check()
    with RunProgress() as progress:
        try:
            folder = run_latency(config, output, progress)
            if not data_only:
                progress.stage("drawing")
                _draw(folder, against_paper=against == "paper")
            _show(folder, progress, as_json=json_, verbose=verbose)
        except (S2AError, KeyboardInterrupt):
            if progress.folder is not None:
                progress.say(f"samples so far: {progress.folder}")
            raise


def _draw(folder: Path, *, against_paper: bool) -> None:
    """Write tables and figures."""
    from s2a_bench.experiments.latency.view.figures import write_figures
    from s2a_bench.experiments.latency.view.files import write_tables
    from s2a_bench.store.run import read_run

    run = read_run(folder)
    write_tables(run)
    write_figures(run, against_paper=against_paper)


def _show(folder: Path, progress: RunProgress, *, as_json: bool, verbose: bool) -> None:
    """Print what the user asked for."""
    from s2a_bench.experiments.latency.view.as_json import latency_json
    from s2a_bench.experiments.latency.view.terminal import renderables
    from s2a_bench.store.run import read_run

    run = read_run(folder)
    for warning in run.manifest["warnings"]:
        progress.say(f"warning [{warning['code']}]: {warning['message']}; {warning['advice']}")
    if as_json:
        print_json(latency_json(run))
        return
    console = open_console()
    for part in renderables(run):
        console.print(part)
    if verbose:
        console.print(f"a mark costs {run.manifest['mark_cost_ns']} ns")
        if sampled := run.manifest.get("resources"):
            share, edge_us = sampled["core_share"] or 0, sampled["edge_us"]
            console.print(f"sampling takes {share:.2%} of a core, and {edge_us} us before and after each request")
        console.print_json(data=run.manifest["environment"])
    console.print(f"run folder: {folder}", highlight=False, markup=False, soft_wrap=True)
