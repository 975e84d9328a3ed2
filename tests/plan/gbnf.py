"""A second, obvious reading of the GBNF that `plan.grammar` writes: every text of a rule, and random ones."""

from __future__ import annotations

import random
import re
from collections.abc import Callable
from itertools import product

Node = tuple[str, object]
_PIECE = re.compile(
    r'\s*(?:(?P<text>"(?:\\.|[^"\\])*")|(?P<some>\[(?:\\.|[^]\\])*\])|<\[(?P<token>\d+)\]>|\{(?P<times>\d+)\}'
    r"|(?P<mark>[()|])|(?P<name>[a-z0-9]+))"
)
_ESCAPE = re.compile(r"\\(?:x([0-9A-F]{2})|(n))|(.)", re.DOTALL)


class Gbnf:
    """Rules by name; symbols are characters, or token ids."""

    def __init__(self, text: str) -> None:
        self.rules = {name: _Reader(body).alternatives() for name, _, body in _rules(text)}

    def words(self, rule: str) -> list[tuple[object, ...]]:
        """Return all that a rule allows."""
        return self._all(self.rules[rule])

    def sample(self, rng: random.Random) -> list[object]:
        """Return something that root allows."""
        return self._some(self.rules["root"], rng)

    def _all(self, node: Node) -> list[tuple[object, ...]]:
        kind, value = node
        kinds: dict[str, Callable[[], list[tuple[object, ...]]]] = {
            "symbol": lambda: [(value,)],
            "name": lambda: self._all(self.rules[value]),
            "either": lambda: [word for option in value for word in self._all(option)],
            "row": lambda: [sum(parts, ()) for parts in product(*map(self._all, value))],
            "times": lambda: self._all(("row", [value[0]] * value[1])),
        }
        return kinds[kind]()

    def _some(self, node: Node, rng: random.Random) -> list[object]:
        kind, value = node
        kinds: dict[str, Callable[[], list[object]]] = {
            "symbol": lambda: [value],
            "name": lambda: self._some(self.rules[value], rng),
            "either": lambda: self._some(rng.choice(value), rng),
            "row": lambda: [symbol for part in value for symbol in self._some(part, rng)],
            "times": lambda: [symbol for _ in range(value[1]) for symbol in self._some(value[0], rng)],
        }
        return kinds[kind]()


def _rules(text: str) -> list[tuple[str, str, str]]:
    return [line.partition(" ::= ") for line in text.splitlines()]


def _characters(text: str) -> list[Node]:
    return [
        ("symbol", chr(int(code, 16)) if code else "\n" if newline else char)
        for code, newline, char in _ESCAPE.findall(text)
    ]


class _Reader:
    def __init__(self, text: str) -> None:
        self._pieces = []
        at = 0
        while at < len(text):
            match = _PIECE.match(text, at)
            assert match, f"not GBNF: {text[at : at + 40]}"
            self._pieces.append((match.lastgroup, match[match.lastgroup]))
            at = match.end()

    def alternatives(self) -> Node:
        options = [self._row()]
        while self._pieces and self._pieces[0] == ("mark", "|"):
            self._pieces.pop(0)
            options.append(self._row())
        return options[0] if len(options) == 1 else ("either", options)

    def _row(self) -> Node:
        parts: list[Node] = []
        while self._pieces and self._pieces[0] not in {("mark", "|"), ("mark", ")")}:
            kind, text = self._pieces.pop(0)
            if kind == "text":
                parts.append(("row", _characters(text[1:-1])))
            elif kind == "some":
                parts.append(("either", _characters(text[1:-1])))
            elif kind == "token":
                parts.append(("symbol", int(text)))
            elif kind == "times":
                parts[-1] = ("times", (parts[-1], int(text)))
            elif kind == "name":
                parts.append(("name", text))
            else:
                parts.append(self.alternatives())
                assert self._pieces.pop(0) == ("mark", ")")
        assert parts, "an empty alternative"
        return ("row", parts)
