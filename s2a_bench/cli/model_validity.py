"""`model validity`: how many skills of a model's plans are valid, with a grammar and without."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from s2a_bench.cli.options import engine_config, listed, text_or_file
from s2a_bench.cli.output import console as open_console
from s2a_bench.cli.output import print_json
from s2a_bench.errors import S2AError


def validity(
    model: Annotated[
        Path | None, typer.Option(help="GGUF file, or minicpm-v-2.6 once fetched  [default: the tiny dummy]")
    ] = None,
    mmproj: Annotated[Path | None, typer.Option(help="its vision tower  [default: the one beside the model]")] = None,
    threads: Annotated[int, typer.Option(help="CPU threads; 0: all")] = 0,
    gpu_layers: Annotated[int, typer.Option(help="layers on the GPU; -1: all")] = 0,
    skills: Annotated[str, typer.Option(help="household, driving, or a TOML file")] = "household",
    tokens_per_skill: Annotated[
        str, typer.Option(help="formats: paper, or tokens a skill; several with commas, as paper,6,4,2,1")
    ] = "paper",
    n_skills: Annotated[int, typer.Option(help="N, skills a plan")] = 8,
    answers: Annotated[int, typer.Option(help="answers of each format, with the grammar and without")] = 32,
    task: Annotated[str, typer.Option(help="what the robot should do; @FILE reads it")] = "",
    max_tokens: Annotated[
        int | None, typer.Option(help="the most tokens of an answer  [default: twice those of the longest plan]")
    ] = None,
    seed: Annotated[int, typer.Option(help="of the first answer; each further one has the next")] = 0,
    output: Annotated[Path, typer.Option(help="folder for run folders")] = Path("results"),
    json_: Annotated[bool, typer.Option("--json", help="one JSON object on standard output")] = False,
) -> None:
    """Count the valid skills in a model's plans, with a grammar and without (the paper's hallucination control)."""
    from s2a_bench.cli.progress import RunProgress
    from s2a_bench.experiments.model_validity.run import ValidityConfig, run_validity

    config = ValidityConfig(
        engine=engine_config(model=model, mmproj=mmproj, threads=threads, gpu_layers=gpu_layers),
        skills=skills,
        tokens_per_skill=listed(tokens_per_skill),
        n_skills=n_skills,
        answers=answers,
        task=text_or_file(task, "--task"),
        max_tokens=max_tokens,
        seed=seed,
    )
    with RunProgress("answers") as progress:
        try:
            folder = run_validity(config, output, progress)
        except (S2AError, KeyboardInterrupt):
            if progress.folder is not None:
                progress.say(f"answers so far: {progress.folder}")
            raise
    _show(folder, as_json=json_)


def _show(folder: Path, *, as_json: bool) -> None:
    """Write the tables, and print what the user asked for."""
    from s2a_bench.experiments.model_validity.view import validity_json, validity_tables
    from s2a_bench.store.run import read_run
    from s2a_bench.writers.files import write_texts
    from s2a_bench.writers.terminal import lay_out

    run = read_run(folder)
    tables = validity_tables(run)
    write_texts(run, tables, {})
    if as_json:
        print_json(validity_json(run))
        return
    console = open_console()
    for table in tables.values():
        console.print(lay_out(table))
    for note in tables["validity"].notes:
        console.print(note, markup=False, highlight=False)
    console.print(f"run folder: {folder}", highlight=False, markup=False, soft_wrap=True)
