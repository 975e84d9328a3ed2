"""`model fetch` against a hub in this process that speaks as the real one does, and misbehaves on demand."""

import errno
import hashlib
import json
import os
import re
import threading
from collections.abc import Iterator
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import huggingface_hub.constants
import huggingface_hub.file_download
import jsonschema
import pytest
from typer.testing import CliRunner

from s2a_bench.cli.model import app
from s2a_bench.errors import ModelError, UsageError
from s2a_bench.inference import EngineConfig, FetchConfig
from s2a_bench.inference.fetch import Fetched, selected_files
from s2a_bench.inference.fetch import fetch as fetch_config
from s2a_bench.inference.models import HUB_MODELS, fetched, load_headers

NAME = "minicpm-v-2.6"
REPOSITORY = "openbmb/MiniCPM-V-2_6-gguf"
MODEL, MMPROJ = "ggml-model-Q4_K_M.gguf", "mmproj-model-f16.gguf"
COMMIT = "0123456789abcdef0123456789abcdef01234567"
TOKEN = "hf_of_this_test"  # noqa: S105 no secret
SCHEMA = json.loads((Path(__file__).parents[2] / "docs/schema/s2a-bench-model-1.json").read_text())


@dataclass
class Hub:
    """What the hub holds, how it misbehaves, and the requests that it received."""

    files: dict[str, bytes]
    repository: str = REPOSITORY
    sha256: dict[str, str] = field(default_factory=dict)
    """Checksums that it gives instead of the right ones."""
    refuse: tuple[int, dict[str, str]] | None = None
    """Status and headers of every answer."""
    refuse_files: tuple[int, dict[str, str]] | None = None
    commit: str = COMMIT
    lfs: bool = True
    listing: bytes | None = None
    port: int = 0
    requests: list[tuple[str, str]] = field(default_factory=list)
    """(method, path) of each request."""

    def gets(self, name: str) -> int:
        """Return how often a file was downloaded."""
        return self.requests.count(("GET", f"/store/{hashlib.sha256(self.files[name]).hexdigest()}"))

    def digest(self, name: str) -> str:
        return self.sha256.get(name, hashlib.sha256(self.files[name]).hexdigest())


class Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"
    hub: Hub

    def log_message(self, *_: object) -> None:
        pass

    def do_HEAD(self) -> None:
        self.do_GET()

    def do_GET(self) -> None:
        hub, path = self.hub, self.path.split("?", 1)[0]
        hub.requests.append((self.command, path))
        if path.startswith("/store/"):
            return self.content(path.removeprefix("/store/"))
        refuse = hub.refuse or (hub.refuse_files if "/resolve/" in path else None)
        if refuse:
            return self.answer(refuse[0], refuse[1])
        if path == f"/api/models/{hub.repository}":
            return self.answer(200, {"Content-Type": "application/json"}, self.list())
        head, _, name = path.rpartition("/")
        if name not in hub.files or head not in {f"/{hub.repository}/resolve/{at}" for at in ("main", hub.commit)}:
            return self.answer(404, {"X-Error-Code": "EntryNotFound", "X-Repo-Commit": hub.commit})
        # the real hub leads to another host, whose answer has none of these headers
        content = hashlib.sha256(hub.files[name]).hexdigest()
        facts = {"X-Repo-Commit": hub.commit, "X-Linked-Etag": f'"{hub.digest(name)}"', "ETag": '"of the redirect"'}
        facts["X-Linked-Size"] = str(len(hub.files[name]))
        return self.answer(302, facts | {"Location": f"http://localhost:{hub.port}/store/{content}"})

    def list(self) -> bytes:
        if self.hub.listing is not None:
            return self.hub.listing
        siblings: list[dict[str, Any]] = [{"rfilename": "README.md", "size": 3, "blobId": "0" * 40}]
        for name, data in self.hub.files.items():
            lfs = {"sha256": self.hub.digest(name), "size": len(data), "pointerSize": 135}
            siblings.append({"rfilename": name, "size": len(data)} | ({"lfs": lfs} if self.hub.lfs else {}))
        return json.dumps({"id": self.hub.repository, "sha": self.hub.commit, "siblings": siblings}).encode()

    def content(self, digest: str) -> None:
        (data,) = [data for data in self.hub.files.values() if hashlib.sha256(data).hexdigest() == digest]
        self.answer(200, {}, data)

    def answer(self, status: int, headers: dict[str, str], body: bytes = b"") -> None:
        self.send_response(status)
        for key, value in headers.items():
            self.send_header(key, value)
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(body)


@pytest.fixture
def hub(tiny: EngineConfig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Hub]:
    """A hub with the tiny dummy under the real one's names; the library's addresses and its cache point here."""
    assert tiny.model
    assert tiny.mmproj
    it = Hub({MODEL: tiny.model.read_bytes(), MMPROJ: tiny.mmproj.read_bytes()})
    server = ThreadingHTTPServer(("127.0.0.1", 0), type("Bound", (Handler,), {"hub": it}))
    it.port = server.server_address[1]
    point_at(monkeypatch, f"http://127.0.0.1:{it.port}")
    monkeypatch.setattr(huggingface_hub.constants, "HF_HUB_CACHE", str(tmp_path / "hub"))
    monkeypatch.setattr(huggingface_hub.constants, "HF_HUB_OFFLINE", False)
    monkeypatch.setattr(huggingface_hub.file_download, "time", SimpleNamespace(sleep=lambda _: None))
    monkeypatch.setenv("HF_TOKEN", TOKEN)
    monkeypatch.setenv("S2A_BENCH_CACHE", str(tmp_path / "cache"))
    thread = threading.Thread(target=server.serve_forever, args=(0.01,))
    thread.start()
    yield it
    server.shutdown()
    thread.join()
    server.server_close()


def point_at(monkeypatch: pytest.MonkeyPatch, endpoint: str) -> None:
    constants = huggingface_hub.constants
    monkeypatch.setattr(constants, "ENDPOINT", endpoint)
    monkeypatch.setattr(constants, "HUGGINGFACE_CO_URL_TEMPLATE", endpoint + "/{repo_id}/resolve/{revision}/{filename}")


def fetch(what: str = NAME, **flags: Any) -> Fetched:
    return fetch_config(FetchConfig(what=what, **flags))


def refusal(what: str = NAME, **flags: Any) -> str:
    with pytest.raises(ModelError) as caught:
        fetch(what, **flags)
    message = str(caught.value)
    assert "\n" not in message
    return message


def blobs(tmp_path: Path) -> list[str]:
    folder = tmp_path / "hub" / f"models--{REPOSITORY.replace('/', '--')}" / "blobs"
    return sorted(path.name for path in folder.iterdir()) if folder.is_dir() else []


def test_both_files_arrive_whole_in_the_hubs_own_cache_and_are_not_fetched_twice(hub: Hub, tmp_path: Path) -> None:
    done = fetch()
    assert (done.repository, done.commit) == (REPOSITORY, COMMIT)
    assert [file.path.read_bytes() for file in done.files] == [hub.files[MODEL], hub.files[MMPROJ]]
    assert [file.path.name for file in done.files] == [MODEL, MMPROJ]
    assert [file.sha256 for file in done.files] == [hub.digest(MODEL), hub.digest(MMPROJ)]
    assert blobs(tmp_path) == sorted(file.sha256 for file in done.files)
    # another program that uses the hub's library finds them
    assert huggingface_hub.hf_hub_download(REPOSITORY, MODEL) == str(done.files[0].path)
    again = fetch()
    assert [file.path for file in again.files] == [file.path for file in done.files]
    assert hub.gets(MODEL) == hub.gets(MMPROJ) == 1


def test_a_wrong_content_is_refused_and_not_kept(hub: Hub, tmp_path: Path) -> None:
    hub.sha256[MODEL] = "ab" * 32
    found = hashlib.sha256(hub.files[MODEL]).hexdigest()
    assert refusal() == f"{MODEL}: has SHA-256 {found}, the hub says {'ab' * 32}; it was deleted, fetch again"
    assert blobs(tmp_path) == [hub.digest(MMPROJ)]
    with pytest.raises(ModelError, match="not fetched yet"):
        fetched(NAME)


def test_a_damaged_file_in_the_cache_is_deleted_and_fetched_again(hub: Hub) -> None:
    path = fetch().files[0].path
    with path.open("r+b") as file:
        file.seek(5_000_000)
        file.write(b"?")
    assert f"the hub says {hub.digest(MODEL)}; it was deleted, fetch again" in refusal()
    assert not path.is_symlink()
    assert fetch().files[0].path.read_bytes() == hub.files[MODEL]
    assert hub.gets(MODEL) == 2


def test_the_files_of_the_commit_that_was_fetched_last_are_the_model(hub: Hub) -> None:
    first = fetch()
    hub.commit = "f" * 40
    assert fetched(NAME) == tuple(file.path for file in first.files)
    hub.files[MODEL] += b"of a later commit"
    second = fetch()
    assert fetched(NAME) == tuple(file.path for file in second.files)
    assert [file.path.parent.name for file in (*first.files, *second.files)] == [COMMIT] * 2 + ["f" * 40] * 2
    assert hub.gets(MMPROJ) == 1


@pytest.mark.parametrize(
    ("what", "status", "headers", "message"),
    [
        ("refuse", 404, {"X-Error-Code": "RepoNotFound"}, f"{REPOSITORY}: no such repository at http://127.0.0.1"),
        ("refuse", 403, {"X-Error-Code": "GatedRepo"}, "gated; ask for access"),
        ("refuse", 401, {"X-Error-Message": "Invalid credentials in"}, "answered 401 Invalid credentials"),
        ("refuse", 500, {}, "answered 500; check the name and HF_TOKEN, try later"),
        ("refuse_files", 403, {"X-Error-Code": "GatedRepo"}, "gated; ask for access"),
        ("refuse_files", 403, {"X-Error-Message": "Not today."}, "answered 403 Not today; check the name and HF_TOKEN"),
    ],
)
def test_a_refusal_by_the_hub_of_all_or_of_its_files_is_one_line(
    hub: Hub, tmp_path: Path, what: str, status: int, headers: dict[str, str], message: str
) -> None:
    setattr(hub, what, (status, headers))
    assert message in refusal()
    assert blobs(tmp_path) == []


@pytest.mark.parametrize("body", [b"<html>log in to this network</html>", b"[]", b'{"error": "no"}', b"null"])
def test_what_is_no_hub_is_told_apart(hub: Hub, body: bytes) -> None:
    hub.listing = body
    assert "set HF_ENDPOINT to a hub in reach, or download its files by hand" in refusal()


def test_a_hub_without_checksums_is_refused(hub: Hub, tmp_path: Path) -> None:
    hub.lfs = False
    assert f"gives no SHA-256 for {MODEL}" in refusal()
    assert blobs(tmp_path) == []


def test_no_network_names_the_ways_out(hub: Hub, monkeypatch: pytest.MonkeyPatch) -> None:
    assert hub.requests == []
    for endpoint in ("nonsense", "ftp://x", "http://[", ""):
        point_at(monkeypatch, endpoint)
        assert "HF_ENDPOINT" in refusal()
    point_at(monkeypatch, "http://127.0.0.1:1")
    message = refusal()
    assert message.startswith(f"{REPOSITORY}: cannot be fetched from http://127.0.0.1:1 (ConnectError")
    assert message.endswith(
        "set HF_ENDPOINT to a hub in reach, or download its files by hand and give --model PATH --mmproj PATH"
    )


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EDQUOT])
def test_a_disk_that_fills_up_is_one_line(hub: Hub, monkeypatch: pytest.MonkeyPatch, number: int) -> None:
    full = Mock(side_effect=OSError(number, os.strerror(number)))
    monkeypatch.setattr(huggingface_hub.file_download, "http_get", full)
    assert f"cannot be written ([Errno {number}] {os.strerror(number)}); make room, or set HF_HOME" in refusal()
    assert hub.gets(MODEL) == 0


def test_a_cache_that_cannot_be_written_is_named(hub: Hub, tmp_path: Path) -> None:
    (tmp_path / "hub").write_text("a file where the folder should be")
    assert re.search(rf"{tmp_path}/hub.*set HF_HOME to a folder that you may write", refusal())
    assert hub.gets(MODEL) == 0


@pytest.mark.parametrize(
    "what",
    ["", "minicpm", "hub:", "hub:a", "a/b:", "a:b.gguf", "a/b/c:d.gguf", "../b c:d.gguf", "a/b..c:d", "a--b/c:d"],
)
def test_what_is_neither_name_nor_file_is_wrong_usage(what: str) -> None:
    with pytest.raises(UsageError, match=r"neither minicpm-v-2.6, .* nor OWNER/REPO\[:FILE\]"):
        fetch(what)


def test_a_file_is_found_in_upper_and_lower_case_the_exact_name_first(hub: Hub) -> None:
    hold(hub, "a/b", ["C.gguf", "c.gguf", "M.gguf"])
    for file, names in (("c.gguf", ["c.gguf"]), ("C.gguf", ["C.gguf"]), ("m.GGUF", ["M.gguf"])):
        assert [each.path.name for each in fetch(f"hub:a/b:{file}").files] == names
    assert refusal("a/b:c.gguf", mmproj="N.gguf") == "a/b: has no N.gguf; it has C.gguf, M.gguf, c.gguf"


# as the repositories list them, by what public programs download from there
LISTINGS = {
    "minicpm-v-2.6": ["ggml-model-Q4_K_M.gguf", "ggml-model-Q2_K.gguf", "ggml-model-f16.gguf", "mmproj-model-f16.gguf"],
    "qwen3-vl-2b": ["Qwen3VL-2B-Instruct-Q4_K_M.gguf", "mmproj-Qwen3VL-2B-Instruct-F16.gguf"],
    "gemma3-270m": ["gemma-3-270m-it-Q8_0.gguf"],
}
CHOSEN = {name: (files[0], files[-1]) if len(files) > 1 else tuple(files) for name, files in LISTINGS.items()}
"""Every list begins with the language model that is wanted, and ends with the mmproj, if there is one."""


def hold(hub: Hub, name: str, files: list[str]) -> None:
    """Give the hub other files: each has a content of its own that the header check accepts."""
    model, mmproj = hub.files[MODEL], hub.files[MMPROJ]
    hub.repository = HUB_MODELS.get(name, name)
    hub.files = {file: (mmproj if "mmproj" in file else model) + file.encode() for file in files}


@pytest.mark.parametrize("name", LISTINGS)
def test_a_known_name_fetches_its_files_and_is_then_a_model(hub: Hub, name: str) -> None:
    hold(hub, name, [*LISTINGS[name], "imatrix.dat"])
    done = fetch(name)
    assert tuple(file.path.name for file in done.files) == CHOSEN[name]
    assert fetched(name) == (done.files[0].path, done.files[1].path if len(done.files) > 1 else None)
    assert set(hub.files) - set(CHOSEN[name]) == {file for file in hub.files if not hub.gets(file)}


def test_any_repository_of_the_hub_is_a_model_once_it_is_fetched(hub: Hub) -> None:
    address = "robots/plan.er_2-GGUF"
    # the second is another quantisation, whose name ends as the wanted one does
    hold(
        hub, address, ["p.Q4_K_M.gguf", "p.UD-IQ4_K_M.gguf", "p.Q8_0.gguf", "p.mmproj-Q8_0.gguf", "p.mmproj-bf16.gguf"]
    )
    name = Path(f"hub:{address}")
    with pytest.raises(ModelError, match=rf"^`model` {name}: not fetched yet; run: s2a-bench model fetch {address}$"):
        load_headers(EngineConfig(model=name))
    assert hub.requests == []
    fetch(address)
    model, mmproj = fetched(str(name))
    assert (model.name, mmproj and mmproj.name) == ("p.Q4_K_M.gguf", "p.mmproj-Q8_0.gguf")
    with pytest.raises(ModelError, match=rf"{address}:p.Q8_0.gguf: not fetched yet; .* fetch {address}:p.Q8_0.gguf$"):
        fetched(f"{name}:p.Q8_0.gguf")
    fetch(address, quant="q8_0")
    with pytest.raises(
        ModelError, match=rf"{name}: p.Q4_K_M.gguf, p.Q8_0.gguf were fetched; choose one, as {name}:p.Q4_K_M.gguf$"
    ):
        load_headers(EngineConfig(model=name))
    files = load_headers(EngineConfig(model=Path(f"{name}:P.Q8_0.gguf")))
    assert (files.model.path, files.mmproj and files.mmproj.path) == (model.with_name("p.Q8_0.gguf"), mmproj)


@pytest.mark.parametrize(
    ("files", "quant", "names"),
    [
        (["a-Q8_0.gguf", "a-F16.gguf"], None, ("a-Q8_0.gguf",)),
        (["a-F16.gguf", "mmproj-a.gguf"], None, ("a-F16.gguf", "mmproj-a.gguf")),
        (["Q8_0/a-Q8_0.gguf", "Q4_K_M/a-Q4_K_M.gguf"], None, ("Q4_K_M/a-Q4_K_M.gguf",)),
        (["a-F16.gguf", "a-BF16.gguf"], "f16", ("a-F16.gguf",)),
        (["a-F16.gguf"], "Q4_0", None),
        (["a-Q2_K.gguf", "a-Q3_K.gguf"], None, None),
        (["a-Q4_K_M.gguf", "b-Q4_K_M.gguf"], None, None),
        (["mmproj-a-F16.gguf"], None, None),
        (["model.safetensors"], None, None),
    ],
)
def test_the_listing_gives_one_language_model_or_names_all(
    files: list[str], quant: str | None, names: tuple[str, ...] | None
) -> None:
    config = FetchConfig(what="a/b", quant=quant)
    if names is not None:
        assert selected_files("a/b", "", config, files) == [*names]
        return
    with pytest.raises(
        ModelError, match=rf"^a/b: no model is {quant or 'Q4_K_M or Q8_0'}, or several; it has "
    ) as error:
        selected_files("a/b", "", config, files)
    assert all(file in str(error.value) for file in files if file.endswith("gguf"))


@pytest.mark.parametrize("name", ["hub:", "hub:a", "hub:a/b/c", "hub:a/b:", "hub:a b/c"])
def test_what_is_no_address_on_the_hub_is_wrong_usage(name: str) -> None:
    with pytest.raises(UsageError, match=rf"^`model` '{name}' is neither .* nor OWNER/REPO\[:FILE\]$"):
        load_headers(EngineConfig(model=Path(name)))


def run(*arguments: str) -> Any:
    return CliRunner().invoke(app, ["fetch", *arguments])


def test_the_command_prints_the_paths_and_the_command_that_uses_them(hub: Hub) -> None:
    result = run(NAME)
    assert result.exit_code == 0, result.output
    model, mmproj, command = result.stdout.splitlines()
    assert Path(model).read_bytes() == hub.files[MODEL]
    assert Path(mmproj).read_bytes() == hub.files[MMPROJ]
    assert command == f"s2a-bench latency --model {model} --mmproj {mmproj}"
    assert result.stderr == ""  # bars are for terminals


def test_json_is_one_object_of_the_schema(hub: Hub) -> None:
    result = run(NAME, "--json")
    found = json.loads(result.stdout)
    jsonschema.validate(found, SCHEMA)
    assert found["command"] == "model fetch"
    assert found["endpoint"] == f"http://127.0.0.1:{hub.port}"
    assert [file["bytes"] for file in found["files"]] == [len(hub.files[MODEL]), len(hub.files[MMPROJ])]
    assert found["latency"].startswith("s2a-bench latency --model ")


def test_one_file_alone_is_fetched_as_a_text_model_and_its_partner_is_named(hub: Hub) -> None:
    result = run(f"{REPOSITORY}:{MODEL}")
    assert result.exit_code == 0, result.output
    path, command = result.stdout.splitlines()
    assert Path(path).name == MODEL
    assert command == f"s2a-bench latency --model {path}"
    assert "note: without an mmproj a model sees no picture; --mmproj FILE fetches one too" in result.stderr
    assert hub.gets(MMPROJ) == 0
    # the second file of the same commit lies beside the first
    assert run(f"{REPOSITORY}:{MODEL}").stdout == result.stdout
    result = run(f"{REPOSITORY}:{MODEL}", "--mmproj", MMPROJ)
    assert result.stdout.splitlines()[2].startswith("s2a-bench latency --model ")


def test_a_file_that_is_no_gguf_is_told(hub: Hub) -> None:
    hub.files["notes.gguf"] = b"not a model at all"
    result = run(f"{REPOSITORY}:notes.gguf")
    assert isinstance(result.exception, ModelError)
    assert "not a GGUF file" in str(result.exception)
