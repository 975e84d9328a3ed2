"""Every dialect against servers that speak it faithfully, and that misbehave in every way seen in the wild."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from threading import Event
from typing import Any

import numpy as np
import pytest

from s2a_bench.clock import now_ns
from s2a_bench.errors import RequestFailed, ServerDied, UsageError
from s2a_bench.frames.convert import decode_image, encode_png, to_bgr
from s2a_bench.testing.transport import Connect, RecordingHandler, TransportSuite, ask, wiring_of, yuyv_frame
from s2a_bench.trace import Trace, budget
from s2a_bench.transport import Client, Handler, Wiring, open_client
from s2a_bench.transport.http import HTTP
from s2a_bench.transport.http.dialects import DIALECTS
from s2a_bench.types import Request, Token
from tests.servers.sockets import CLOSE, Received, Reply, chunk, head, kept_head, serving
from tests.servers.speakers import SPEAKERS, Cloud, Gemini, LlamaServer, Ollama, Speaker, Tgi, Vllm, answering
from tests.suites import only

GO_TO = [Token(0, "go", 11), Token(1, "_to", 12)]
Pieces = list[bytes]


def route(speaker: Speaker, url: str, **more: object) -> Wiring[Any]:
    """A route that leaves nothing to be asked first."""
    fields = {"payload": "png", "dialect": speaker.dialect, "served_model": "default", **more}
    url += "/v1beta" if fields["dialect"] == "gemini" else ""
    return wiring_of("http/as-deployed", url=url, **fields)  # type: ignore[arg-type]


@contextmanager
def client_of(speaker: Speaker, reply: Reply, **more: object) -> Iterator[Client]:
    with serving(reply) as url:
        client = open_client(route(speaker, url, **more))
        try:
            yield client
        finally:
            client.close()


def answered(speaker: Speaker, pieces: Pieces, **more: object) -> tuple[list[str], Trace]:
    """What a client makes of these pieces."""
    with client_of(speaker, lambda _: pieces, **more) as client:
        tokens, trace = ask(client, Request("a", "plan", (yuyv_frame(),)))
    return [token.text for token in tokens], trace


def answer(speaker: Speaker, closing: Callable[[list[Token]], bytes] | None = None) -> Pieces:
    """A whole good answer of two tokens."""
    tokens = [speaker.token(token) for token in GO_TO]
    return [head(kind=speaker.kind), speaker.opening(), *tokens, (closing or speaker.closing)(GO_TO)]


@pytest.fixture(params=SPEAKERS, ids=lambda speaker: speaker.dialect)
def speaker(request: pytest.FixtureRequest) -> Speaker:
    return request.param  # type: ignore[no-any-return]


by_framing = pytest.mark.parametrize("speaker", [Cloud(), Ollama()], ids=lambda speaker: speaker.dialect)
"""One speaker of each way to frame a stream, where the dialect does not matter."""


class OfDialect(TransportSuite):
    """The transports' contract, as far as a foreign server carries it: no ids, no marks, no raw pixels."""

    name = "http/as-deployed"

    @pytest.fixture
    def wiring(self, speaker: Speaker) -> Wiring[Any]:
        return route(speaker, "http://localhost")

    @pytest.fixture
    def connect(self, speaker: Speaker) -> Iterator[Connect]:
        with ExitStack() as stack:

            def connect(handler: Handler) -> Client:
                return stack.enter_context(client_of(speaker, answering(speaker, handler)))

            yield connect

    def test_tokens_arrive_in_order_with_text_and_id(self, connect: Connect) -> None:
        tokens, _ = ask(
            connect(RecordingHandler(["go", "", "_to(", "キッチン", ")\n"])), Request("a", "plan", (yuyv_frame(),))
        )
        assert [(token.index, token.text) for token in tokens] == [(0, "go"), (1, "_to("), (2, "キッチン"), (3, ")\n")]

    def test_every_field_of_a_request_reaches_the_handler(self, connect: Connect) -> None:
        handler = RecordingHandler(["x"])
        ask(connect(handler), Request("id-7", 'Grüße,\n"robot"\t机器人', (), max_tokens=9, seed=42))
        (got,) = handler.requests
        assert got == Request("", 'Grüße,\n"robot"\t机器人', (), max_tokens=9, seed=42)

    def test_the_picture_arrives_as_rgb(self, connect: Connect) -> None:
        handler, frame = RecordingHandler(["x"]), yuyv_frame(seed=3)
        ask(connect(handler), Request("a", "", (frame,)))
        (image,) = handler.requests[0].images
        np.testing.assert_array_equal(image.data, decode_image(encode_png(to_bgr(frame))))


@by_framing
class TestContract(OfDialect):
    """All of it."""


@only(
    "test_tokens_arrive_in_order_with_text_and_id",
    "test_every_field_of_a_request_reaches_the_handler",
    "test_the_picture_arrives_as_rgb",
    "test_every_stage_takes_time",
    "test_every_fact_that_it_tells_is_declared",
    "test_tokens_before_a_break_are_seen",
)
@pytest.mark.parametrize("speaker", [LlamaServer(), Vllm(), Tgi(), Gemini()], ids=lambda speaker: speaker.dialect)
class TestFieldsOfEveryDialect(OfDialect):
    """What is written in other words elsewhere."""


FACTS = {
    "openai": {"prompt_n": 8, "cache_n": 4, "predicted_n": 2, "thinking_n": 0},
    "llama-server": {"prompt_n": 9, "cache_n": 3, "prompt_ms": 97.5, "predicted_n": 2, "predicted_ms": 2.0}
    | {"thinking_n": 0},
    "vllm": {"prompt_n": 8, "cache_n": 4, "predicted_n": 2, "thinking_n": 0}
    | {
        "end_n": 1,
        "predicted_steps": 1,
        "first_token_ms": 31.5,
        "predicted_ms": 80.0,
        "queue_ms": 0.25,
        "mean_itl_ms": 8.0,
    },
    "ollama": {"prompt_with_cached_n": 8, "predicted_n": 2}
    | {"total_ms": 150.0, "load_ms": 10.0, "prompt_ms": 100.0, "predicted_ms": 30.0, "outside_model_ms": 10.0},
    "tgi": {"prompt_n": 8, "predicted_n": 2},
    "gemini": {"prompt_n": 8, "predicted_n": 2},
}


def test_what_a_server_tells_of_itself_is_kept_by_clear_names(speaker: Speaker) -> None:
    texts, trace = answered(speaker, answer(speaker))
    assert texts == ["go", "_to"]
    facts = {name: value for name, value in trace.facts.items() if name not in HTTP.facts}
    assert facts == pytest.approx(FACTS[speaker.dialect])


def test_only_llama_server_shows_where_ingest_ends(speaker: Speaker) -> None:
    _, trace = answered(speaker, answer(speaker))
    after_packing = [stage for stage, _ in trace.chain()][-2:]
    assert after_packing == (["ingest", "inference"] if speaker.dialect == "llama-server" else ["json_pack", "server"])


def test_missing_usage_and_timings_are_absent_not_zero(speaker: Speaker) -> None:
    texts, trace = answered(speaker, answer(speaker, speaker.bare_closing))
    assert texts == ["go", "_to"]
    assert not {"predicted_n", "prompt_ms", "predicted_ms", "total_ms", "outside_model_ms", "cache_n"} & set(
        trace.facts
    )
    assert trace.chain()[-1][0] == "server"
    assert budget(trace.chain()).e2e_without_inference_ns is None


def test_an_answer_without_its_end_is_a_failure(speaker: Speaker) -> None:
    with pytest.raises(RequestFailed, match="before the answer was complete"):
        answered(speaker, answer(speaker)[:-1])


@pytest.mark.parametrize(
    "broken",
    [
        [kept_head("text/event-stream"), chunk(Cloud().token(GO_TO[0])), b"ff\r\ndata", CLOSE],
        [head("200 OK", "text/event-stream", "Content-Length: 9999"), Cloud().token(GO_TO[0])],
        [b"SSH-2.0-OpenSSH_9.6\r\n", CLOSE],
        [CLOSE],
    ],
    ids=["chunk", "length", "SSH", "nothing"],
)
def test_a_connection_that_breaks_is_a_failure(broken: Pieces) -> None:
    with pytest.raises(RequestFailed, match="broke the connection"):
        answered(Cloud(), broken)


KINDS = ("application/json", "text/html; charset=utf-8", "")


@pytest.mark.parametrize(
    ("status", "more", "says", "retry_after_s"),
    [
        ("401 Unauthorized", [], "answered 401: no way; name the environment variable .* `api_key_env`", None),
        ("403 Forbidden", [], "answered 403: no way; .* `api_key_env`", None),
        ("404 Not Found", [], "answered 404: no way; see `url`, `dialect` and `served_model`", None),
        ("413 Payload Too Large", [], "answered 413: no way; choose a smaller `size`", None),
        ("429 Too Many Requests", ["Retry-After: 7"], "answered 429: no way; it asks to wait 7 s; .*quota", 7.0),
        ("503 Service Unavailable", ["retry-after: 1.5"], "answered 503: no way; it asks to wait 1.5 s$", 1.5),
        ("503 Busy", ["Retry-After: Wed, 21 Oct 2015 07:28:00 GMT"], "answered 503: no way$", None),
        ("503 Busy", ["Retry-After: soon"], "answered 503: no way$", None),
        ("500 Oops", [], "answered 500: no way$", None),
    ],
)
def test_a_refusal_says_what_and_the_way_out(
    status: str, more: list[str], says: str, retry_after_s: float | None
) -> None:
    body = Cloud().refusal(int(status[:3]), "no\n  way")
    with pytest.raises(RequestFailed, match=says) as failure:
        answered(Cloud(), [head(status, "application/json", *more), body])
    assert failure.value.retry_after_s == retry_after_s


def test_a_refusal_is_read_in_every_dialect(speaker: Speaker) -> None:
    for status, kind in (("400 Bad Request", "application/json"), *(("200 OK", kind) for kind in KINDS)):
        with pytest.raises(RequestFailed, match=f"answered {status[:3]}: no way"):
            answered(speaker, [head(status, kind), speaker.refusal(400, "no\n  way")])


def test_googles_retry_delay_is_in_the_body() -> None:
    body = b'{"error":{"message":"quota","details":[{"@type":"x"},{"retryDelay":"34.5s"}]}}'
    with pytest.raises(RequestFailed, match=r"it asks to wait 34\.5 s") as failure:
        answered(Gemini(), [head("429 Too Many Requests", "application/json"), body])
    assert failure.value.retry_after_s == 34.5


@by_framing
def test_a_moved_server_is_not_followed(speaker: Speaker) -> None:
    with pytest.raises(RequestFailed, match="answered 307: nothing; it moved: give https://elsewhere/ to `url`"):
        answered(speaker, [head("307 Moved", "text/plain", "Location: https://elsewhere/")])


@by_framing
def test_a_page_of_another_server_is_named(speaker: Speaker) -> None:
    with pytest.raises(RequestFailed, match=r"answered 200: <html>.* \(as text/html where .* see `dialect`"):
        answered(speaker, [head(kind="text/html"), b"<html>\n<title>router</title>" + b"x" * 500_000])


SHAPES = [b"{not json}", b"[1,2]", b'{"choices":7,"message":7,"token":7,"candidates":7}', b'"x"', b"7"]


def test_no_json_and_json_of_another_shape_are_failures(speaker: Speaker) -> None:
    for value in SHAPES:
        line = b"data: " + value + b"\n\n" if "stream" in speaker.kind else value + b"\n"
        with pytest.raises(RequestFailed, match=f"not the dialect '{speaker.dialect}'"):
            answered(speaker, [head(kind=speaker.kind), line])


def test_pings_empty_pieces_and_single_bytes_do_no_harm(speaker: Speaker) -> None:
    ping = b": ping\n\n:\n\n" if "stream" in speaker.kind else b"\n\r\n"
    texts = ["キッチン", "", "é\n", "🤖"]
    tokens = [Token(index, text, index) for index, text in enumerate(texts)]
    body = ping.join([speaker.opening(), *map(speaker.token, tokens), speaker.closing(tokens)]) + ping
    got, _ = answered(speaker, [head(kind=speaker.kind), *(body[i : i + 1] for i in range(len(body)))])
    assert got == ["キッチン", "é\n", "🤖"]


@by_framing
def test_the_clock_stops_at_the_first_piece_that_is_not_empty(speaker: Speaker) -> None:
    stamps = []

    def reply(_: Received) -> Iterator[bytes]:
        yield head(kind=speaker.kind)
        yield speaker.opening() + speaker.token(Token(0, "", 5))
        Event().wait(0.05)  # long enough for a client that takes the empty piece for a token to be caught
        stamps.append(now_ns())
        yield speaker.token(GO_TO[0]) + speaker.closing(GO_TO)

    with client_of(speaker, reply) as client:
        _, trace = ask(client, Request("a", "plan"))
    assert trace.chain()[-1][1] >= stamps[0]


@pytest.mark.parametrize("speaker", [one for one in SPEAKERS if one.dialect != "tgi"], ids=lambda one: one.dialect)
class TestThinking:
    def test_is_no_token_and_becomes_a_fact(self, speaker: Speaker) -> None:
        thoughts = [speaker.thinking("hm"), speaker.thinking(", well")]
        pieces = answer(speaker)
        texts, trace = answered(speaker, [*pieces[:2], *thoughts, *pieces[2:]])
        assert texts == ["go", "_to"]
        assert trace.facts["thinking_pieces"] == 2
        assert 0 <= trace.facts["thinking_ms"] < 20_000

    def test_alone_is_no_answer(self, speaker: Speaker) -> None:
        pieces = [head(kind=speaker.kind), speaker.thinking("hm"), speaker.closing([])]
        with pytest.raises(RequestFailed, match="thought and gave no answer: raise `max_tokens`"):
            answered(speaker, pieces)


@pytest.mark.parametrize("speaker", [Cloud(), Ollama()], ids=lambda one: one.dialect)
def test_a_server_that_only_pings_is_given_up_at_the_deadline(speaker: Speaker) -> None:
    ping = b": ping\n\n" if "stream" in speaker.kind else b"\n"

    def drip(_: Received) -> Iterator[bytes]:
        yield head(kind=speaker.kind)
        yield speaker.token(GO_TO[0])
        while not Event().wait(0.01):
            yield ping

    with (
        client_of(speaker, drip, deadline_s=1.0) as client,
        pytest.raises(RequestFailed, match=r"did not end its answer within 1 s"),
    ):
        ask(client, Request("a", "plan"))


@by_framing
def test_a_silent_server_is_given_up(speaker: Speaker) -> None:
    over = Event()

    def silent(_: Received) -> Iterator[bytes]:
        yield head(kind=speaker.kind)
        over.wait(20)

    with client_of(speaker, silent, timeout_s=0.2) as client:
        with pytest.raises(RequestFailed, match="silent for too long: ReadTimeout"):
            ask(client, Request("a", "plan"))
        over.set()


def kept_until_the_second(speaker: Speaker) -> Reply:
    """Keep the connection, and close it without an answer when the second request has come."""
    whole = [kept_head(speaker.kind), chunk(b"".join(answer(speaker)[1:])), chunk(b"")]
    replies = iter([whole, [CLOSE], whole, whole])
    return lambda _: next(replies)


@by_framing
def test_a_request_that_had_to_be_sent_again_says_so_and_no_other(speaker: Speaker) -> None:
    with client_of(speaker, kept_until_the_second(speaker)) as client:
        outcomes = [ask(client, Request(str(number), "plan")) for number in range(3)]
    assert [len(tokens) for tokens, _ in outcomes] == [2, 2, 2]
    assert [trace.facts.get("reconnects") for _, trace in outcomes] == [None, 1, None]


@by_framing
def test_a_new_connection_that_is_closed_is_an_error_and_not_a_second_request(speaker: Speaker) -> None:
    with client_of(speaker, kept_until_the_second(speaker), connection="per-request") as client:
        ask(client, Request("a", "plan"))
        with pytest.raises(RequestFailed):
            ask(client, Request("b", "plan"))


class TestKeys:
    def headers(self, speaker: Speaker, monkeypatch: pytest.MonkeyPatch) -> dict[str, str]:
        seen: list[Received] = []

        def reply(received: Received) -> Pieces:
            seen.append(received)
            return answer(speaker)

        monkeypatch.setenv("MY_KEY", " sekret \n")
        with client_of(speaker, reply, api_key_env="MY_KEY") as client:
            ask(client, Request("a", "plan"))
        return seen[-1].headers

    def test_a_key_travels_in_the_header_of_the_dialect(
        self, speaker: Speaker, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        headers = self.headers(speaker, monkeypatch)
        if speaker.dialect == "gemini":
            assert headers["x-goog-api-key"] == "sekret"
            assert "authorization" not in headers
        else:
            assert headers["authorization"] == "Bearer sekret"

    def test_a_server_that_repeats_the_key_does_not_make_us_repeat_it(
        self, speaker: Speaker, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setenv("MY_KEY", "sekret")
        pieces = [head("401 No", "application/json"), speaker.refusal(401, "the key sekret is wrong")]
        with pytest.raises(RequestFailed, match=r"the key \*\*\* is wrong; the key in \$MY_KEY is not accepted"):
            answered(speaker, pieces, api_key_env="MY_KEY")

    @pytest.mark.parametrize(
        ("name", "value"), [("sk-12-34", None), ("NO_SUCH", None), ("EMPTY", " "), ("ODD", "a\nb")]
    )
    def test_a_bad_variable_is_named_without_its_content(
        self, name: str, value: str | None, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        if value is not None:
            monkeypatch.setenv(name, value)
        with pytest.raises(UsageError, match="`api_key_env`") as error:
            open_client(wiring_of("http/as-deployed", url="http://x", dialect="openai", api_key_env=name))
        assert "sk-12" not in str(error.value)
        assert "a\nb" not in str(error.value)


@pytest.mark.parametrize(
    ("dialect", "base", "path"),
    [
        ("openai", "", "/v1/chat/completions"),
        ("openai", "/v1/", "/v1/chat/completions"),
        ("openai", "/openai/v1", "/openai/v1/chat/completions"),
        ("openai", "/v1beta/openai/chat/completions", "/v1beta/openai/chat/completions"),
        ("openai", "/v1?api-version=2", "/v1/chat/completions?api-version=2"),
        ("ollama", "", "/api/chat"),
        ("ollama", "/api", "/api/chat"),
        ("tgi", "", "/generate_stream"),
        ("tgi", "/generate_stream", "/generate_stream"),
        ("gemini", "/v1beta/", "/v1beta/models/a%2Fb:streamGenerateContent?alt=sse"),
        ("gemini", "/v1", "/v1/models/a%2Fb:streamGenerateContent?alt=sse"),
        ("openvla", "", "/act"),
        ("openvla", "/act", "/act"),
    ],
)
def test_a_url_may_end_at_the_server_the_api_or_the_route(dialect: str, base: str, path: str) -> None:
    client = open_client(wiring_of("http/as-deployed", url="http://h:1" + base, dialect=dialect, served_model="a/b"))
    client.close()
    assert client.describe() == {"url": "http://h:1" + path, "dialect": dialect}


@pytest.mark.parametrize(
    ("owner", "dialect"),
    [("llamacpp", "llama-server"), ("vllm", "vllm"), ("s2a-bench", "s2a"), ("library", "openai"), (None, "openai")],
)
def test_an_openai_server_is_told_by_whom_its_model_is_owned(owner: str | None, dialect: str) -> None:
    requests = []

    def reply(received: Received) -> Pieces:
        requests.append((received.method, received.path))
        body = b'{"object":"list","data":[{"id":"m","owned_by":"%s"}]}' % (owner or "").encode()
        return [head(kind="application/json"), body] if owner else [head("404 Not Found", "text/html"), b"no"]

    with client_of(LlamaServer(), reply, dialect="") as client:
        assert client.describe()["dialect"] == dialect
    assert requests == [("GET", "/v1/models")]


def test_a_grammar_reaches_the_servers_that_know_it_and_is_refused_elsewhere(speaker: Speaker) -> None:
    handler = RecordingHandler(["x"])
    request = Request("a", "plan", grammar='root ::= "x"')
    with client_of(speaker, answering(speaker, handler)) as client:
        if speaker.dialect in {"llama-server", "vllm"}:
            ask(client, request)
            assert handler.requests[0].grammar == 'root ::= "x"'
        else:
            with pytest.raises(UsageError, match=f"`grammar`: the dialect '{speaker.dialect}' has no field"):
                ask(client, request)


def test_extra_fields_are_merged_and_null_takes_one_out() -> None:
    seen: list[Received] = []
    speaker = SPEAKERS[0]

    def reply(received: Received) -> Pieces:
        seen.append(received)
        return answer(speaker)

    extra = '{"max_tokens": null, "max_completion_tokens": 9, "stream_options": {"include_obfuscation": false}}'
    with client_of(speaker, reply, extra_body=extra) as client:
        ask(client, Request("a", "plan"))
    body = seen[0].json
    assert "max_tokens" not in body
    assert body["max_completion_tokens"] == 9
    assert body["stream_options"] == {"include_usage": True, "include_obfuscation": False}


@pytest.mark.parametrize("reason", ["SAFETY", "RECITATION"])
def test_an_answer_that_a_filter_cut_is_a_failure(reason: str) -> None:
    last = b'data: {"candidates":[{"finishReason":"%s"}]}\n\n' % reason.encode()
    with pytest.raises(RequestFailed, match=f"the answer was cut: {reason}"):
        answered(Gemini(), [*answer(Gemini())[:-1], last])
    last = b'data: {"promptFeedback":{"blockReason":"%s"}}\n\n' % reason.encode()
    with pytest.raises(RequestFailed, match=f"the prompt was refused: {reason}"):
        answered(Gemini(), [head(), last])


def test_both_variants_say_the_same(speaker: Speaker) -> None:
    handlers = []
    for variant in ("as-deployed", "best-effort"):
        handler = RecordingHandler(["x"])
        handlers.append(handler)
        with serving(answering(speaker, handler)) as url:
            client = open_client(replace(route(speaker, url), variant=variant))
            ask(client, Request("a", "Grüße", (yuyv_frame(),), max_tokens=3, seed=5))
            client.close()
    (first,), (second,) = (handler.requests for handler in handlers)
    assert (first.prompt, first.max_tokens, first.seed) == (second.prompt, second.max_tokens, second.seed)
    np.testing.assert_array_equal(first.images[0].data, second.images[0].data)


def test_every_dialect_is_tested_here_or_in_a_module_of_its_own() -> None:
    assert set(DIALECTS) == {speaker.dialect for speaker in SPEAKERS} | {"s2a", "openvla"}


def listing(path: str, body: str, chat: Reply) -> Reply:
    """A server with one list of models, and nothing else beside its chat."""

    def reply(received: Received) -> Iterable[bytes]:
        if received.method == "POST":
            return chat(received)
        found = received.path == path
        return [head("200 OK" if found else "404 Not Found", "application/json"), body.encode() if found else b"{}"]

    return reply


class TestWhatAServerHas:
    """Model and version of the API are what the server says, unless told."""

    def described(self, reply: Reply, **options: Any) -> dict[str, str]:
        with serving(reply) as url:
            client = open_client(wiring_of("http/as-deployed", url=url, **options))
            client.close()
            return {name: value.removeprefix(url) for name, value in client.describe().items()}

    @pytest.mark.parametrize("dialect", ["openai", "vllm", "ollama", ""])
    def test_the_first_model_of_the_list_is_asked(self, dialect: str) -> None:
        seen: list[Received] = []
        speaker = Ollama() if dialect == "ollama" else Cloud()

        def chat(received: Received) -> Pieces:
            seen.append(received)
            return answer(speaker)

        reply = listing("/v1/models", '{"data":[{"id":"qwen-vl","owned_by":"x"},{"id":"other"}]}', chat)
        with serving(reply) as url:
            client = open_client(wiring_of("http/as-deployed", url=url, dialect=dialect))
            ask(client, Request("a", "plan"))
            client.close()
        assert client.describe()["model"] == "qwen-vl"
        assert seen[0].json["model"] == "qwen-vl"

    @pytest.mark.parametrize("body", ["", "[]", '{"data":[]}', '{"data":[{"id":7}]}', '{"data":null}', "[" * 100_000])
    def test_a_list_that_makes_no_sense_is_no_list(self, body: str) -> None:
        assert "model" not in self.described(listing("/v1/models", body, lambda _: []), dialect="openai")

    def test_a_model_that_is_named_is_not_looked_for(self) -> None:
        reply = listing("/v1/models", '{"data":[{"id":"other"}]}', lambda _: [])
        assert "model" not in self.described(reply, dialect="openai", served_model="mine")

    @pytest.mark.parametrize("version", ["/v1beta", "/v1"])
    def test_gemini_is_asked_in_the_version_that_is_there(self, version: str) -> None:
        models = (
            '{"models":[{"name":"models/embed","supportedGenerationMethods":["embedContent"]},{"name":"models/g"}]}'
        )
        described = self.described(listing(f"{version}/models", models, lambda _: []), dialect="gemini")
        assert described["url"] == f"{version}/models/g:streamGenerateContent?alt=sse"
        assert described["model"] == "g"

    def test_a_gateway_lists_its_models_as_openai_does_and_speaks_geminis_usual_version(self) -> None:
        reply = listing("/v1/models", '{"data":[{"id":"gpt"}]}', lambda _: [])
        assert self.described(reply, dialect="gemini")["url"] == "/v1beta/models/gpt:streamGenerateContent?alt=sse"

    def test_a_dead_server_is_told_before_flags_are_judged(self) -> None:
        with pytest.raises(ServerDied, match=r"nothing answers at http://127\.0\.0\.1:9/v1/models"):
            open_client(wiring_of("http/as-deployed", url="http://127.0.0.1:9"))

    def test_a_dead_server_that_needs_no_asking_is_told_with_the_first_request(self) -> None:
        client = open_client(route(Cloud(), "http://127.0.0.1:9"))
        with pytest.raises(ServerDied, match=r"nothing answers at http://127\.0\.0\.1:9/"):
            ask(client, Request("a", "plan"))


@pytest.mark.parametrize(
    ("status", "said_"),
    [
        ("400 Bad Request", "Invalid model name passed in model=default"),
        ("404 Not Found", "The model `default` does not exist."),
        ("500 Oops", 'model "default" not found, try pulling it first'),
    ],
)
def test_a_model_that_is_not_there_has_its_hint_whatever_the_status(status: str, said_: str) -> None:
    pieces = [head(status, "application/json"), Cloud().refusal(int(status[:3]), said_)]
    with pytest.raises(RequestFailed, match=r"name a model that it has with `served_model` \(now 'default'\)"):
        answered(Cloud(), pieces)
    with pytest.raises(RequestFailed, match="`served_model`"):
        answered(Cloud(), [head(), Cloud().error(said_)])


def test_an_overloaded_tgi_says_so_in_its_stream_and_has_the_advice_of_a_429() -> None:
    refusal = b'data:{"error":"Model is overloaded","error_type":"overloaded"}\n\n'
    with pytest.raises(RequestFailed, match="Model is overloaded; it wants fewer requests: see its quota"):
        answered(Tgi(), [head(kind=Tgi().kind), refusal])


@pytest.mark.parametrize("speaker", [Cloud(), Gemini()], ids=lambda one: one.dialect)
def test_a_usage_of_zeros_is_absent_and_noted(speaker: Speaker) -> None:
    nothing = {
        "openai": b'data: {"choices":[],"usage":{"prompt_tokens":0,"completion_tokens":0,"total_tokens":0}}\n\n',
        "gemini": b'data: {"usageMetadata":{"promptTokenCount":0,"candidatesTokenCount":0}}\n\n',
    }[speaker.dialect]
    pieces = [head(kind=speaker.kind), b"" if speaker.dialect == "gemini" else speaker.token(GO_TO[0])]
    pieces += [b'data: {"candidates":[{"content":{"parts":[{"text":"go"}]}}]}\n\n'] if not pieces[1] else []
    _, trace = answered(speaker, [*pieces, nothing, speaker.bare_closing(GO_TO)])
    assert not {"prompt_n", "predicted_n"} & set(trace.facts)
    assert trace.facts["usage_zero"] == 1


def test_llama_servers_own_rate_says_how_many_steps_its_time_covers() -> None:
    timings = {"prompt_ms": 1.0, "predicted_n": 6, "predicted_ms": 1.8, "predicted_per_second": 2777.7778}
    event = DIALECTS["llama-server"]().event({"choices": [], "timings": timings})
    assert event.facts["predicted_steps"] == 5
