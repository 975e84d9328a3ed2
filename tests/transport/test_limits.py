"""How many values a JSON document may have, counted before it is parsed."""

from __future__ import annotations

import json

import pytest

from s2a_bench.errors import RequestFailed
from s2a_bench.transport.limits import VALUES, check_values


@pytest.mark.parametrize(
    "document",
    [
        b"",
        b"[" + b"[]," * (VALUES // 2 - 1) + b"[]]",
        json.dumps({"prompt": "[,{" * VALUES}).encode(),
        json.dumps({"prompt": '\\",[' * VALUES}).encode(),
        b"\xff" * 100,
    ],
)
def test_few_values_pass_whatever_their_texts_say(document: bytes) -> None:
    check_values(document)
    check_values(bytearray(document))


@pytest.mark.parametrize(
    "document",
    [
        b"[" * (VALUES + 1),
        b'{"messages": [' + b"[]," * VALUES + b"[]]}",
        b"[" + b"1," * (VALUES + 1) + b"1]",
        b'["' + b'","' * (4 * VALUES) + b'"]',
        *(json.dumps([text * VALUES, *[1] * (VALUES + 1)]).encode() for text in ("\\,[", '",[', '\\",[', "[,{")),
    ],
)
def test_too_many_are_refused(document: bytes) -> None:
    with pytest.raises(RequestFailed, match=f"more than {VALUES} values"):
        check_values(document)
