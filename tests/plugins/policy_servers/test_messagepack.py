"""What is read of MessagePack from outside, by openpi's protocol and by GR00T's; and arrays as openpi writes them."""

from __future__ import annotations

import struct
from collections.abc import Callable
from functools import partial
from itertools import product
from typing import Any

import msgpack
import numpy as np
import pytest

from s2a_bench.errors import RequestFailed
from s2a_bench.plugins.policy_servers.messagepack import LIST, MAP
from s2a_bench.plugins.policy_servers.websocket.codec import packb, unpackb
from s2a_bench.plugins.policy_servers.zmq import wire
from s2a_bench.plugins.policy_servers.zmq.wire import pack

HOSTILE = {
    "half a message": msgpack.packb({"a": bytes(9)})[:-5],
    "no message": b"\xc1",
    "no UTF-8": b"\xa2\xff\xfe",
    "a list of 2^32 elements": b"\xdd\xff\xff\xff\xff",
    "deep lists": b"\x91" * 100_000,
    "deep maps": b"\x81\xa1a" * 100_000,
    "a key that is a list": b"\x81\x90\x01",
    "half a surrogate pair": b"\x81\xa8endpoint\xa3\xed\xa0\x80",
    "an extension": msgpack.packb(msgpack.ExtType(5, b"abc")),
    "an extension of no bytes": b"\xc7\x00\x05",
    "a time stamp": b"\xc7\x0c\xff" + struct.pack(">Iq", 1, -1),
}


def unpack(data: Any) -> Any:
    return wire.read(data)[0]


@pytest.mark.parametrize("read", [unpackb, unpack])
def test_lists_and_maps_have_not_more_elements_than_are_read(read: Callable[[bytes], Any]) -> None:
    read(msgpack.packb({str(number): [0] * LIST for number in range(MAP)}))
    with pytest.raises(RequestFailed, match="not a message"):
        read(msgpack.packb({str(number): 0 for number in range(MAP + 1)}))
    with pytest.raises(RequestFailed, match="not a message"):
        read(msgpack.packb([0] * (LIST + 1)))


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
    with pytest.raises(RequestFailed, match="object is not one of its types"):
        write({"a": object()})


DTYPES = [
    *("bool", "int8", "uint8", "int16", ">u2", "int32", "uint32", "int64", "uint64"),
    *("float16", "float32", ">f4", "float64", "S5", "U3", "M8[ns]", "m8[s]"),
]


def arrays() -> list[Any]:
    made = [np.arange(6).astype(dtype).reshape(2, 3) for dtype in DTYPES]
    return [*made, np.zeros((0, 3), np.float32), np.float32(2.5), np.int64(-7), np.bool_(True), np.array(3.0)]


@pytest.mark.parametrize("array", arrays(), ids=lambda array: f"{array.dtype.str}{array.shape}")
def test_every_type_comes_back(array: Any) -> None:
    got = unpackb(packb({"a": array}))["a"]
    assert (got.dtype, got.shape) == (array.dtype, array.shape)
    assert got.tobytes() == array.tobytes()


@pytest.mark.parametrize("peer", ["openpi_client.msgpack_numpy", "policy_websocket.msgpack_numpy"])
@pytest.mark.parametrize("array", arrays(), ids=lambda array: f"{array.dtype.str}{array.shape}")
def test_peers_write_the_same_bytes_and_read_them(array: Any, peer: str) -> None:
    theirs = pytest.importorskip(peer)
    message = {"actions": array, "prompt": "go", "x": [1, 2.5, None, b"y"]}
    assert packb(message) == theirs.packb(message)
    got = theirs.unpackb(packb(message))["actions"]
    assert (got.dtype, got.shape, got.tobytes()) == (array.dtype, array.shape, array.tobytes())


@pytest.mark.parametrize("array", [np.array([object()]), np.zeros(2, "i4,f4"), np.zeros(2, complex), np.complex64(1)])
def test_objects_records_and_complex_numbers_do_not_travel(array: Any) -> None:
    with pytest.raises(RequestFailed, match="do not travel"):
        packb({"a": array})


def ndarray(data: Any = bytes(8), dtype: Any = "<f4", shape: Any = (2,)) -> bytes:
    return msgpack.packb({b"__ndarray__": True, b"data": data, b"dtype": dtype, b"shape": shape})


def generic(data: Any, dtype: Any) -> bytes:
    return msgpack.packb({b"__npgeneric__": True, b"data": data, b"dtype": dtype})


ARRAYS_THAT_ARE_NONE = {
    "objects": ndarray(dtype="|O", shape=(1,)),
    "records": ndarray(dtype="|V8", shape=(1,)),
    "records by a zero": ndarray(dtype="08f4"),
    "records of 10,000 fields": ndarray(dtype="f4," * 10_000),
    "complex numbers": ndarray(dtype="<c8", shape=(1,)),
    "a type that is none": ndarray(dtype="<f5"),
    "a type of no bytes": ndarray(b"", "S0", (1 << 40,)),
    "a type that is bytes": ndarray(dtype=b"<f4"),
    "a type of 20 digits": ndarray(dtype="S" + "9" * 20),
    "a shape that is larger": ndarray(shape=(1 << 40,)),
    "a shape that overflows": ndarray(shape=(1 << 62, 1 << 62, 0, 4)),
    "a shape below zero": ndarray(shape=(-1, -2)),
    "a shape of truths": ndarray(b"1234", shape=(True,)),
    "a shape of many axes": ndarray(b"1234", shape=(1,) * 70),
    "a shape that is none": ndarray(shape="2"),
    "data that is text": ndarray("12345678"),
    "a number that is text": generic("a" * 100, "<f4"),
    "a number beyond its type": generic(1 << 40, "|i1"),
    "a key that is an array": b"\x81" + ndarray() + b"\x01",
}


@pytest.mark.parametrize(
    ("name", "read"),
    [*product(HOSTILE, (unpackb, unpack)), *product(ARRAYS_THAT_ARE_NONE, (unpackb,))],
)
def test_bytes_that_are_no_message_are_refused_in_a_line(name: str, read: Callable[[bytes], Any]) -> None:
    with pytest.raises(RequestFailed, match=r"bytes that are not a message: .") as failed:
        read((HOSTILE | ARRAYS_THAT_ARE_NONE)[name])
    assert str(failed.value).isprintable()
    assert len(str(failed.value)) < 300


def test_the_keys_of_an_array_may_be_texts() -> None:
    array = np.arange(6, dtype=np.int16).reshape(2, 3)
    packed = packb({"a": array}, text_keys=True)
    plain = msgpack.unpackb(packed)["a"]
    assert plain == {"__ndarray__": True, "data": array.tobytes(), "dtype": "<i2", "shape": [2, 3]}
    np.testing.assert_array_equal(unpackb(packed)["a"], array)
    with pytest.raises(RequestFailed, match="does not travel"):
        unpackb(msgpack.packb({**plain, "dtype": "|O"}))


def test_a_number_beyond_its_type_is_infinite_and_arrays_are_read_only() -> None:
    assert np.isinf(unpackb(generic(1e300, "<f4")))
    assert not unpackb(ndarray()).flags.writeable
