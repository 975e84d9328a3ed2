"""`s2a-bench doctor`: what of this machine would distort a measurement, and the command that mends it."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import typer

from s2a_bench.cli.adapter import command
from s2a_bench.cli.output import Json, print_json
from s2a_bench.machine.doctor.config import DoctorConfig

if TYPE_CHECKING:
    from s2a_bench.machine.doctor import Finding

STYLES = {"state": "green", "advice": "cyan", "warning": "yellow", "error": "bold red"}


def _doctor(config: DoctorConfig, *, json_: Json = False) -> None:
    from s2a_bench.machine.doctor import LEVELS, Machine, examine, worst

    findings = _of_url(config.url) if config.url else examine(replace(Machine(), output=config.output), all_checks())
    if json_:
        print_json(_as_json(findings))
    else:
        _show(findings)
    limit = "warning" if config.strict else "error"
    raise typer.Exit(int(LEVELS.index(worst(findings)) >= LEVELS.index(limit)))


doctor = command(_doctor, DoctorConfig)


def _of_url(url: str) -> list[Finding]:
    from s2a_bench.transport.dangers import examine

    return examine(url)


def all_checks() -> dict[str, str]:
    """Return the checks of the machine, then those that engines and transports declare."""
    from s2a_bench.inference import CHECKS as OF_ENGINES
    from s2a_bench.machine.doctor import CHECKS
    from s2a_bench.transport import TRANSPORTS

    checks = {**CHECKS, **OF_ENGINES}
    for _, transport in TRANSPORTS.loaded():
        checks |= transport.checks
    return checks


def _show(findings: list[Finding]) -> None:
    """Print a line for each check, and how many there were of each level."""
    from rich.console import Console
    from rich.text import Text

    from s2a_bench.machine.doctor import LEVELS

    console = Console()
    wide = max(len(finding.code) for finding in findings)
    for finding in findings:
        line = Text(f"{finding.level:8}", STYLES[finding.level])
        line.append(f"{finding.code:{wide}}  ", "bold").append(finding.message, "default")
        if finding.fix:
            line.append(f" -> {finding.fix}", "bold")
        console.print(line, soft_wrap=True, highlight=False)
    counts = {level: sum(finding.level == level for finding in findings) for level in LEVELS}
    console.print(", ".join(f"{count} {level}" for level, count in counts.items()), highlight=False)


def _as_json(findings: list[Finding]) -> dict[str, Any]:
    """Return the object of ``--json``: every finding, and the warnings and errors as runs store them."""
    from dataclasses import asdict

    from s2a_bench.harness.warnings import warnings_of
    from s2a_bench.machine import environment
    from s2a_bench.machine.doctor import worst
    from s2a_bench.store.schema import SCHEMA
    from s2a_bench.transport import TRANSPORTS

    packages = [package for _, transport in TRANSPORTS.loaded() for package in transport.packages]

    return {
        "schema": SCHEMA,
        "command": "doctor",
        "environment": environment.collect(packages),
        "worst": worst(findings),
        "checks": [asdict(finding) for finding in findings],
        "warnings": [warning.to_manifest() for warning in warnings_of(findings)],
    }
