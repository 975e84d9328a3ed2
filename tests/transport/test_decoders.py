"""The decoders alone: the same events for any cut of the bytes, and never an exception."""

from __future__ import annotations

from itertools import pairwise

import httpx
import pytest
from httpx_sse import EventSource
from hypothesis import given
from hypothesis import strategies as st

from s2a_bench.transport.http.dialects import DIALECTS, Event, open_dialect
from s2a_bench.transport.http.dialects.decoder import Decoder
from s2a_bench.transport.http.dialects.framing import ServerSentEvents
from s2a_bench.types import Token
from tests.servers.speakers import SPEAKERS, Speaker

NAMES = sorted(DIALECTS)


def events(name: str, pieces: list[bytes]) -> list[Event]:
    decoder = Decoder(open_dialect(name))
    found = [event for piece in pieces for event in decoder.feed(piece)]
    return [*found, *decoder.end()]


def cut(body: bytes, places: list[int]) -> list[bytes]:
    edges = sorted({0, len(body), *(place % (len(body) + 1) for place in places)})
    return [body[a:b] for a, b in pairwise(edges)]


CUTS = st.lists(st.integers(0, 10**6), max_size=30)


@given(speaker=st.sampled_from(SPEAKERS), texts=st.lists(st.text(), max_size=4), error=st.booleans(), places=CUTS)
def test_any_cut_of_an_answer_gives_the_same_events(
    speaker: Speaker, texts: list[str], error: bool, places: list[int]
) -> None:
    tokens = [Token(index, text, index) for index, text in enumerate(texts)]
    messages = [speaker.opening(), *map(speaker.token, tokens)]
    body = b"".join([*messages, speaker.error("lost") if error else speaker.closing(tokens)])
    found = events(speaker.dialect, cut(body, places))
    assert found == events(speaker.dialect, [body])
    assert [event.text for event in found if event.text is not None] == [text for text in texts if text]
    if error:
        assert found[-1].error == "the server broke off: lost"
    else:
        assert any(event.finish for event in found)
        assert not any(event.error for event in found)


@given(name=st.sampled_from(NAMES), body=st.binary(max_size=200), places=CUTS)
def test_garbage_gives_the_same_events_for_any_cut_and_never_an_exception(
    name: str, body: bytes, places: list[int]
) -> None:
    assert events(name, cut(body, places)) == events(name, [body])


LINES = st.lists(
    st.sampled_from(["data: ", "data:", "data", ": ping", "id: 7", "event: error", "x", "é", "\ufeff", " ", "\r", "\n"])
    | st.just("\r\n")
)


@given(LINES, CUTS)
def test_events_are_cut_as_httpx_sse_cuts_them(parts: list[str], places: list[int]) -> None:
    text = "".join(parts).lstrip("\ufeff") + "\n\n"
    response = httpx.Response(200, headers={"content-type": "text/event-stream"}, content=text.encode())
    expected = [event.data for event in EventSource(response).iter_sse() if event.data]
    framing = ServerSentEvents()
    found = [message for piece in cut(text.encode(), places) for message in framing.feed(piece)]
    assert [*found, *framing.end()] == expected


@pytest.mark.parametrize("end", [b"\n", b"\r\n", b"\r"])
def test_each_end_of_a_line_is_one_end_wherever_it_is_cut(end: bytes) -> None:
    framing = ServerSentEvents()
    body = end.join([b"data: a", b"data:b", b"", b"data:c", b"", b""])
    found = [message for place in range(len(body)) for message in framing.feed(body[place : place + 1])]
    assert [*found, *framing.end()] == ["a\nb", "c"]


def test_bytes_that_are_no_utf_8_do_not_end_a_stream() -> None:
    assert events("openai", [b'data: {"choices":[{"delta":{"content":"a\xff"}}]}\n\n']) == [Event(text="a\ufffd")]


def test_a_lone_surrogate_becomes_a_question_mark() -> None:
    assert events("ollama", [b'{"message":{"content":"a\\ud83d"}}\n'])[0].text == "a?"


@pytest.mark.parametrize("bare", [b'{"error":{"message":"m"}}', b'{\n "error": {\n  "message": "m"\n }\n}\n'])
@pytest.mark.parametrize("before", [b"", b'data: {"candidates":[]}\r\n\r\n', b'data: {"candidates":[]}\n'])
def test_bare_json_between_events_is_an_error(before: bytes, bare: bytes) -> None:
    (*_, last) = events("gemini", [before + bare])
    assert last.error == "the server broke off: m"


def test_bare_json_that_stays_broken_is_an_error() -> None:
    (last,) = events("gemini", [b'{\n "error": {'])
    assert "not the dialect 'gemini'" in last.error


def test_nothing_follows_an_error() -> None:
    body = b'{"error":"first"}\n{"message":{"content":"more"}}\n{"error":"second"}\n'
    for pieces in ([body], [body[i : i + 1] for i in range(len(body))]):
        assert [event.error for event in events("ollama", pieces)] == ["the server broke off: first"]


def test_null_errors_of_good_chunks_are_none() -> None:
    body = b'data: {"error":null,"choices":[{"delta":{"content":"x"},"finish_reason":null}],"usage":null}\n\n'
    assert events("openai", [body]) == [Event(text="x")]
