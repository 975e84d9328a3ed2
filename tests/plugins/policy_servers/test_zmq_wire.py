"""Arrays in MessagePack, as GR00T writes them."""

from __future__ import annotations

import io
import pickle
from typing import Any

import msgpack
import numpy as np
import pytest

from s2a_bench.errors import EngineError, RequestFailed
from s2a_bench.plugins.policy_servers.observed import ActionsExchange
from s2a_bench.plugins.policy_servers.zmq.layouts import actions_in
from s2a_bench.plugins.policy_servers.zmq.wire import PictureFile, array_of, file_of, pack, read
from s2a_bench.types import Token

DTYPES = ["bool", "int8", "uint8", ">u2", "int32", "uint64", "float16", "float32", ">f4", "float64"]
SHAPES = [(), (3,), (0,), (2, 3), (0, 3), (1, 1, 4, 5, 3)]


def unpack(data: Any) -> Any:
    return read(data)[0]


def saved(array: Any, **more: Any) -> bytes:
    output = io.BytesIO()
    np.save(output, array, **more)
    return output.getvalue()


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("dtype", DTYPES)
def test_files_are_numpys_byte_for_byte(dtype: str, shape: tuple[int, ...]) -> None:
    array = np.arange(np.prod(shape, dtype=int)).astype(dtype).reshape(shape)
    assert file_of(array) == saved(array)
    got = array_of(saved(array))
    assert (got.dtype, got.shape, got.tobytes()) == (array.dtype, array.shape, array.tobytes())


def test_fortrans_order_comes_back() -> None:
    array = np.asfortranarray(np.arange(24).reshape(2, 3, 4))
    np.testing.assert_array_equal(array_of(saved(array)), array)


def test_reading_copies_nothing() -> None:
    data = saved(np.arange(100, dtype=np.uint8))
    assert np.shares_memory(array_of(data), np.frombuffer(data, np.uint8))


@pytest.mark.parametrize("outer", [(), (1,), (1, 1), (1, 1, 1)])
def test_a_picture_is_packed_from_its_room(outer: tuple[int, ...]) -> None:
    room = PictureFile(48, 64)
    room.pixels[:] = np.random.default_rng(1).integers(0, 256, room.pixels.shape)
    picture = room.pixels.reshape(*outer, 48, 64, 3)
    file = room.file(picture)
    assert bytes(file) == saved(picture)
    assert pack({"a": picture}, {room.address: room}) == pack({"a": picture})


def test_what_is_not_all_of_a_room_is_packed_as_it_is() -> None:
    room = PictureFile(4, 4)
    room.pixels[:] = 1
    for part in (room.pixels[:2], room.pixels[..., :1], room.pixels.transpose(2, 0, 1)):
        np.testing.assert_array_equal(unpack(pack(part, {room.address: room})), part)


@pytest.mark.parametrize(
    "array", [np.array([{}], object), np.zeros(2, "i4,f4"), np.zeros(2, complex), np.array(["a"]), np.array([b"a"])]
)
def test_only_numbers_are_read(array: Any) -> None:
    with pytest.raises(RequestFailed, match="numbers are taken, nothing else"):
        array_of(saved(array, allow_pickle=True))


class Trap:
    """What fails the test if it is unpickled."""

    def __reduce__(self) -> Any:
        return pytest.fail, ("it was unpickled",)


@pytest.fixture
def peer() -> Any:
    return pytest.importorskip("msgpack_numpy")


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("dtype", DTYPES)
def test_maps_of_msgpack_numpy_are_read_and_written(peer: Any, dtype: str, shape: tuple[int, ...]) -> None:
    array = np.arange(np.prod(shape, dtype=int)).astype(dtype).reshape(shape)
    for got in (unpack(peer.packb(array)), peer.unpackb(pack(array, maps=True))):
        assert (got.dtype, got.shape, got.tobytes()) == (array.dtype, array.shape, array.tobytes())
    assert pack({"a": array}, maps=True) == peer.packb({"a": array})


def test_a_picture_in_its_room_is_packed_as_a_map(peer: Any) -> None:
    room = PictureFile(4, 6)
    room.pixels[:] = 7
    got = peer.unpackb(pack({"a": room.pixels[np.newaxis]}, {room.address: room}, maps=True))
    np.testing.assert_array_equal(got["a"], np.full((1, 4, 6, 3), 7, np.uint8))


@pytest.mark.parametrize("number", [np.float32(0.5), np.int64(-3), np.bool_(True)])
def test_scalars_of_msgpack_numpy_are_scalars(peer: Any, number: Any) -> None:
    got = unpack(peer.packb(number))
    assert (type(got), got) == (type(number), number)


MAP = {"nd": True, "type": "<f4", "kind": "", "shape": [2], "data": bytes(8)}


@pytest.mark.parametrize("kind", ["", "f", None])
def test_keys_of_a_map_are_texts_or_bytes(kind: Any) -> None:
    for fields in ({**MAP, "kind": kind}, {key.encode(): value for key, value in {**MAP, "kind": kind}.items()}):
        np.testing.assert_array_equal(unpack(msgpack.packb(fields)), np.zeros(2, np.float32))


def test_a_dictionary_that_is_no_array_stays_one() -> None:
    config = {"__ModalityConfig_class__": True, "as_json": "{}"}
    for fields in (config, {"nd": True}, {"nd": 5, "data": b"a"}, {"data": b"a", "type": "<f4", "shape": [1]}):
        assert unpack(pack(fields)) == fields


@pytest.mark.parametrize(
    ("fields", "why"),
    [
        *(({"type": kind}, "nothing is unpickled") for kind in ("|O", [["", "|O"]], "<c8", "<f3", "f4,i8", "|S4")),
        *((fields, "nothing is unpickled") for fields in ({"kind": "V"}, {"kind": b"O"}, {"kind": {}, "type": None})),
        ({"shape": [3]}, "an array of shape"),
        ({"shape": [-1, -2]}, "an array whose shape"),
        ({"shape": [1 << 60, 1 << 60]}, "an array of shape"),
        *(({"shape": shape}, "shape") for shape in ([True, 2], [2.0], 2, None)),
        ({"data": "text"}, "not bytes"),
        ({"data": None}, "not bytes"),
    ],
)
def test_a_map_that_lies_is_refused_in_a_line(fields: dict[str, Any], why: str) -> None:
    for lie in ({**MAP, **fields}, {key.encode(): value for key, value in {**MAP, **fields}.items()}):
        with pytest.raises(RequestFailed, match=why) as failed:
            unpack(msgpack.packb(lie))
        assert len(str(failed.value)) < 200


def test_nothing_is_unpickled(peer: Any) -> None:
    for data in (pickle.dumps(Trap()), saved(np.array([Trap()], object), allow_pickle=True)):
        with pytest.raises(RequestFailed):
            unpack(msgpack.packb({"__ndarray_class__": True, "as_npy": data}))
    for kind, array in (("O", np.array([Trap()], object)), ("V", np.zeros(2, "i4,f4"))):
        with pytest.raises(RequestFailed, match=f"kind '{kind}'.*nothing is unpickled"):
            unpack(peer.packb(array))


def test_the_marks_of_a_message_are_those_of_its_arrays_and_configurations() -> None:
    array = np.zeros(2)
    for message, maps, marks in (
        ({"a": array}, False, {"n1.6"}),
        ({"a": array}, True, {"n1.7"}),
        ({"a": {"__ModalityConfig_class__": True, "as_json": {}}}, False, {"n1.6"}),
        ({"a": {"__ModalityConfig_class__": True, "as_json": "{}"}}, False, {"n1.5"}),
        ({"a": {"__ModalityConfig__": True, "as_json": {}}}, False, {"n1.7"}),
        ({"a": "n1.7"}, False, set()),
    ):
        assert read(pack(message, maps=maps))[1] == marks
    assert read(msgpack.packb([msgpack.unpackb(pack(array)), MAP]))[1] == {"n1.6", "n1.7"}


def lying(shape: str, descr: str = "'|u1'", version: bytes = b"\x01\x00") -> bytes:
    """A file of 12 bytes whose header may lie."""
    text = f"{{'descr': {descr}, 'fortran_order': False, 'shape': {shape}, }}".encode()
    return b"\x93NUMPY" + version + len(text).to_bytes(2, "little") + text + bytes(12)


@pytest.mark.parametrize(
    "file",
    [
        *("text", 5, None, b"", b"\x93NUMPY", b"\x93NUMPY\x01\x00\xff\xff{", b"\x93NUMPY\x02\x00\xff\xff\xff\xff{"),
        lying("(12,)", version=b"\x09\x00"),
        *(lying("(1,)", descr) for descr in ("[('a', '<i4'), ('b', '|O')]", "__import__('os').system('true')")),
        *map(
            lying,
            ["(3,)", "(13,)", "(-1, 4, 3)", "('a',)", f"({10**30}, {10**30})", f"(0, {2**60}, 3)", f"({'1, ' * 1000})"],
        ),
    ],
    ids=lambda file: repr(file)[:60],
)
def test_a_file_that_is_none_is_refused_in_a_line(file: Any) -> None:
    with pytest.raises(RequestFailed) as failed:
        array_of(file)
    assert str(failed.value).isprintable()
    assert len(str(failed.value)) < 200


@pytest.mark.parametrize(
    ("answer", "expected"),
    [
        ([{"a": np.ones((1, 2, 3)), "b": np.zeros((1, 2, 1))}, {}], [[1, 1, 1, 0]] * 2),
        ([{"a": [[[1.0], [2.0]]]}, {}], [[1], [2]]),
        ({"action.a": np.ones((2, 1)), "action.b": np.zeros(2), "took": 5}, [[1, 0]] * 2),
        ({"action": np.ones((2, 2))}, [[1, 1]] * 2),
        ({"a": np.ones((2, 2), np.float16)}, [[1, 1]] * 2),
    ],
)
def test_parts_of_actions_stand_side_by_side(answer: Any, expected: Any) -> None:
    assert [action.values.tolist() for action in actions_in(answer)] == expected


def test_neither_tokens_nor_nothing_are_an_answer() -> None:
    with pytest.raises(EngineError, match="choose `answer` actions"):
        ActionsExchange().send(Token(0, "go"))
    with pytest.raises(EngineError, match="no action at all"):
        ActionsExchange().chunk()
