"""The HTTP client: encode, pack, send, read the answer, and mark each step, in every dialect.

Our server sends its marks with the last event. A black box sends none. If it is known to send its response headers when
inference starts (llama-server), they end the stage `ingest` and the first token ends `inference`; otherwise the time
from the last byte packed to the first token is the stage `server`. The first token is the first text of the answer:
empty pieces and thinking do not count. Times that a server reports become facts.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from functools import partial
from typing import Any

import httpx

from s2a_bench.clock import now_ns
from s2a_bench.errors import RequestFailed, ServerDied, TransportError, UsageError
from s2a_bench.facts import HEADERS_OFF_MS, PAYLOAD_BYTES, PROMPT_MS, RECONNECTS, THINKING_N
from s2a_bench.secrets import struck
from s2a_bench.trace import Trace
from s2a_bench.transport import Client, Wiring
from s2a_bench.transport.http import HEADERS_MS, THINKING_MS, THINKING_PIECES, native
from s2a_bench.transport.http.clients import HttpResponse, LeanClient, pieces, usual_client
from s2a_bench.transport.http.detect import met, text_of
from s2a_bench.transport.http.dialects import NATIVE, Event, open_dialect
from s2a_bench.transport.http.dialects.common import NO_MODEL
from s2a_bench.transport.http.dialects.decoder import Decoder, error_in
from s2a_bench.transport.http.options import HttpOptions, merged, read_patch
from s2a_bench.transport.limits import Bounds
from s2a_bench.transport.listening import read_key
from s2a_bench.transport.pictures import encoded
from s2a_bench.types import Piece, Request, Token

UNKNOWN_MODEL = re.compile(
    r"\bmodel\b.{0,200}?(not found|not exist|n't exist)|model_not_found|(invalid|unknown|no such) model",
    re.IGNORECASE | re.DOTALL,
)
"""Messages of servers, with any status, that they have no such model."""

QUOTED = 200
QUOTED_BYTES = 1 << 16
"""Characters that are quoted of a body that is not an error object."""


class HttpClient(Client):
    def __init__(self, wiring: Wiring[HttpOptions], alive: Callable[[], bool]) -> None:
        """Prepare requests to ``wiring.address``; a black box of unknown dialect is asked for its list of models."""
        self._wiring, self._alive = wiring, alive
        options, key = wiring.options, read_key(wiring.options.api_key_env)
        self._codec = native.CODECS[wiring.variant]
        if wiring.black_box:
            self._dialect, self._url, self._model = met(wiring.address, key, options)
        else:
            self._dialect, self._model = open_dialect(NATIVE), options.served_model or NO_MODEL
            self._url = wiring.address.rstrip("/") + native.PATHS[wiring.variant]
        self._options = options.model_copy(update={"served_model": self._model})  # for advice
        self._extra = read_patch(options.extra_body)
        self._headers = {"content-type": "application/json", **(self._dialect.authorization(key) if key else {})}
        if options.connection != "keep-alive":
            self._headers["connection"] = "close"
        self._client = self._new_client() if options.connection != "client-per-request" else None

    def describe(self) -> dict[str, str]:
        named = {"model": self._model} if self._model not in {self._wiring.options.served_model, NO_MODEL} else {}
        return {"url": self._url, "dialect": self._dialect.name, **named}

    def _new_client(self) -> httpx.Client | LeanClient:
        """Build the client of the variant; over TLS every variant has httpx, whose TLS context alone takes 20 ms."""
        address = self._wiring.address
        lean = self._wiring.variant in {native.BEST_EFFORT, native.BINARY} and not address.startswith("https:")
        return LeanClient() if lean else usual_client(address, self._wiring.timeout_s)

    def request(self, request: Request, trace: Trace) -> Iterator[Piece]:
        """Encode and send the request and yield the streamed pieces.

        Like other HTTP clients it repeats a request if the server has just closed the kept connection: llama-server
        announces keep-alive and yet closes after every streamed answer.
        """
        body, headers = self._pack(request, trace)
        client = self._client
        if client is None:
            client = self._new_client()
            trace.mark("connect")
        packed_ns = trace.marks[-1][1]
        bounds = self._wiring.bounds(self._wiring.address, request.max_tokens)
        timeout_s = min(self._wiring.timeout_s, bounds.left_s())
        try:
            with self._translated(bounds), ExitStack() as stack:
                post: Callable[[], Any] = partial(
                    client.stream, "POST", self._url, content=body, headers=headers, timeout=timeout_s
                )
                try:
                    response: HttpResponse = stack.enter_context(post())
                except (httpx.RemoteProtocolError, httpx.ReadError, httpx.WriteError):
                    if self._options.connection != "keep-alive":
                        raise
                    trace.facts[RECONNECTS] = 1.0
                    response = stack.enter_context(post())
                headers_ns = now_ns()
                blocks = pieces(response, bounds)
                self._check(response, blocks)
                yield from self._tokens(self._events(response, blocks), trace, headers_ns, packed_ns)
        finally:
            if client is not self._client:
                client.close()

    def _check(self, response: HttpResponse, body: Iterator[bytes]) -> None:
        kind = response.headers.get("content-type", "")
        expected = self._dialect.media_type
        good = (expected, native.BLOCKS) if self._dialect.name == NATIVE else (expected,)
        if response.status_code != httpx.codes.OK or not kind.startswith(good):
            raise refusal(self._url, response, text_of(_beginning(body)), self._options, expected)
        if (coding := response.headers.get("content-encoding", "identity")) != "identity":
            raise RequestFailed(f"{self._url} compressed its answer ({coding}) without being asked to")

    def _pack(self, request: Request, trace: Trace) -> tuple[Any, dict[str, str]]:
        if request.grammar and not self._dialect.takes_grammar:
            raise UsageError(
                f"`grammar`: the dialect '{self._dialect.name}' has no field for a GBNF grammar; leave it out, or ask "
                "a server of `dialect` llama-server or vllm"
            )
        if self._wiring.variant == native.BINARY:
            body, headers = self._pack_binary(request, trace)
        else:
            to_base64, payload = self._codec.to_base64, self._options.payload
            fields = self._dialect.fields(request, payload, self._model, to_base64, trace)
            body, headers = self._codec.dumps(merged(fields, self._extra)), self._headers
        trace.mark("json_pack")
        trace.facts[PAYLOAD_BYTES] = sum(map(len, body)) if isinstance(body, list) else len(body)
        return body, headers

    def _pack_binary(self, request: Request, trace: Trace) -> tuple[Any, dict[str, str]]:
        """Build the native binary form: the pictures are the body, one after the other, the rest is a header."""
        types, bodies = [], []
        for frame in request.images:
            media_type, data = encoded(frame, self._options.payload, trace)
            types.append(media_type)
            bodies.append(data.reshape(-1).data)
        fields = native.parameters(request, self._model)
        fields |= {**native.native_parameters(request), "prompt": request.prompt}
        if len(bodies) > 1:
            fields["pictures"] = [[kind, len(body)] for kind, body in zip(types, bodies, strict=True)]
        header = json.dumps(fields)  # headers are ASCII, which the standard library's JSON is
        media_type = types[0] if len(types) == 1 else "application/octet-stream"
        headers = {**self._headers, "content-type": media_type, native.PARAMETERS_HEADER: header}
        if len(bodies) > 1:
            return bodies, {**headers, "content-length": str(sum(map(len, bodies)))}
        return (bodies[0] if bodies else b""), headers

    def _tokens(self, events: Iterator[Event], trace: Trace, headers_ns: int, packed_ns: int) -> Iterator[Piece]:
        """Yield the pieces of an answer; after the last, complete the trace."""
        first_ns, thinking_ns, thoughts, index, finished = 0, 0, 0, 0, False
        for event in events:
            if event.error:
                advice = advice_for(event.status, event.error, self._options)
                raise RequestFailed(f"{self._url}: {event.error}{'; ' if advice else ''}{advice}")
            if event.thinking:
                thinking_ns = thinking_ns or now_ns()
                thoughts += 1
            new = event.actions if event.text is None else (Token(index, event.text, event.token_id),)
            if new:
                first_ns = first_ns or now_ns()
                yield from new
                index += len(new)
            finished = finished or bool(event.finish)
            trace.learn(event.facts)
            if event.remote is not None:
                trace.receive(event.remote)
        if not finished:
            raise RequestFailed(f"{self._url} ended the stream before the answer was complete")
        if not first_ns and (thoughts or trace.facts.get(THINKING_N)):
            raise RequestFailed(
                f"{self._url} thought and gave no answer: raise `max_tokens`, or turn thinking off with `extra_body`"
            )
        if thinking_ns:
            trace.facts |= {THINKING_PIECES: float(thoughts), THINKING_MS: (first_ns - thinking_ns) / 1e6}
        if first_ns:
            self._mark(trace, headers_ns, packed_ns, first_ns)

    def _mark(self, trace: Trace, headers_ns: int, packed_ns: int, first_ns: int) -> None:
        """Mark the stages from the last byte packed to the first token, as far as they are known."""
        if trace.remote is not None:
            trace.marks.append(("return", first_ns))
            return
        trace.facts[HEADERS_MS] = (headers_ns - packed_ns) / 1e6
        if self._dialect.starts_with_headers(trace.facts):
            trace.marks += [("ingest", headers_ns), ("inference", first_ns)]
            trace.facts[HEADERS_OFF_MS] = (first_ns - headers_ns) / 1e6 - trace.facts[PROMPT_MS]
        else:
            trace.marks.append(("server", first_ns))

    def _events(self, response: HttpResponse, body: Iterator[bytes]) -> Iterator[Event]:
        if response.headers.get("content-type") == native.BLOCKS:
            decoder = Decoder(self._dialect, native.read_block, native.Blocks)
        else:
            decoder = Decoder(self._dialect, self._codec.loads)
        for data in body:
            yield from decoder.feed(data)
        yield from decoder.end()

    @contextmanager
    def _translated(self, bounds: Bounds) -> Iterator[None]:
        url = self._url
        try:
            yield
        except httpx.ConnectError as error:
            raise ServerDied(f"nothing answers at {url}: {error}") from error
        except httpx.TimeoutException as error:
            bounds.left_s()  # raises where the deadline, not the silence, was the shorter time-out
            raise RequestFailed(f"{url} was silent for too long: {type(error).__name__}", starting=True) from error
        except httpx.RequestError as error:
            if not self._alive():
                raise ServerDied(f"the server at {url} has ended: {error}") from error
            raise RequestFailed(f"{url} broke the connection: {error}", starting=True) from error
        except httpx.InvalidURL as error:
            raise TransportError(f"`url`: '{url}' is not a URL: {error}") from error

    def close(self) -> None:
        if self._client is not None:
            self._client.close()


def _beginning(body: Iterator[bytes]) -> Iterator[bytes]:
    """Yield the beginning of a refusal, up to `QUOTED_BYTES`; one that does not end is quoted all the same."""
    size = 0
    with suppress(RequestFailed, httpx.TimeoutException):
        while size < QUOTED_BYTES and (piece := next(body, b"")):
            yield piece
            size += len(piece)


def refusal(url: str, response: HttpResponse, body: str, options: HttpOptions, expected: str) -> RequestFailed:
    try:
        value = json.loads(body)
    except (ValueError, RecursionError):  # it is not JSON, or is nested too deep
        value = None
    message = error_in(value) or struck(body)[:QUOTED].strip() or "nothing"
    kind = response.headers.get("content-type", "no content type").partition(";")[0]
    if response.status_code == httpx.codes.OK and not kind.startswith(expected):
        message += f" (as {kind} where {expected} belongs; see `dialect`)"
    wait_s = _retry_after_s(response, value)
    wait = f"; it asks to wait {wait_s:g} s" if wait_s else ""
    advice = advice_for(response.status_code, message, options, moved=response.headers.get("location", ""))
    line = f"{url} answered {response.status_code}: {' '.join(message.split())}{wait}{'; ' if advice else ''}{advice}"
    return RequestFailed(line, retry_after_s=wait_s, starting=response.status_code in {502, 503, 504})


def advice_for(status: int, message: str, options: HttpOptions, *, moved: str = "") -> str:
    if httpx.codes.is_redirect(status):
        return f"it moved: give {moved or 'its new place'} to `url`"
    if UNKNOWN_MODEL.search(message):
        return f"name a model that it has with `served_model` (now '{options.served_model}')"
    key = f"the key in ${options.api_key_env} is not accepted"
    no_key = "name the environment variable that holds its key with `api_key_env`"
    return {
        401: key if options.api_key_env else no_key,
        403: key if options.api_key_env else no_key,
        404: f"see `url`, `dialect` and `served_model` (now '{options.served_model}')",
        413: "choose a smaller `size`, or `payload` jpeg",
        429: "it wants fewer requests: see its quota, or `requests`",
    }.get(status, "")


def _retry_after_s(response: HttpResponse, body: Any) -> float | None:
    """Return how long the server asks to wait: seconds in the header, or Google's RetryInfo in the body.

    A date (RFC 9110, 10.2.3) is ignored: it comes from another host's clock.
    """
    with suppress(ValueError):
        return max(0.0, float(response.headers.get("retry-after", "")))
    try:
        delays = [detail["retryDelay"] for detail in body["error"]["details"] if "retryDelay" in detail]
        return max(0.0, float(delays[0].removesuffix("s")))
    except (KeyError, TypeError, ValueError, IndexError, AttributeError):
        return None
