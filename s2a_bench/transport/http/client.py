"""The HTTP client on httpx: encode, pack, send, read the event stream, and mark each step.

A black box (llama-server, any OpenAI-compatible server) sends no marks. llama-server's response headers leave when
its slot starts, so for it they end the stage `ingest`, the first token ends `inference`, and its ``timings`` become
facts.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from typing import Any

import httpx
from httpx_sse import EventSource

from s2a_bench.clock import now_ns
from s2a_bench.errors import RequestFailed, ServerDied, TransportError
from s2a_bench.trace import Trace
from s2a_bench.transport import Route
from s2a_bench.transport.http import dialect
from s2a_bench.transport.pictures import encoded
from s2a_bench.types import Request, Token

FACTS = ("cache_n", "prompt_n", "prompt_ms", "predicted_n", "predicted_ms")
"""What of llama-server's ``timings`` is kept."""


class HttpClient:
    """One variant of the HTTP pipeline."""

    def __init__(self, route: Route, alive: Callable[[], bool]) -> None:
        """Prepare to ask the server at ``route.address``; nothing is sent yet."""
        self.camera = None
        self._route = route
        self._alive = alive
        self._codec = dialect.CODECS[route.variant]
        path = dialect.PATHS[dialect.AS_DEPLOYED if route.black_box else route.variant]
        self._url = route.address.rstrip("/").removesuffix("/v1") + path
        self._headers = {"content-type": "application/json"}
        if route.connection != "keep-alive":
            self._headers["connection"] = "close"
        self._client = self._new_client() if route.connection != "client-per-request" else None

    def _new_client(self) -> httpx.Client:
        """Build the client; its TLS context alone takes about 20 ms, which is why it is normally built once."""
        # a kept connection stays kept, however long a turn of the other cells takes
        limits = httpx.Limits(keepalive_expiry=None)
        return httpx.Client(timeout=self._route.timeout_s, trust_env=False, limits=limits)

    def request(self, request: Request, trace: Trace) -> Iterator[Token]:
        """Encode and send the request and yield the streamed tokens."""
        body, headers = self._pack(request, trace)
        client = self._client
        if client is None:
            client = self._new_client()
            trace.mark("connect")
        packed_ns = trace.marks[-1][1]
        try:
            with _translated(self._alive, self._url), ExitStack() as stack:
                response = self._send(client, body, headers, stack, trace)
                headers_ns = now_ns()
                streams = response.headers.get("content-type", "").startswith("text/event-stream")
                if response.status_code != httpx.codes.OK or not streams:
                    response.read()
                    raise RequestFailed(f"{self._url} answered {response.status_code}: {_error_of(response.text)}")
                yield from self._tokens(response, trace, headers_ns, packed_ns)
        finally:
            if client is not self._client:
                client.close()

    def _send(
        self, client: httpx.Client, body: bytes, headers: dict[str, str], stack: ExitStack, trace: Trace
    ) -> httpx.Response:
        """Send the request; once more if the server had just closed the kept connection, as HTTP clients do.

        llama-server announces keep-alive and yet closes after every streamed answer.
        """
        try:
            return stack.enter_context(client.stream("POST", self._url, content=body, headers=headers))
        except (httpx.RemoteProtocolError, httpx.ReadError, httpx.WriteError):
            if self._route.connection != "keep-alive":
                raise
            trace.facts["reconnects"] = 1.0
            return stack.enter_context(client.stream("POST", self._url, content=body, headers=headers))

    def _pack(self, request: Request, trace: Trace) -> tuple[bytes, dict[str, str]]:
        """Build the body, marking each stage."""
        fields = dialect.parameters(request, self._route.model, black_box=self._route.black_box)
        if self._route.variant == dialect.BINARY:
            media_type, data = "application/octet-stream", None
            for frame in request.images[:1]:
                media_type, data = encoded(frame, self._route.payload, trace)
            fields["prompt"] = request.prompt
            header = json.dumps(fields)  # headers are ASCII, which the standard library's JSON is
            body = data.tobytes() if data is not None else b""
            headers = {**self._headers, "content-type": media_type, dialect.PARAMETERS_HEADER: header}
        else:
            uris = []
            for frame in request.images:
                media_type, data = encoded(frame, self._route.payload, trace)
                text = self._codec.to_base64(data)
                trace.mark("base64_encode")
                uris.append(dialect.data_uri(media_type, text))
            fields["messages"] = dialect.messages(request.prompt, uris)
            body, headers = self._codec.dumps(fields), self._headers
        trace.mark("json_pack")
        trace.facts["payload_bytes"] = len(body)
        return body, headers

    def _tokens(self, response: httpx.Response, trace: Trace, headers_ns: int, packed_ns: int) -> Iterator[Token]:
        """Yield the tokens of an event stream; after the last, complete the trace."""
        first_ns, index, finished, done = 0, 0, False, False
        for data in _events(response):
            if data == "[DONE]":
                done = True
                continue  # read to the end, or the connection could not be kept
            event = self._codec.loads(data)
            if "error" in event:
                raise RequestFailed(f"the server broke off: {_message_of(event['error'])}")
            for choice in event.get("choices") or ():
                text = (choice.get("delta") or {}).get("content")
                finished = finished or bool(choice.get("finish_reason"))
                if text is not None and (text or not self._route.black_box):  # black boxes open with an empty one
                    if not first_ns:
                        first_ns = now_ns()
                        if not self._route.black_box:
                            trace.marks.append(("return", first_ns))
                    yield Token(index, text, choice.get("token", -1))
                    index += 1
            self._learn(event, trace)
        if not (done or finished):
            raise RequestFailed(f"{self._url} ended the stream before the answer was complete")
        if self._route.black_box and first_ns:
            known = "prompt_ms" in trace.facts  # only llama-server's headers are known to wait for the slot
            trace.marks += [("ingest", headers_ns), ("inference", first_ns)] if known else [("server", first_ns)]
            trace.facts["headers_ms"] = (headers_ns - packed_ns) / 1e6

    @staticmethod
    def _learn(event: dict[str, Any], trace: Trace) -> None:
        """Keep the server's marks and what it says about caching and timing."""
        if "s2a" in event:
            trace.receive(dialect.remote_of_json(event["s2a"]))
        timings = event.get("timings") or {}
        trace.facts.update({name: float(timings[name]) for name in FACTS if name in timings})
        usage = event.get("usage") or {}
        cached = (usage.get("prompt_tokens_details") or {}).get("cached_tokens")
        if cached is not None:
            trace.facts.setdefault("cache_n", float(cached))

    def close(self) -> None:
        """Close the kept connection."""
        if self._client is not None:
            self._client.close()


def _events(response: httpx.Response) -> Iterator[str]:
    """Yield the data of each server-sent event, comments and empty events left out."""
    for event in EventSource(response).iter_sse():
        if event.data:
            yield event.data


@contextmanager
def _translated(alive: Callable[[], bool], url: str) -> Iterator[None]:
    """Turn what httpx and the JSON decoders raise into this project's errors."""
    try:
        yield
    except httpx.ConnectError as error:
        raise ServerDied(f"nothing answers at {url}: {error}") from error
    except httpx.TimeoutException as error:
        raise RequestFailed(f"{url} was silent for too long: {type(error).__name__}") from error
    except httpx.RequestError as error:
        if not alive():
            raise ServerDied(f"the server at {url} is gone: {error}") from error
        raise RequestFailed(f"{url} broke the connection: {error}") from error
    except (ValueError, KeyError, TypeError, AttributeError) as error:  # JSON errors are ValueErrors
        raise RequestFailed(f"{url} does not speak the OpenAI dialect: {error!r}") from error
    except httpx.InvalidURL as error:
        raise TransportError(f"--url: '{url}' is no URL: {error}") from error


def _error_of(text: str) -> str:
    """Return the message inside an error body, or the start of the body."""
    try:
        return _message_of(json.loads(text)["error"])
    except (ValueError, KeyError, TypeError):
        return text[:200].strip() or "nothing"


def _message_of(error: Any) -> str:
    """Return the message of an OpenAI error object, which some servers send as a plain string."""
    return str(error.get("message", error)) if isinstance(error, dict) else str(error)
