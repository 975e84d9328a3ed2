"""The rows of a watched robot, one an exchange; each looks back to the one before it, so that it is whole at once."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Annotated, Final

from s2a_bench.experiments.cells import Comparable, Metric
from s2a_bench.store.requests import SampleRow, TokenRow
from s2a_bench.store.schema import Table
from s2a_bench.trace import Mark

if TYPE_CHECKING:
    from s2a_bench.transport.tap import Seen

STAGES: Final = {"upload": "network", "server": "server", "inference": "inference", "download": "return"}
"""Stages of an exchange -> their groups, in its order."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ExchangeRow:
    """One exchange, as it was seen between the two; a time that is not known is null.

    Of a client that waits for each answer `upload`, `server`, `inference`, `download` and the next row's `think` add up
    to the next row's `period`.
    """

    cell: str
    client: int
    request_ns: int
    upload_ns: Annotated[int | None, Metric("upload", "First byte of the request to its last one.")]
    server_ns: Annotated[
        int | None,
        Metric(
            "server", "Last byte of the request to the answer, without `inference`; of a stream, to its first piece."
        ),
    ]
    inference_ns: Annotated[int | None, Metric("inference", "What the server says of it.")]
    download_ns: Annotated[int | None, Metric("download", "First byte of the answer, or first piece, to its last one.")]
    think_ns: Annotated[
        int | None,
        Metric(
            "think", "Before the request, since the client's answer before: all that its host does.", better="neither"
        ),
    ]
    period_ns: Annotated[int | None, Metric("period", "Since the client's request before.")]
    age_ns: Annotated[
        int | None,
        Metric(
            "age",
            "First byte of the request to its first action or token, or the end of its answer: "
            "the observation is at least so old.",
        ),
    ]
    dry_ns: Annotated[
        int | None,
        Metric("dry", "Before its answer: time for which no action can have been left; at least.", statistic="mean"),
    ]
    up_bytes: Annotated[int, Metric("up", "Of the request.", "bytes")]
    down_bytes: Annotated[int, Metric("down", "Of the answer.", "bytes", "neither")]
    pieces: Annotated[int, Metric("stream", "Tokens or partial actions.", "pieces", "neither")]
    horizon: Annotated[int | None, Metric("chunk", "H, the actions of an answer.", "actions", "neither")]
    dim: Annotated[int | None, Metric("action", "D, the numbers of an action.", "numbers", "neither")]
    error: str = ""


EXCHANGES: Final[Table[ExchangeRow]] = Table("exchanges", ExchangeRow)
COMPARED: Final = Comparable.of(EXCHANGES, ("period_s", "upload_s", "server_s", "inference_s", "download_s", "think_s"))


@dataclass(slots=True)
class Before:
    """The state of a client's exchanges of one kind so far."""

    request_ns: int = 0
    end_ns: int = 0
    lasts_until_ns: int = 0
    """When its actions are used up, if none was ever dropped."""


@dataclass(slots=True)
class SeenCycles:
    """Turns exchanges into rows, client by client."""

    tick_ns: float = 0.0
    """The tick of the robot's control loop; 0: unknown."""
    _before: dict[tuple[int, str], Before] = field(default_factory=dict)

    def row(self, client: int, seen: Seen) -> ExchangeRow:
        before = self._before.setdefault((client, seen.what), Before())
        sent_ns, first_ns = seen.sent_ns or seen.request_ns, first_of(seen)
        infer_ns = None if seen.infer_ms is None else round(seen.infer_ms * 1e6)
        longest_ns = (first_ns - sent_ns) if seen.pieces_ns else (seen.end_ns - seen.request_ns)
        if infer_ns is not None:  # else it is of something else
            infer_ns = min(infer_ns, first_ns - sent_ns) if 0 <= infer_ns <= longest_ns else None
        good = not seen.error and bool(seen.end_ns)
        row = ExchangeRow(
            cell=seen.what,
            client=client,
            request_ns=seen.request_ns,
            upload_ns=seen.sent_ns - seen.request_ns if good and seen.sent_ns else None,
            server_ns=first_ns - sent_ns - (infer_ns or 0) if good else None,
            inference_ns=infer_ns if good else None,
            download_ns=seen.end_ns - first_ns if good else None,
            think_ns=_since(before.end_ns, seen.request_ns),
            period_ns=_since(before.request_ns, seen.request_ns),
            age_ns=(seen.pieces_ns[0] if seen.pieces_ns else seen.end_ns) - seen.request_ns if good else None,
            dry_ns=self._dry_ns(before, seen if good else None),
            up_bytes=seen.up_bytes,
            down_bytes=seen.down_bytes,
            pieces=len(seen.pieces_ns),
            horizon=seen.chunk[0] if seen.chunk else None,
            dim=seen.chunk[1] if seen.chunk else None,
            error=seen.error or ("" if good else "no answer"),
        )
        before.request_ns, before.end_ns = seen.request_ns, seen.end_ns
        return row

    def _dry_ns(self, before: Before, seen: Seen | None) -> int | None:
        """Return for how long no action can have been left before this answer, even if none was ever dropped.

        After an answer whose actions are not known nothing is, up to the next one.
        """
        if not (self.tick_ns and seen and seen.chunk):
            before.lasts_until_ns = 0
            return None
        at_ns, left_ns = first_of(seen), before.lasts_until_ns
        before.lasts_until_ns = max(left_ns, at_ns) + round(seen.chunk[0] * self.tick_ns)
        return max(0, at_ns - left_ns) if left_ns else None


def first_of(seen: Seen) -> int:
    """Return when the answer began: of a stream, its first piece."""
    return seen.pieces_ns[0] if seen.pieces_ns else seen.answer_ns


def _since(before_ns: int, at_ns: int) -> int | None:
    return at_ns - before_ns if 0 < before_ns <= at_ns else None


def sample_of(row: ExchangeRow, seen: Seen, number: int, transport: str) -> SampleRow:
    """Return the exchange as other commands read requests: a chain of marks up to its first piece, or its end."""
    at_ns, marks = seen.request_ns, list[Mark]()
    if not row.error:
        marks.append(("", at_ns))
        for stage in STAGES if not seen.pieces_ns else [*STAGES][:-1]:
            spent_ns = getattr(row, f"{stage}_ns")
            if spent_ns is not None:
                marks.append((stage, at_ns := at_ns + spent_ns))
    return SampleRow(
        cell=row.cell,
        pipeline=transport,
        variant="",
        payload="",
        connection="",
        engine="",
        mode="request",
        size="",
        block=0,
        position=number,
        warmup=False,
        request_id=str(number),
        frame_index=number,
        error=row.error,
        marks=marks,
        payload_bytes=row.up_bytes,
        n_tokens=row.pieces,
        last_token_ns=seen.pieces_ns[-1] if seen.pieces_ns else None,
    )


def tokens_of(row: ExchangeRow, seen: Seen, number: int) -> Iterator[TokenRow]:
    for index, at_ns in enumerate(seen.pieces_ns):
        yield TokenRow(str(number), row.cell, index, -1, "", None, at_ns)
