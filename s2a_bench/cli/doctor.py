"""`s2a-bench doctor`: what on this machine distorts a measurement, and the command that fixes it."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

import typer

from s2a_bench.cli.adapter import command
from s2a_bench.cli.output import Json, print_json
from s2a_bench.inference import CHECKS as OF_ENGINES
from s2a_bench.machine import environment
from s2a_bench.machine.doctor import CHECKS, LEVELS, DoctorConfig, Finding, Machine, examine, warnings_of, worst
from s2a_bench.store.schema import SCHEMA
from s2a_bench.transport import TRANSPORTS, risks

STYLES = {"state": "green", "advice": "cyan", "warning": "yellow", "error": "bold red"}


def _doctor(config: DoctorConfig, *, json_: Json = False) -> None:
    machine = Machine(output=config.output)
    findings = risks.examine(config.url) if config.url else examine(machine, all_checks())
    if json_:
        print_json(_as_json(findings))
    else:
        _show(findings)
    limit = "warning" if config.strict else "error"
    raise typer.Exit(int(LEVELS.index(worst(findings)) >= LEVELS.index(limit)))


doctor = command(_doctor, DoctorConfig)


def all_checks() -> dict[str, str]:
    checks = {**CHECKS, **OF_ENGINES}
    for _, transport in TRANSPORTS.loaded():
        checks |= transport.checks
    return checks


def _show(findings: list[Finding]) -> None:
    from rich.console import Console
    from rich.text import Text

    console = Console()
    wide = max(len(finding.code) for finding in findings)
    for finding in findings:
        line = Text(f"{finding.level:8}", STYLES[finding.level])
        line.append(f"{finding.code:{wide}}  ", "bold").append(finding.message, "default")
        if finding.fix:
            line.append(f" -> {finding.fix}", "bold")
        console.print(line, soft_wrap=True, highlight=False)
    levels = [finding.level for finding in findings]
    console.print(", ".join(f"{levels.count(level)} {level}" for level in LEVELS), highlight=False)


def _as_json(findings: list[Finding]) -> dict[str, Any]:
    packages = [package for _, transport in TRANSPORTS.loaded() for package in transport.packages]
    return {
        "schema": SCHEMA,
        "command": "doctor",
        "environment": environment.collect(packages),
        "worst": worst(findings),
        "checks": [asdict(finding) for finding in findings],
        "warnings": [asdict(warning) for warning in warnings_of(findings)],
    }
