"""Readers and writers of ready CDR on Cyclone DDS from PyPI, under ROS 2 names and types.

cyclonedds' own IDL serialisation of ``sequence<uint8>`` is pure Python (35 ms for a VGA image), so every ROS type
is an *empty* IdlStruct of the right name and its CDR is made by rosbags: ROS 2 matches by name, and the C layer
checks no more than the declared prefix. Two functions go to the C library by ctypes: `dds_write`, which takes any
buffer and releases the GIL, and `dds_takecdr`, which lends the received bytes without a copy.
"""

from __future__ import annotations

import ctypes as ct
import types
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from itertools import islice
from threading import Lock
from typing import Any
from uuid import UUID

from cyclonedds.builtin import BuiltinDataReader, BuiltinTopicDcpsPublication
from cyclonedds.core import DDSException, GuardCondition, InstanceState, ReadCondition, SampleState, ViewState, WaitSet
from cyclonedds.domain import DomainParticipant
from cyclonedds.idl import IdlStruct
from cyclonedds.idl import types as idl
from cyclonedds.internal import DDS, dds_c_t
from cyclonedds.pub import DataWriter
from cyclonedds.qos import Policy, Qos
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from rosbags.interfaces import Nodetype

from s2a_bench.clock import now_ns
from s2a_bench.errors import TransportError
from s2a_bench.ros import QoS
from s2a_bench.ros.messages import dds_type_name, typestore
from s2a_bench.ros.service import AT_ONCE, WAIT_SLICE_NS

FOREVER_NS = 2**63 - 1
WRITERS_AT_MOST = 4096
"""The most changes among the writers of a domain that are taken at once."""
ANY_STATE = SampleState.Any | ViewState.Any | InstanceState.Any


class _Buffer(ct.Structure):
    """Bytes and their number: a sample of the raw sertype, and Cyclone's ``ddsrt_iovec_t``."""

    _fields_ = (("base", ct.c_void_p), ("size", ct.c_size_t))


@cache
def _library() -> ct.CDLL:
    """Load libddsc under a handle of our own: argtypes are shared per handle, and cyclonedds sets its own."""
    library = ct.CDLL(DDS._dll_handle._name)  # noqa: SLF001 - the one place that knows which libddsc is loaded
    for name, result, *arguments in (
        ("dds_write", ct.c_int32, ct.c_int32, ct.c_void_p),
        ("dds_takecdr", ct.c_int32, ct.c_int32, ct.c_void_p, ct.c_uint32, ct.c_void_p, ct.c_uint32),
        ("ddsi_serdata_size", ct.c_uint32, ct.c_void_p),
        ("ddsi_serdata_to_ser_ref", ct.c_void_p, ct.c_void_p, ct.c_size_t, ct.c_size_t, ct.c_void_p),
        ("ddsi_serdata_to_ser_unref", None, ct.c_void_p, ct.c_void_p),
        ("ddsi_serdata_unref", None, ct.c_void_p),
    ):
        function = getattr(library, name)
        function.restype, function.argtypes = result, arguments
    return library


class _Loan:
    """Keeps a received sample alive as long as a view of it lives."""

    __slots__ = ("_referenced", "_serdata", "_slice")

    def __init__(self, serdata: int) -> None:
        self._serdata = serdata
        self._slice = _Buffer()
        size = _library().ddsi_serdata_size(serdata)
        self._referenced = _library().ddsi_serdata_to_ser_ref(serdata, 0, size, ct.byref(self._slice))

    def view(self) -> memoryview:
        array = (ct.c_ubyte * self._slice.size).from_address(self._slice.base)
        array.loan = self  # ties the loan's life to the view's
        return memoryview(array).cast("B").toreadonly()

    def __del__(self) -> None:
        _library().ddsi_serdata_to_ser_unref(self._referenced, ct.byref(self._slice))
        _library().ddsi_serdata_unref(self._serdata)


@cache
def _raw_type(type_name: str) -> type:
    return _struct("Raw_" + type_name.replace("/", "_"), type_name, {})


def _struct(name: str, type_name: str, fields: dict[str, Any]) -> type:
    how = {"typename": dds_type_name(type_name)}
    return dataclass(types.new_class(name, (IdlStruct,), how, lambda body: body.update(__annotations__=fields)))


@cache
def _described_type(type_name: str) -> type:
    """Return the type with its fields, which peers match that describe theirs (XTypes); its CDR is left to rosbags."""
    fields = typestore().fielddefs[type_name][1]
    return _struct(type_name.rpartition("/")[2], type_name, {name: _field_type(*kind) for name, kind in fields})


def _field_type(node: Nodetype, detail: Any) -> Any:
    if node == Nodetype.BASE:
        return {"string": str, "bool": bool}.get(detail[0]) or getattr(idl, detail[0])
    if node == Nodetype.NAME:
        return _described_type(detail)
    inner = _field_type(*detail[0])
    return idl.array[inner, detail[1]] if node == Nodetype.ARRAY else idl.sequence[inner]


def dds_qos(qos: QoS, announced: str) -> Qos:
    """Translate to DDS as rmw_cyclonedds does."""
    reliability = Policy.Reliability.Reliable(FOREVER_NS) if qos.reliable else Policy.Reliability.BestEffort
    history = Policy.History.KeepLast(qos.depth) if qos.depth else Policy.History.KeepAll
    lasting = (Policy.DurabilityService(0, history, -1, -1, -1),) if qos.latched else ()
    mortal = (Policy.Lifespan(round(qos.lifespan_s * 1e9)),) if qos.lifespan_s else ()
    return Qos(
        reliability,
        history,
        Policy.Durability.TransientLocal if qos.latched else Policy.Durability.Volatile,
        *lasting,
        *mortal,
        Policy.WriterDataLifecycle(autodispose=False),
        Policy.DataRepresentation(use_cdrv0_representation=True),  # ROS endpoints accept XCDR1 alone
        Policy.Userdata(announced.encode()),
    )


OTHERS = {b"\x01\x0f": "Fast DDS", b"\x01\x01": "RTI Connext DDS"}
"""Vendor id of RTPS, with which the GUIDs of its participants begin -> whose it is; Cyclone's is 01 10."""


def other_dds(endpoint: Any) -> str:
    """Return which other DDS a DcpsEndpoint is of, "" for Cyclone and those that are not known."""
    return OTHERS.get(endpoint.key.bytes[:2], "")


def user_data(endpoint: Any) -> dict[str, str]:
    """Read the ``key=value;`` pairs that a DcpsEndpoint announces in USER_DATA."""
    if Policy.Userdata not in endpoint.qos:
        return {}
    text = bytes(endpoint.qos[Policy.Userdata].data).decode("utf-8", "replace")
    return dict(item.split("=", 1) for item in text.split(";") if "=" in item)


_reading = Lock()
"""cyclonedds reads every quality of service through one set of buffers, which two threads would overwrite."""


def is_described(endpoint: Any, type_name: str) -> bool:
    """Return whether a DcpsEndpoint describes the ROS type otherwise than our own endpoints, which have no fields."""
    raw = _raw_type(type_name).__idl__.get_type_id()  # type: ignore[attr-defined]
    return endpoint.type_name == dds_type_name(type_name) and endpoint.type_id not in (None, raw)


class _Endpoint:
    def __init__(self, entity: Any, handles: Callable[[], list[int]], read_peer: Callable[[int], Any]) -> None:
        self.entity = entity
        self._reference = entity._ref  # noqa: SLF001 - the handle ctypes needs
        self._handles, self._read_peer = handles, read_peer

    def peers(self) -> list[int]:
        """Return the handles of matched peers; cyclonedds counts first, and fails where one more has come since."""
        while True:
            with suppress(IndexError):
                return self._handles()

    def matched(self) -> int:
        return len(self.peers())

    def endpoint(self, handle: int) -> Any:
        """Return the description of one matched peer, a DcpsEndpoint; None if it has left, even during this call."""
        try:
            with _reading:
                return self._read_peer(handle)
        except Exception as error:
            if str(error).startswith("Callfunc"):  # a bare Exception, of cyclonedds' C extension
                return None
            raise

    def endpoints(self) -> Iterator[Any]:
        return (endpoint for endpoint in map(self.endpoint, self.peers()) if endpoint is not None)


class RawWriter(_Endpoint):
    """A DataWriter that sends ready CDR; callable from any thread."""

    def __init__(self, participant: DomainParticipant, topic: str, type_name: str, qos: Qos) -> None:
        """Create the writer on a DDS topic name, prefix included."""
        self._type_name = type_name
        entity = DataWriter(participant, Topic(participant, topic, _raw_type(type_name)), qos=qos)
        super().__init__(entity, entity.get_matched_subscriptions, entity.get_matched_subscription_data)
        self._write = _library().dds_write

    def send(self, packed: bytearray) -> None:
        """Write without holding the GIL; Cyclone copies the buffer."""
        outgoing = _Buffer(ct.addressof(ct.c_char.from_buffer(packed)), len(packed))
        if code := self._write(self._reference, ct.byref(outgoing)):
            raise TransportError(f"DDS write of {self._type_name} failed: {DDSException(code)}")


class RawReader(_Endpoint):
    """A DataReader that lends the received CDR; one thread at a time takes."""

    def __init__(
        self, participant: DomainParticipant, topic: str, type_name: str, qos: Qos, *, described: bool = False
    ) -> None:
        """Create the reader on a DDS topic name, prefix included; ``described``: for writers that describe the type.

        Such a reader matches ROS, and programs without ROS whose fields are the same, but none of our own writers.
        """
        self._type_name = type_name
        data_type = _described_type(type_name) if described else _raw_type(type_name)
        entity = DataReader(participant, Topic(participant, topic, data_type), qos=qos)
        super().__init__(entity, entity.get_matched_publications, entity.get_matched_publication_data)
        self._serdata = ct.c_void_p()
        self._info = dds_c_t.sample_info()
        self._take = _library().dds_takecdr

    def take(self) -> memoryview | None:
        """Return the next sample's CDR if there is one, without waiting."""
        while True:
            taken = self._take(self._reference, ct.byref(self._serdata), 1, ct.byref(self._info), ANY_STATE)
            if taken < 0:
                raise TransportError(f"DDS take of {self._type_name} failed: {DDSException(taken)}")
            if not taken:
                return None
            loan = _Loan(self._serdata.value or 0)
            if self._info.valid_data:  # else the notice that a writer has left
                return loan.view()

    def arrived(self) -> Iterator[memoryview]:
        """Take the samples that have arrived, `AT_ONCE` at most: a writer may send faster than we take."""
        return islice(iter(self.take, None), AT_ONCE)

    def sender(self) -> int:
        return int(self._info.publication_handle)


def writers_of(participant: DomainParticipant) -> Callable[[], list[Any]]:
    """Return a function that lists the writers of the domain; keep it, as Cyclone gives back no memory of a reader.

    Nor does it of a writer's QoS that was read: each change is taken once.
    """
    reader = BuiltinDataReader(participant, BuiltinTopicDcpsPublication)
    writers: dict[UUID, Any] = {}

    def read() -> list[Any]:
        with _reading:
            while changes := reader.take(WRITERS_AT_MOST):
                for writer in changes:
                    writers.pop(writer.key, None)
                    if writer.sample_info.instance_state & InstanceState.Alive:
                        writers[writer.key] = writer
            return list(writers.values())

    return read


class DdsWaiter:
    """Waits for any of some readers on the calling thread, which is the fastest way that does not spin."""

    def __init__(self, participant: DomainParticipant) -> None:
        self._guard = GuardCondition(participant)
        self._conditions: list[ReadCondition] = []
        self._waitset = WaitSet(participant)
        self._waitset.attach(self._guard)
        self.interrupted = False

    def watch(self, reader: RawReader) -> None:
        """Wait for one reader more; a wait under way may notice after its time slice only."""
        condition = ReadCondition(reader.entity, ANY_STATE)
        self._conditions.append(condition)
        self._waitset.attach(condition)

    def wait_until(self, deadline_ns: int) -> bool:
        left_ns = deadline_ns - now_ns()
        if left_ns <= 0 or self.interrupted:
            return False
        self._waitset.wait(min(left_ns, WAIT_SLICE_NS))
        return not self.interrupted

    def interrupt(self) -> None:
        self.interrupted = True
        self._guard.set(True)
