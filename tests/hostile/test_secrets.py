"""Secrets stay out of files, messages and names, in whichever form a server sends them back."""

from __future__ import annotations

import base64
import json
import subprocess
import sys
from pathlib import Path
from urllib.parse import quote

import pytest

from s2a_bench import secrets
from s2a_bench.errors import RequestFailed, UsageError
from s2a_bench.secrets import is_secret, keep, struck, struck_pieces
from s2a_bench.transport.http.options import HttpOptions, read_patch
from tests.hostile.wires.http import delta
from tests.servers.sockets import head, serving

KEY = "sk-Geheim/42+x="
FORGED = "no\nerror: forged\r\x1b[2J\x1b]0;title\x07"


@pytest.fixture(autouse=True)
def only_these_secrets(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(secrets, "_long", {})
    monkeypatch.setattr(secrets, "_short", {})


def variants(key: str) -> list[str]:
    """The ways in which a server may send a key back."""
    return [
        key,
        quote(key, safe=""),
        json.dumps(key),
        json.dumps(key).replace("/", "\\/"),
        base64.b64encode(key.encode()).decode(),
        base64.b64encode(f"Bearer {key}".encode()).decode().rstrip("="),
    ]


@pytest.mark.parametrize("variant", variants(KEY))
def test_a_key_is_struck_out_in_every_form(variant: str) -> None:
    keep(KEY)
    shown = str(RequestFailed(f"bad key {variant} there"))
    assert "***" in shown
    assert variant.strip('"=')[2:-4] not in shown
    pieces = struck_pieces([*variant, " and", " on"])
    assert "***" in "".join(pieces)
    assert "".join(pieces).endswith(" and on")


def test_a_placeholder_is_struck_out_where_it_stands_alone() -> None:
    keep("ollama")
    assert struck("key ollama, ollamas") == "key ***, ollamas"
    assert struck("dialect ollama", short=False) == "dialect ollama"


@pytest.mark.parametrize("name", ["key", "api_key", "apiKey", "X-API-Key", "accessToken", "Authorization", "pwd"])
def test_a_name_that_looks_like_a_secret_s(name: str) -> None:
    assert is_secret(name)
    with pytest.raises(UsageError, match=r"`url`: leave .* out") as error:
        HttpOptions(url=f"http://x/v1?a=b&{name}={quote(KEY)}")
    assert "Geheim" not in str(error.value)
    with pytest.raises(UsageError, match=r"`extra_body`.*too short"):
        read_patch(json.dumps({"a": [{name: {"b": "hunter2"}}]}))
    read_patch(json.dumps({name: KEY}))
    assert struck(f"<{KEY}>") == "<***>"


@pytest.mark.parametrize("name", ["max_tokens", "stop_token", "prompt_cache_key", "keywords", "monkey", "author"])
def test_a_name_that_does_not(name: str) -> None:
    assert not is_secret(name)


@pytest.mark.parametrize("url", ["ftp://me:geheim@x/?key=geheim", "me:geheim@x", "http://me:geheim@x/"])
def test_a_refused_url_is_not_repeated_with_its_password(url: str) -> None:
    with pytest.raises(UsageError, match="`url`") as error:
        HttpOptions(url=url)
    assert "geheim" not in str(error.value)


@pytest.mark.slow
def test_a_run_holds_no_secret(tmp_path: Path) -> None:
    """In files, names and messages, though the server repeats them in tokens, in pieces, and in errors."""
    leak = " ".join(variants(KEY))
    answers = [
        [head(), *[delta(content=leak[at : at + 3]) for at in range(0, len(leak), 3)], b"data: [DONE]\n\n"],
        [head("401 No", "application/json"), json.dumps({"error": f"{FORGED} {leak}"}).encode()],
    ]
    body = json.dumps({"provider": {"api_key": KEY}})
    with serving(lambda _: answers[0] if len(list(tmp_path.rglob("tokens.csv"))) < 2 else answers[1]) as url:
        small = ["--transport", "http/as-deployed", "--size", "64x48", "--requests", "2", "--warmup", "0"]
        options = [*small, "--max-tokens", "64", "--url", url, "--dialect", "openai", "--extra-body", body, "--output"]
        runs = [
            subprocess.run(
                [sys.executable, "-m", "s2a_bench", "latency", *options, str(tmp_path)],
                capture_output=True,
                text=True,
                check=False,
                timeout=120,
            )
            for _ in answers
        ]
    assert [done.returncode for done in runs] == [0, 1], runs[0].stderr
    texts = [done.stdout + done.stderr for done in runs]
    texts += [path.read_text(errors="replace") for path in tmp_path.rglob("*") if path.is_file()]
    for text in texts:
        for variant in variants(KEY):
            assert variant not in text
    assert not any("\x1b" in done.stdout + done.stderr for done in runs)
    assert any('"***' in text for text in texts)
    assert not [line for done in runs for line in done.stderr.splitlines() if line.startswith("error: forged")]
