"""lerobot's messages, which are pickles: written without its classes, read with four names and no code of others.

The names in an answer stand for functions of this module: TimedAction, torch's `_rebuild_tensor_v2` and
`_load_from_bytes`, and OrderedDict. Torch's `_load_from_bytes` is an unpickler within the unpickler (`torch.load`): its
bytes are torch's legacy format, five pickles whose only names are types of storages. Before a pickle is read its
opcodes are counted, which bounds depth, and those that a chunk does not need are refused, such as any that could make
the memo large.
"""

from __future__ import annotations

import pickle
import pickletools
from collections.abc import Mapping
from io import BytesIO
from types import SimpleNamespace
from typing import Any, Final, TypeAlias

import numpy as np
from numpy.typing import NDArray

from s2a_bench.errors import RequestFailed, UsageError
from s2a_bench.vectors import NUMBERS

Numbers: TypeAlias = NDArray[Any]
Names: TypeAlias = Mapping[tuple[str, str], Any]
"""(Module, name) -> what it stands for."""

HELPERS: Final = "lerobot.async_inference.helpers"
OPCODES: Final = 20_000
"""Most opcodes of a pickle; an action has 40, and a dictionary's key of so many nested tuples is harmless."""
NEEDED: Final = frozenset(
    {
        *("PROTO", "FRAME", "STOP", "MARK", "NONE", "NEWTRUE", "NEWFALSE", "BININT", "BININT1", "BININT2", "LONG1"),
        *("BINFLOAT", "BINUNICODE", "SHORT_BINUNICODE", "BINBYTES", "SHORT_BINBYTES"),
        *("EMPTY_TUPLE", "TUPLE", "TUPLE1", "TUPLE2", "TUPLE3", "EMPTY_LIST", "APPEND", "APPENDS"),
        *("EMPTY_DICT", "SETITEM", "SETITEMS", "MEMOIZE", "BINPUT", "BINGET", "LONG_BINGET"),
        *("GLOBAL", "STACK_GLOBAL", "NEWOBJ", "REDUCE", "BUILD", "BINPERSID"),
    }
)
SHOWN: Final = 200
HEAD: Final = (0x1950A86A20F9469CFC6C, 1001)
"""Magic number and version of torch's legacy format."""
COUNT: Final = np.dtype("<i8")
BFLOAT16: Final = "<u2"
"""The upper halves of float32."""
STORAGES: Final[Names] = {
    ("torch", "FloatStorage"): "<f4",
    ("torch", "DoubleStorage"): "<f8",
    ("torch", "HalfStorage"): "<f2",
    ("torch", "BFloat16Storage"): BFLOAT16,
    ("torch", "LongStorage"): "<i8",
}


def pickled(name: str, fields: Mapping[str, Any]) -> bytes:
    """Return the pickle of an instance of lerobot's class ``name``, in protocol 4 as its clients write it."""
    body = memoryview(pickle.dumps(fields, 4))[2:-1]
    return b"".join((b"\x80\x04c", f"{HELPERS}\n{name}\n)".encode(), b"\x81", body, b"b."))


def chunk_in(data: bytes) -> tuple[float, Numbers]:
    """Return the time stamp of the first action and the actions (H, D); raises RequestFailed for all other bytes."""
    try:
        actions = _load(BytesIO(data), _names())
        rows = [each.action for each in actions]
        if len({row.shape for row in rows}) != 1 or sum(row.size for row in rows) > NUMBERS:
            raise ValueError(f"actions of different lengths, or of more than {NUMBERS} numbers")
        return float(actions[0].timestamp), np.stack(rows)
    except Exception as error:
        why = str(error)[:SHOWN] or type(error).__name__
        raise RequestFailed(f"{len(data)} bytes that are not a chunk of lerobot's: {why}") from error


def observation_of(filled: dict[str, Any], template: str) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return a template's observation as lerobot has it, flat, and the features that describe it.

    Each number of the state is a motor, with a name of its own. Raises UsageError for a value that it does not carry.
    """
    observation: dict[str, Any] = {}
    features: dict[str, Any] = {}
    motors: dict[str, float] = {}
    for key, value in filled.items():
        array: Any = value if isinstance(value, np.ndarray) else np.empty(())
        if array.dtype == np.uint8 and array.shape[2:] == (3,):
            axes = ["height", "width", "channels"]
            features[f"observation.images.{key}"] = {"dtype": "image", "shape": value.shape, "names": axes}
            observation[key] = value
        elif array.dtype.kind == "f" and array.ndim == 1:
            motors |= {f"{key}.{index}": number for index, number in enumerate(array.tolist())}
        elif isinstance(value, str):
            observation[key] = value
        else:
            raise UsageError(
                f"`template` {template}: {key} must be a picture (H, W, 3), a state (D,) or a text for lerobot"
            )
    features["observation.state"] = {"dtype": "float32", "shape": (len(motors),), "names": [*motors]}
    return observation | motors, features


def _names() -> Names:
    """Return the meaning of an answer's names, made anew for each answer: a pickle can set their attributes."""
    storages: dict[bytes, Numbers] = {}

    class TimedAction(SimpleNamespace):
        pass

    def storage(data: bytes) -> Numbers:
        """Return the numbers of a storage, of which each action has a copy."""
        if data not in storages:
            storages[data] = _storage(data)
        return storages[data]

    def tensor(numbers: Numbers, offset: int, size: tuple[int], stride: tuple[int], *_: Any) -> Numbers:
        (length,), (step,) = size, stride
        row = numbers[offset:][: (length - 1) * step + 1 : step]
        if offset < 0 or step < 1 or not len(row) == length > 0:
            raise ValueError(f"a tensor of {length} numbers from {offset} on, of {len(numbers)} in its storage")
        return row

    return {
        (HELPERS, "TimedAction"): TimedAction,
        ("torch._utils", "_rebuild_tensor_v2"): tensor,
        ("torch.storage", "_load_from_bytes"): storage,
        ("collections", "OrderedDict"): lambda: None,
    }


def _storage(data: bytes) -> Numbers:
    """Read torch's legacy format: magic, version, the writer's system, one storage, its key; then the numbers."""
    file = BytesIO(data)
    *head, system, storage, _ = (_load(file, STORAGES) for _ in range(5))
    kind, dtype, _, _, count, view = storage
    is_storage = kind == "storage" and dtype in STORAGES.values() and view is None
    if tuple(head) != HEAD or not system["little_endian"] or not is_storage:
        raise ValueError("a storage that is not torch's, is big-endian, or of no type of an action")
    count_field, numbers = file.read(COUNT.itemsize), np.frombuffer(file.read(), dtype)
    if count_field != count.to_bytes(COUNT.itemsize, "little") or len(numbers) != count:
        raise ValueError(f"a storage of {count} numbers that has {len(numbers)}")
    return (numbers.astype("<u4") << 16).view("<f4") if dtype == BFLOAT16 else numbers


class _Unpickler(pickle.Unpickler):
    def __init__(self, file: BytesIO, names: Names) -> None:
        super().__init__(file)
        self._names = names

    def find_class(self, module: str, name: str) -> Any:
        if (module, name) not in self._names:
            raise ValueError(f"it names {module[:SHOWN]}.{name}, which no chunk does; nothing of it is run")
        return self._names[module, name]

    def persistent_load(self, pid: Any) -> Any:
        return pid


def _load(file: BytesIO, names: Names) -> Any:
    start = file.tell()
    for number, (opcode, _, _) in enumerate(pickletools.genops(file)):
        if number == OPCODES or opcode.name not in NEEDED:
            raise ValueError(f"the opcode {opcode.name}, which no chunk needs, or more than {OPCODES}")
    file.seek(start)
    return _Unpickler(file, names).load()
