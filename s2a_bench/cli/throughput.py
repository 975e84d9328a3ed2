"""`s2a-bench throughput`: how many tokens a second, and what lies between them."""

from __future__ import annotations

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

QUICK = {"runs": 3, "warmup": 1, "max_tokens": 32}
FULL = {"runs": 10, "warmup": 2, "max_tokens": 128}


def throughput(
    transport: Annotated[
        str, typer.Option(help="in-process, http, ros, as in latency; several with commas")
    ] = "in-process",
    source: Annotated[str, typer.Option(help=f"{', '.join(SOURCES)}, as video:FILE")] = "synthetic",
    size: Annotated[str, typer.Option(help="WIDTHxHEIGHT of the frames")] = "640x480",
    payload: Annotated[
        str,
        typer.Option(help="how a picture travels: raw, yuyv, jpeg, jpeg-preencoded, png [default: http jpeg, ros raw]"),
    ] = "",
    http: Annotated[str, typer.Option(help="as-deployed, best-effort, binary; several with commas")] = "as-deployed",
    ros: Annotated[str, typer.Option(help="topic, action; several with commas")] = "topic",
    action: Annotated[
        str, typer.Option(help="an action that runs already, as /llama/generate_response of llama_ros (a black box)")
    ] = "",
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
    middleware: Annotated[
        str, typer.Option(help="cyclonedds, rclpy [default: rclpy in a sourced ROS 2 environment]")
    ] = "",
    engine: Annotated[str, typer.Option(help=f"{', '.join(ENGINES)}; replay plays a --profile: EMULATED")] = "llama",
    profile: Annotated[str, typer.Option(help="replay: the board to play, a name of 'profile list' or a path")] = "",
    gaps: Annotated[str, typer.Option(help="replay: trace, parametric, constant [default: trace if recorded]")] = "",
    model: Annotated[Path | None, typer.Option(help="GGUF model [default: the tiny dummy]")] = None,
    mmproj: Annotated[Path | None, typer.Option(help="GGUF vision tower that goes with --model")] = None,
    threads: Annotated[int, typer.Option(min=0, help="CPU threads of the model; 0: all")] = 0,
    gpu_layers: Annotated[int, typer.Option(min=-1, help="model layers on the GPU; -1: all")] = 0,
    batch: Annotated[int, typer.Option(help="the most prompt tokens evaluated at once")] = 512,
    context: Annotated[int, typer.Option(help="context length in tokens")] = 4096,
    kv_type: Annotated[str, typer.Option(help="KV cache: f32, f16, q8_0, q4_0")] = "f16",
    flash_attention: Annotated[str, typer.Option(help="auto, on, off")] = "auto",
    sampling: Annotated[
        str, typer.Option(help="model (as its authors recommend), greedy [default: model; with --reference: greedy]")
    ] = "",
    reference: Annotated[
        Path | None, typer.Option(help="llama.cpp's llama-bench, run in turn with ours on the same model file")
    ] = None,
    runs: Annotated[int | None, typer.Option(help="requests a cell [default: 10, quick: 3]")] = None,
    warmup: Annotated[int | None, typer.Option(help="warm-ups a cell, kept and marked [default: 2, quick: 1]")] = None,
    max_tokens: Annotated[int | None, typer.Option(help="tokens an answer [default: 128, quick: 32]")] = None,
    prompt: Annotated[str | None, typer.Option(help="text, or @FILE [default: the paper's prompt]")] = None,
    grammar: Annotated[Path | None, typer.Option(help="GBNF file that every answer obeys")] = None,
    seed: Annotated[int, typer.Option(help="seed of the order, the source and the sampling")] = 0,
    timeout: Annotated[float, typer.Option(help="longest silence of a server, in seconds")] = 300.0,
    sample_resources: Annotated[
        float, typer.Option(help="readings a second of CPU, memory, GPU and power beside the run; 0: none")
    ] = 10.0,
    output: Annotated[Path, typer.Option(help="folder for run folders")] = Path("results"),
    against: Annotated[str, typer.Option(help="paper: draw the paper's table II beside ours")] = "",
    quick: Annotated[bool, typer.Option("--quick", help="fewer and shorter answers: a first look")] = False,
    data_only: Annotated[
        bool, typer.Option("--data-only", help="write no tables and figures into the run folder")
    ] = False,
    json_: Annotated[bool, typer.Option("--json", help="one JSON object on standard output")] = False,
) -> None:
    """Measure tokens a second: prefill, time to first token, every gap between tokens, decode rate by position."""
    from s2a_bench.cli.progress import RunProgress
    from s2a_bench.experiments.throughput.run import IN_PROCESS, ThroughputConfig, run_throughput
    from s2a_bench.harness.plan import DEFAULT_PROMPT, LatencyConfig
    from s2a_bench.transport.http import HTTP
    from s2a_bench.transport.loopback import LOOPBACK
    from s2a_bench.transport.ros import ROS

    if against not in {"", "paper"}:
        raise UsageError(f"--against: '{against}' should be paper")
    few = QUICK if quick else FULL
    width, height = size_of(size)
    requests = LatencyConfig(
        transports=tuple(LOOPBACK.name if name == IN_PROCESS else name for name in listed(transport)),
        variants={HTTP.name: listed(http), ROS.name: listed(ros)},
        options={
            HTTP.name: {
                "url": url,
                "served_model": served_model,
                "dialect": dialect,
                "api_key_env": api_key_env,
                "extra_body": text_or_file(extra_body, "--extra-body"),
                "llama_server": llama_server,
            },
            ROS.name: {"action": action, "middleware": middleware},
        },
        source=source,
        width=width,
        height=height,
        payload=payload,
        engine=engine_config(
            name=engine,
            model=model,
            mmproj=mmproj,
            threads=threads,
            gpu_layers=gpu_layers,
            context=context,
            batch=batch,
            kv_type=kv_type,
            flash_attention=flash_attention,
            sampling=sampling or ("greedy" if reference else "model"),
            profile=profile,
            gaps=gaps,
        ),
        sample_resources_hz=sample_resources,
        runs=few["runs"] if runs is None else runs,
        warmup=few["warmup"] if warmup is None else warmup,
        max_tokens=few["max_tokens"] if max_tokens is None else max_tokens,
        prompt=DEFAULT_PROMPT if prompt is None else text_or_file(prompt),
        grammar=file_text(grammar, "--grammar") if grammar else "",
        seed=seed,
        timeout_s=timeout,
    )
    config = ThroughputConfig(requests, reference)
    config.check()
    with RunProgress() as progress:
        try:
            folder = run_throughput(config, output, progress)
            if not data_only:
                progress.stage("drawing")
                _draw(folder, against_paper=against == "paper")
            _show(folder, progress, as_json=json_)
        except (S2AError, KeyboardInterrupt):
            if progress.folder is not None:
                progress.say(f"samples so far: {progress.folder}")
            raise


def _draw(folder: Path, *, against_paper: bool) -> None:
    """Write tables and figures."""
    from s2a_bench.experiments.throughput.view.figures import write_throughput_figures
    from s2a_bench.experiments.throughput.view.tables import throughput_csv, throughput_tables
    from s2a_bench.store.run import read_run
    from s2a_bench.writers.files import write_texts

    run = read_run(folder)
    write_texts(run, throughput_tables(run), throughput_csv(run))
    write_throughput_figures(run, against_paper=against_paper)


def _show(folder: Path, progress: RunProgress, *, as_json: bool) -> None:
    """Print what the user asked for."""
    from s2a_bench.experiments.throughput.view.as_json import throughput_json
    from s2a_bench.experiments.throughput.view.tables import throughput_tables
    from s2a_bench.store.run import read_run
    from s2a_bench.writers.terminal import lay_out

    run = read_run(folder)
    tables = throughput_tables(run)
    for warning in run.manifest["warnings"]:
        progress.say(f"warning [{warning['code']}]: {warning['message']}; {warning['advice']}")
    if as_json:
        print_json(throughput_json(run))
        return
    console = open_console()
    for table in tables.values():
        console.print(lay_out(table))
    console.print(" ".join(tables["throughput"].notes))
    console.print(f"run folder: {folder}", highlight=False, markup=False, soft_wrap=True)
