"""Text from outside: it forges no line and moves no cursor, and holds none of our secrets."""

from __future__ import annotations

import base64
import io
import json
import subprocess
import sys
from pathlib import Path
from urllib.parse import quote

import pytest
from hypothesis import given
from hypothesis import strategies as st
from rich.console import Console

from s2a_bench import secrets
from s2a_bench.cli.progress import RunProgress
from s2a_bench.errors import RequestFailed, UsageError
from s2a_bench.provenance import Origins
from s2a_bench.secrets import is_secret, keep, struck, struck_pieces
from s2a_bench.store.schema import PROVENANCE
from s2a_bench.text import one_line, visible
from s2a_bench.transport.http.options import HttpOptions, read_patch
from s2a_bench.writers.csv_text import CsvTable
from s2a_bench.writers.latex import to_latex
from s2a_bench.writers.tables import TextTable, lay_out, to_markdown
from tests.servers.hostile import delta
from tests.servers.sockets import head, serving

KEY = "sk-Geheim/42+x="
FORGED = "no\nerror: forged\r\x1b[2J\x1b]0;title\x07\x9b1A\u202eabc\u2028\u200b\ud800"


@pytest.fixture(autouse=True)
def only_these_secrets(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(secrets, "_long", {})
    monkeypatch.setattr(secrets, "_short", {})


def as_csv(name: str, value: object) -> str:
    """A table of one value, which tells its provenance itself."""
    return CsvTable.of((name, PROVENANCE), [(value, "measured")]).text(Origins.of_manifest({}))


class TestLetters:
    @given(st.text(st.characters(exclude_categories=())))
    def test_a_line_is_a_line_and_all_its_letters_show(self, text: str) -> None:
        shown = one_line(text)
        assert len(shown.splitlines()) <= 1
        assert not any(letter < " " or "\x7f" <= letter <= "\x9f" for letter in shown)
        shown.encode()
        assert one_line(shown) == shown

    def test_plain_text_stays_as_it_is(self) -> None:
        assert one_line("キッチン é λ → ☃ C:\\x") == "キッチン é λ → ☃ C:\\x"
        assert visible("a\n\tb") == "a\n\tb"

    def test_progress_and_tables_show_them(self, capsys: pytest.CaptureFixture[str]) -> None:
        with RunProgress() as progress:
            progress.say(FORGED)
            progress.stage(f"[red]{FORGED}")
        out = io.StringIO()
        Console(file=out, width=300).print(lay_out(TextTable(FORGED, ("a", FORGED), [(FORGED, "1")], 1), 300))
        for text in (capsys.readouterr().err, out.getvalue()):
            assert "forged" in text
            assert not {"\x1b", "\r", "\x07", "\x9b", "\u202e", "\u2028"} & set(text)
            assert not [line for line in text.splitlines() if line.startswith("error:")]

    def test_csv_has_no_control_characters(self) -> None:
        assert as_csv("a", "\r=1\x1b[2J") == "a,provenance\n\\u000d=1\\u001b[2J,measured\n"

    @pytest.mark.parametrize("value", [-1.5, -3, "-1.5", "+2", "-1e300", "-inf", None, "a=b"])
    def test_a_number_stays_one_in_csv(self, value: object) -> None:
        assert as_csv("a", value) == f"a,provenance\n{'' if value is None else value},measured\n"

    def test_markdown_and_latex_find_nothing_in_them(self) -> None:
        text = "a|b\n| c \\ <b>*x* [y](http://z) \\input{/etc/passwd} $x$"
        table = TextTable(text, ("name",), [(text,)], 1, notes=(text,), provenance="measured")
        title, _, header, rule, row, _, note, _ = to_markdown(table).splitlines()
        assert (header, rule) == ("| name |", "| --- |")
        assert row == r"| a\|b\\n\| c \\ \<b>\*x\* [y]\(http://z) \\input{/etc/passwd} $x$ |"
        assert title == f"**{row[2:-2]}**"
        assert note == row[2:-2]
        lines = to_latex(table).splitlines()
        assert lines[0].startswith("% ")
        assert lines[1].startswith("% ")
        assert r"\textbackslash{}input\{/etc/passwd\} \$x\$" in "".join(lines[2:])


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


class TestSecrets:
    @pytest.mark.parametrize("variant", variants(KEY))
    def test_a_key_is_struck_out_in_every_form(self, variant: str) -> None:
        keep(KEY)
        shown = str(RequestFailed(f"bad key {variant} there"))
        assert "***" in shown
        assert variant.strip('"=')[2:-4] not in shown
        pieces = struck_pieces([*variant, " and", " on"])
        assert len(pieces) == len(variant) + 2
        assert "***" in "".join(pieces)
        assert "".join(pieces).endswith(" and on")

    def test_a_placeholder_is_struck_out_where_it_stands_alone(self) -> None:
        keep("ollama")
        assert struck("key ollama, ollamas") == "key ***, ollamas"
        assert struck("dialect ollama", short=False) == "dialect ollama"

    @pytest.mark.parametrize("name", ["key", "api_key", "apiKey", "X-API-Key", "accessToken", "Authorization", "pwd"])
    def test_a_name_that_looks_like_a_secret_s(self, name: str) -> None:
        assert is_secret(name)
        with pytest.raises(UsageError, match=r"`url`: leave .* out") as error:
            HttpOptions(url=f"http://x/v1?a=b&{name}={quote(KEY)}")
        assert "Geheim" not in str(error.value)
        with pytest.raises(UsageError, match=r"`extra_body`.*too short"):
            read_patch(json.dumps({"a": [{name: {"b": "hunter2"}}]}))
        read_patch(json.dumps({name: KEY}))
        assert struck(f"<{KEY}>") == "<***>"

    @pytest.mark.parametrize("name", ["max_tokens", "stop_token", "prompt_cache_key", "keywords", "monkey", "author"])
    def test_a_name_that_does_not(self, name: str) -> None:
        assert not is_secret(name)

    @pytest.mark.parametrize("url", ["ftp://me:geheim@x/?key=geheim", "me:geheim@x", "http://me:geheim@x/"])
    def test_a_refused_url_is_not_repeated_with_its_password(self, url: str) -> None:
        with pytest.raises(UsageError, match="`url`") as error:
            HttpOptions(url=url)
        assert "geheim" not in str(error.value)


def test_a_run_holds_no_secret(tmp_path: Path) -> None:
    """In files, names and messages, though the server repeats them in tokens, in pieces, and in errors."""
    leak = " ".join(variants(KEY))
    answers = [
        [head(), *[delta(content=leak[at : at + 3]) for at in range(0, len(leak), 3)], b"data: [DONE]\n\n"],
        [head("401 No", "application/json"), json.dumps({"error": f"{FORGED[:-1]} {leak}"}).encode()],
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
