"""HTTP/1.1 as a tap sees it: httptools finds requests and answers, the dialects read what is in them.

Sizes are those of bodies. Compressed answers, and what does not come within `DECODED_BYTES`, are not read; an answer
without a length ends with its connection.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Mapping
from contextlib import suppress
from http import HTTPStatus
from math import isfinite, nan
from typing import Any, Final

import httptools

from s2a_bench.errors import RequestFailed
from s2a_bench.facts import PREDICTED_MS, PROMPT_MS
from s2a_bench.transport.http.dialects import DIALECTS, NATIVE, Event
from s2a_bench.transport.http.dialects.common import Dialect
from s2a_bench.transport.http.dialects.decoder import ODD, Decoder
from s2a_bench.transport.http.dialects.framing import Framing, JsonLines, ServerSentEvents, WholeBody
from s2a_bench.transport.http.dialects.openai import METRICS
from s2a_bench.transport.tap import DECODED_BYTES, FAILED, LETTERS, MOST_BYTES, Seen, TapReader
from s2a_bench.vectors import actions_of

HEAD_BYTES: Final = 1 << 20
PLAIN: Final = re.compile(r"[A-Za-z._-]{0,40}\d{0,2}|v\d\w*")
"""A part of a path that is kept: others may be names of users, or keys."""
FIRST_MS: Final = PROMPT_MS, METRICS["time_to_first_token_ms"]
"""The servers' reports of the time up to the first token."""
FRAMINGS: Final[Mapping[str, Callable[[], Framing]]] = {
    "text/event-stream": ServerSentEvents,
    "application/json": WholeBody,
    **dict.fromkeys(("application/x-ndjson", "application/jsonl", "application/json-lines"), JsonLines),
}


def chunk_of(value: Any) -> tuple[int, int] | None:
    """Return (H, D) of actions: numbers, an array of json_numpy, or what a key "action..." has; None of all else."""
    with suppress(RequestFailed, *ODD):
        value = json.loads(value) if isinstance(value, str) else value
        if isinstance(value, dict) and "__numpy__" in value:
            rows, size = (1, *map(int, value["shape"]))[-2:]
            return rows, size
        if isinstance(value, dict):
            value = next((each for key, each in value.items() if str(key).startswith("action")), None)
        actions = actions_of(value)
        return len(actions), actions[0].values.size
    return None


def loaded(text: Any) -> Any:
    """Read JSON; None for anything else."""
    with suppress(ValueError, RecursionError):
        return json.loads(text)
    return None


class Lenient(Dialect):
    """The dialect of a path; of another path any message is a piece, and one that the dialect cannot read."""

    def __init__(self, path: str) -> None:
        kinds = (kind for name, kind in DIALECTS.loaded() if name != NATIVE and kind.path)
        self._dialect = next((kind() for kind in kinds if path.endswith(kind.path)), None)
        self.chunk: tuple[int, int] | None = None

    def event(self, message: Any) -> Event:
        self.chunk = chunk_of(message)
        with suppress(RequestFailed, *ODD):
            if self._dialect:
                return self._dialect.event(message)
        return Event("")


class SeenAnswer:
    """The body of an answer, read into what is seen of its exchange."""

    def __init__(self, reader: TapReader, seen: Seen, kind: str) -> None:
        self.seen, self._reader = seen, reader
        self._framing = FRAMINGS.get(kind)
        self._dialect = Lenient(seen.what.partition(" ")[2])
        self._decoder = Decoder(self._dialect, loaded, self._framing) if self._framing and not seen.error else None
        self._unread = 0

    def feed(self, data: bytes) -> None:
        self.seen.down_bytes += len(data)
        self._unread += len(data)
        for event in self._decoder.feed(data) if self._decoder else ():
            self._learn(event)
        if self._unread > DECODED_BYTES:
            self._decoder = None

    def end(self) -> None:
        for event in self._decoder.end() if self._decoder else ():
            self._learn(event)

    def _learn(self, event: Event) -> None:
        seen, self._unread = self.seen, 0
        seen.error = seen.error or FAILED * bool(event.error)
        whole = self._framing is WholeBody
        if whole:
            seen.chunk = self._dialect.chunk
        elif event.text is not None or event.thinking:
            self._reader.piece(seen)
        infer_ms = next((event.facts[fact] for fact in FIRST_MS if fact in event.facts), nan)
        infer_ms += event.facts.get(PREDICTED_MS, 0.0) if whole else 0.0
        if isfinite(infer_ms):
            seen.infer_ms = infer_ms


class HttpSide:
    """The callbacks of httptools for one direction."""

    def __init__(self, reader: HttpReader, parser: Callable[[HttpSide], Any]) -> None:
        self.reader, self._new_parser = reader, parser
        self.parser = parser(self)
        self.headers: dict[str, str] = {}
        self._unread = 0

    def feed(self, data: bytes) -> None:
        """Parse; raises ValueError for a head that does not end, and httptools' errors."""
        self._unread += len(data)
        self.parser.feed_data(data)
        if self._unread > HEAD_BYTES:
            raise ValueError(f"a head of more than {HEAD_BYTES} bytes")

    def on_message_begin(self) -> None:
        self.began_ns, self.headers = self.reader.from_ns, {}

    def on_header(self, name: bytes, value: bytes) -> None:
        self.headers[name.decode("latin-1").lower()] = value.decode("latin-1").lower()

    def on_headers_complete(self) -> None:
        self._unread = 0

    def on_body(self, data: bytes) -> None:  # noqa: ARG002 - for subclasses
        self._unread = 0


class ClientSide(HttpSide):
    def on_message_begin(self) -> None:
        super().on_message_begin()
        self.seen, self._url, self._body, self._fresh = self.reader.begin_request("HTTP"), b"", bytearray(), False

    def on_url(self, url: bytes) -> None:
        self._url = (self._url + url)[:LETTERS]

    def on_headers_complete(self) -> None:
        super().on_headers_complete()
        path = self._url.partition(b"?")[0].decode("latin-1")
        plain = "/".join(part if PLAIN.fullmatch(part) else "*" for part in path.split("/"))
        self.seen.what = f"{self.parser.get_method().decode()} {plain}"
        self._fresh = self.reader.fresh(self.seen)

    def on_body(self, data: bytes) -> None:
        super().on_body(data)
        self.seen.up_bytes += len(data)
        self._fresh = self._fresh and self.seen.up_bytes <= MOST_BYTES
        self._body += data if self._fresh else b""

    def on_message_complete(self) -> None:
        self.reader.end_request(self.seen, self.seen.up_bytes)
        if self._fresh:
            self.seen.observation = loaded(self._body)


class ServerSide(HttpSide):
    answer: SeenAnswer | None = None

    def on_headers_complete(self) -> None:
        super().on_headers_complete()
        status = self.parser.get_status_code()
        seen = self.reader.begin_answer() if status >= HTTPStatus.OK else None
        if seen is None:
            return
        seen.answer_ns = self.began_ns
        seen.error = f"HTTP {status}" if status >= HTTPStatus.BAD_REQUEST else ""
        kind = self.headers.get("content-type", "").partition(";")[0].strip()
        self.answer = SeenAnswer(self.reader, seen, "" if "content-encoding" in self.headers else kind)
        if seen.what.startswith("HEAD "):  # its answer has a length and no body, which httptools would wait for
            self.on_message_complete()
            self.parser = self._new_parser(self)

    def on_body(self, data: bytes) -> None:
        super().on_body(data)
        if self.answer:
            self.answer.feed(data)

    def on_message_complete(self) -> None:
        if self.answer:
            self.answer.end()
            self.reader.end_answer(self.answer.seen, self.answer.seen.down_bytes)
            self.answer = None


class HttpReader(TapReader):
    def __init__(self, report: Callable[[Seen], None], kinds: set[str]) -> None:
        super().__init__(report, kinds)
        self._requests = ClientSide(self, httptools.HttpRequestParser)
        self._answers = ServerSide(self, httptools.HttpResponseParser)

    def up(self, data: bytes) -> None:
        try:
            self._requests.feed(data)
        except httptools.HttpParserUpgrade as upgrade:  # which the server may ignore (RFC 9110, 7.8)
            if rest := data[upgrade.args[0] :]:
                self.up(rest)

    def down(self, data: bytes) -> None:
        try:
            self._answers.feed(data)
        except httptools.HttpParserUpgrade as upgrade:
            self.upgraded(self._answers.headers)
            if rest := data[upgrade.args[0] :]:
                self.down(rest)

    def upgraded(self, headers: Mapping[str, str]) -> None:  # noqa: ARG002 - for subclasses
        """Read another protocol from now on, to which the server agreed with these headers."""
        raise ValueError("the connection leaves HTTP")

    def end(self) -> None:
        if not self._answers.headers.keys() & {"content-length", "transfer-encoding"}:
            self._answers.on_message_complete()
        super().end()
