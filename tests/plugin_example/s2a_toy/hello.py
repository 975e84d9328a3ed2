"""The command `toy-hello`."""

from __future__ import annotations

from s2a_bench.cli.adapter import command
from s2a_bench.cli.output import Json, print_json, print_line
from s2a_bench.options import Options, option


class HelloConfig(Options):
    """Whom to greet."""

    name: str = option("robot", "who is greeted", min_length=1)


def _hello(config: HelloConfig, *, json_: Json = False) -> None:
    if json_:
        print_json({"hello": config.name})
    else:
        print_line(f"hello, {config.name}")


hello = command(_hello, HelloConfig)
