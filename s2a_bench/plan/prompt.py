"""The prompt of a format: the paper's (section IV-E), with the vocabularies, the number of skills, and the codes."""

from __future__ import annotations

from s2a_bench.plan.formats import Format
from s2a_bench.plan.wordings import normalise


def prompt(format_: Format, n_skills: int, task: str = "") -> str:
    """Return what to ask the model; ``task`` is what the robot should do, in the user's words.

    The sentences are the paper's; vocabularies and the number of skills are added, as the grammar holds the model to
    them. Where a call is not written as the skills are listed, every call follows with its code.
    """
    skills = format_.skills
    coded = any(normalise(text) != normalise(str(call)) for text, call in zip(format_.texts, skills.calls, strict=True))
    codes = [f"{text.strip()} = {call}" for text, call in zip(format_.texts, skills.calls, strict=True)]
    lines = [
        f"You are a {skills.role}.",
        f"Skills: {', '.join(skill.signature for skill in skills.skills)}.",
        *(f"{name}: {', '.join(map(str, values))}." for name, values in skills.vocabularies.items()),
        *(["Codes:", *codes] if coded else []),
        f"Rules: Output only {_what(format_, coded=coded)}.",
        f"Output exactly {n_skills} of them.",
        "Do not output any explanation.",
        *([f"Task: {task}"] if task else []),
    ]
    return "\n".join(lines) + "\n"


def _what(format_: Format, *, coded: bool) -> str:
    """Name what should be written, in the paper's words where they hold."""
    if not format_.delimiter:
        return f"codes in one line, such as {''.join(format_.texts[:2]).strip()}"
    numbered = "numbered " if format_.numbered else ""
    example = f" such as {format_.line(1, format_.texts[0]).strip()}" if coded else ""
    return f"{numbered}{'codes' if coded else 'skill calls'}{example}, one per line"
