"""What is read of MessagePack from outside, by openpi's protocol and by GR00T's."""

from __future__ import annotations

import struct
from collections.abc import Callable
from functools import partial
from typing import Any

import msgpack
import numpy as np
import pytest

from s2a_bench.errors import RequestFailed
from s2a_bench.plugins.policy_servers.messagepack import MAP, VALUES
from s2a_bench.plugins.policy_servers.websocket.codec import packb, unpackb
from s2a_bench.plugins.policy_servers.zmq import wire
from s2a_bench.plugins.policy_servers.zmq.wire import pack

HOSTILE = {
    "nothing": b"",
    "half a message": msgpack.packb({"a": bytes(9)})[:-5],
    "two messages": b"\x01\x01",
    "no message": b"\xc1",
    "no UTF-8": b"\xa2\xff\xfe",
    "a list of 2^32 elements": b"\xdd\xff\xff\xff\xff",
    "a map of 2^32 keys": b"\xdf\xff\xff\xff\xff",
    "bytes of 2^32": b"\xc6\xff\xff\xff\xff",
    "deep lists": b"\x91" * 100_000,
    "deep lists with room": b"\x91" * 400 + b"\xdd\x00\x00\x0f\xff" * 100,
    "very many lists": (b"\xdc\x0f\xff" + b"\x90" * 4095) * 64,
    "very many maps": b"\xdc\x0f\xff" + (b"\xdc\x0f\xff" + b"\x80" * 4095) * 4095,
    "a key that is a number": b"\x81\x01\x01",
    "a key that is a list": b"\x81\x90\x01",
    "half a surrogate pair": b"\x81\xa8endpoint\xa3\xed\xa0\x80",
    "an extension": msgpack.packb(msgpack.ExtType(5, b"abc")),
    "an extension of no bytes": b"\xc7\x00\x05",
    "a time stamp of 32 bits": msgpack.packb(msgpack.Timestamp(1)),
    "a time stamp of 64 bits": msgpack.packb(msgpack.Timestamp(1, 1)),
    "a time stamp of 96 bits": b"\xc7\x0c\xff" + struct.pack(">Iq", 1, -1),
    "a time stamp of no bytes": b"\xc7\x00\xff",
}


def unpack(data: Any) -> Any:
    return wire.read(data)[0]


@pytest.mark.parametrize("read", [unpackb, unpack])
@pytest.mark.parametrize("name", HOSTILE)
def test_bytes_that_are_no_message_are_refused_in_a_line(name: str, read: Callable[[bytes], Any]) -> None:
    with pytest.raises(RequestFailed, match=r"bytes that are no message: .") as failed:
        read(HOSTILE[name])
    assert str(failed.value).isprintable()
    assert len(str(failed.value)) < 300


@pytest.mark.parametrize("read", [unpackb, unpack])
def test_a_message_has_not_more_values_than_are_read(read: Callable[[bytes], Any]) -> None:
    read(msgpack.packb({str(number): 0 for number in range(MAP)}))
    with pytest.raises(RequestFailed, match="no message"):
        read(msgpack.packb({str(number): 0 for number in range(MAP + 1)}))
    with pytest.raises(RequestFailed, match=f"more than {VALUES} values"):
        read(msgpack.packb([[0] * 4000 for _ in range(20)]))


Write = Callable[[Any], bytes]
codecs = pytest.mark.parametrize(
    ("write", "read"),
    [(packb, unpackb), (pack, unpack), (partial(pack, maps=True), unpack)],
    ids=["openpi", "gr00t", "msgpack-numpy"],
)


@codecs
def test_an_array_with_gaps_travels_as_its_elements(write: Write, read: Callable[[bytes], Any]) -> None:
    array = np.arange(24, dtype=np.uint8).reshape(4, 6)
    for gaps in (array[:, ::2], np.asfortranarray(array)[:, ::2]):
        np.testing.assert_array_equal(read(write(gaps)), gaps)


@codecs
def test_what_is_no_value_does_not_travel(write: Write, read: Callable[[bytes], Any]) -> None:
    assert read(write({"a": None})) == {"a": None}
    with pytest.raises(RequestFailed, match="object is none of its types"):
        write({"a": object()})
