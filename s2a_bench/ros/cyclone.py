"""The middleware on Cyclone DDS from PyPI: ready CDR in, views of the received CDR out, ROS 2 names outside.

cyclonedds' own IDL serialisation of ``sequence<uint8>`` is pure Python (35 ms for a VGA image), so every ROS type
is an *empty* IdlStruct of the right name and its CDR is made by rosbags: ROS 2 matches by name, and the C layer
checks no more than the declared prefix. Two functions go to the C library by ctypes: `dds_write`, which takes any
buffer and releases the GIL, and `dds_takecdr`, which lends the received bytes without a copy.
"""

from __future__ import annotations

import atexit
import ctypes as ct
import os
import types
from dataclasses import dataclass
from functools import cache
from importlib.metadata import version
from threading import Lock
from typing import Any

from cyclonedds.core import (
    DDSException,
    GuardCondition,
    InstanceState,
    ReadCondition,
    SampleState,
    ViewState,
    WaitSet,
)
from cyclonedds.domain import Domain, DomainParticipant
from cyclonedds.idl import IdlStruct
from cyclonedds.internal import DDS, dds_c_t
from cyclonedds.pub import DataWriter
from cyclonedds.qos import Policy, Qos
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic

from s2a_bench.errors import TransportError
from s2a_bench.ros import QoS, Tuning
from s2a_bench.ros.config import configuration
from s2a_bench.ros.messages import deserialise, serialise, type_hash

FOREVER_NS = 2**63 - 1
ANY_STATE = SampleState.Any | ViewState.Any | InstanceState.Any
WAIT_SLICE_NS = 500_000_000
"""A blocked wait returns to Python this often, so that Ctrl-C acts."""


class _Outgoing(ct.Structure):
    """What the raw sertype takes as a sample: a buffer of CDR and its length."""

    _fields_ = (("buffer", ct.c_void_p), ("size", ct.c_size_t))


class _Slice(ct.Structure):
    """Cyclone's ``ddsrt_iovec_t``."""

    _fields_ = (("base", ct.c_void_p), ("size", ct.c_size_t))


@cache
def _library() -> ct.CDLL:
    """Load libddsc under a handle of our own: argtypes are shared per handle, and cyclonedds sets its own."""
    library = ct.CDLL(DDS._dll_handle._name)  # noqa: SLF001 - the one place that knows which libddsc is loaded
    library.dds_write.argtypes = [ct.c_int32, ct.c_void_p]
    library.dds_write.restype = ct.c_int32
    library.dds_takecdr.argtypes = [ct.c_int32, ct.c_void_p, ct.c_uint32, ct.c_void_p, ct.c_uint32]
    library.dds_takecdr.restype = ct.c_int32
    library.ddsi_serdata_size.argtypes = [ct.c_void_p]
    library.ddsi_serdata_size.restype = ct.c_uint32
    library.ddsi_serdata_to_ser_ref.argtypes = [ct.c_void_p, ct.c_size_t, ct.c_size_t, ct.c_void_p]
    library.ddsi_serdata_to_ser_ref.restype = ct.c_void_p
    library.ddsi_serdata_to_ser_unref.argtypes = [ct.c_void_p, ct.c_void_p]
    library.ddsi_serdata_to_ser_unref.restype = None
    library.ddsi_serdata_unref.argtypes = [ct.c_void_p]
    library.ddsi_serdata_unref.restype = None
    return library


class _Loan:
    """Keeps a received sample alive as long as a view of it lives."""

    __slots__ = ("_referenced", "_serdata", "_slice")

    def __init__(self, serdata: int) -> None:
        self._serdata = serdata
        self._slice = _Slice()
        size = _library().ddsi_serdata_size(serdata)
        self._referenced = _library().ddsi_serdata_to_ser_ref(serdata, 0, size, ct.byref(self._slice))

    def view(self) -> memoryview:
        """Return the sample's CDR, header included, read-only."""
        array = (ct.c_ubyte * self._slice.size).from_address(self._slice.base)
        array.loan = self  # ties the loan's life to the view's
        return memoryview(array).cast("B").toreadonly()

    def __del__(self) -> None:
        _library().ddsi_serdata_to_ser_unref(self._referenced, ct.byref(self._slice))
        _library().ddsi_serdata_unref(self._serdata)


def dds_type_name(type_name: str) -> str:
    """Turn ``pkg/msg/Name`` into ROS 2's DDS type name ``pkg::msg::dds_::Name_``."""
    package, kind, name = type_name.split("/")
    return f"{package}::{kind}::dds_::{name}_"


@cache
def _raw_type(type_name: str) -> type:
    """Make the empty IdlStruct that stands for a ROS type."""
    name = "Raw_" + type_name.replace("/", "_")
    return dataclass(types.new_class(name, (IdlStruct,), {"typename": dds_type_name(type_name)}))


def _qos(qos: QoS, type_name: str) -> Qos:
    """Translate to DDS as rmw_cyclonedds does, the type hash in USER_DATA included."""
    reliability = Policy.Reliability.Reliable(FOREVER_NS) if qos.reliable else Policy.Reliability.BestEffort
    history = Policy.History.KeepLast(qos.depth) if qos.depth else Policy.History.KeepAll
    return Qos(
        reliability,
        history,
        Policy.Durability.Volatile,
        Policy.WriterDataLifecycle(autodispose=False),
        Policy.Userdata(f"typehash={type_hash(type_name)};".encode()),
    )


class _CyclonePublisher:
    """A DataWriter that sends ready CDR."""

    def __init__(self, participant: DomainParticipant, topic: str, type_name: str, qos: QoS) -> None:
        self._type_name = type_name
        raw = Topic(participant, "rt" + topic, _raw_type(type_name))
        self._writer = DataWriter(participant, raw, qos=_qos(qos, type_name))
        self._reference = self._writer._ref  # noqa: SLF001 - the handle ctypes needs
        self._write = _library().dds_write

    def pack(self, message: Any) -> bytearray:
        """Serialise to CDR."""
        return serialise(message, self._type_name)

    def send(self, packed: bytearray) -> None:
        """Write without holding the GIL; Cyclone copies the buffer."""
        outgoing = _Outgoing(ct.addressof(ct.c_char.from_buffer(packed)), len(packed))
        if code := self._write(self._reference, ct.byref(outgoing)):
            raise TransportError(f"DDS write of {self._type_name} failed: {DDSException(code)}")

    def matched(self) -> int:
        """Count matched readers."""
        return len(self._writer.get_matched_subscriptions())


class _CycloneSubscription:
    """A DataReader waited for on the consuming thread, which is the fastest way that does not spin."""

    def __init__(self, participant: DomainParticipant, topic: str, type_name: str, qos: QoS) -> None:
        self._type_name = type_name
        raw = Topic(participant, "rt" + topic, _raw_type(type_name))
        self._reader = DataReader(participant, raw, qos=_qos(qos, type_name))
        self._reference = self._reader._ref  # noqa: SLF001 - the handle ctypes needs
        self._guard = GuardCondition(participant)
        self._condition = ReadCondition(self._reader, ANY_STATE)
        self._waitset = WaitSet(participant)
        self._waitset.attach(self._condition)
        self._waitset.attach(self._guard)
        self._interrupted = False
        self._serdata = ct.c_void_p()
        self._info = dds_c_t.sample_info()
        self._take = _library().dds_takecdr

    def take(self, timeout_s: float) -> memoryview | None:
        """Return the next sample's CDR, lent by Cyclone."""
        left_ns = int(timeout_s * 1e9)
        while not self._interrupted:
            taken = self._take(self._reference, ct.byref(self._serdata), 1, ct.byref(self._info), ANY_STATE)
            if taken < 0:
                raise TransportError(f"DDS take of {self._type_name} failed: {DDSException(taken)}")
            if taken:
                loan = _Loan(self._serdata.value or 0)
                if self._info.valid_data:  # else the notice that a writer has left
                    return loan.view()
                continue
            if left_ns <= 0:
                return None
            self._waitset.wait(min(left_ns, WAIT_SLICE_NS))
            left_ns -= WAIT_SLICE_NS
        return None

    def unpack(self, packed: memoryview) -> Any:
        """Deserialise; arrays are views of the lent sample."""
        return deserialise(packed, self._type_name)

    def interrupt(self) -> None:
        """Trigger the guard condition."""
        self._interrupted = True
        self._guard.set(True)

    def matched(self) -> int:
        """Count matched writers."""
        return len(self._reader.get_matched_publications())


_domains: dict[int, tuple[Domain, str]] = {}
_domains_lock = Lock()


def _configure(domain_id: int, xml: str) -> None:
    """Configure a domain once per process; Cyclone takes no second configuration."""
    with _domains_lock:
        known = _domains.get(domain_id)
        if known is None:
            _domains[domain_id] = (Domain(domain_id, xml), xml)
        elif known[1] != xml:
            raise TransportError(f"DDS domain {domain_id} is already configured otherwise in this process")


class CycloneMiddleware:
    """One participant of a ROS 2 domain, from PyPI packages alone."""

    def __init__(self, domain_id: int, tuning: Tuning) -> None:
        """Join ``domain_id``; raises TransportError when Cyclone refuses."""
        self._domain_id = domain_id
        self._tuning = tuning
        self._xml = configuration(os.environ, tuning)
        try:
            if self._xml is not None:
                _configure(domain_id, self._xml)
            self._participant: DomainParticipant | None = DomainParticipant(
                domain_id, qos=Qos(Policy.Userdata(b"enclave=/;"))
            )
        except DDSException as error:
            raise TransportError(
                f"cannot join DDS domain {domain_id}: {error}; choose another with ROS_DOMAIN_ID, "
                "or check CYCLONEDDS_URI"
            ) from error
        atexit.register(self.close)

    def publisher(self, topic: str, type_name: str, qos: QoS) -> _CyclonePublisher:
        """Create a writer on ``rt<topic>``."""
        return _CyclonePublisher(self._joined(), topic, type_name, qos)

    def subscription(self, topic: str, type_name: str, qos: QoS) -> _CycloneSubscription:
        """Create a reader on ``rt<topic>``."""
        return _CycloneSubscription(self._joined(), topic, type_name, qos)

    def describe(self) -> dict[str, str | int]:
        """Say which Cyclone, which domain, and the whole configuration."""
        return {
            "middleware": "cyclonedds",
            "version": version("cyclonedds"),
            "domain_id": self._domain_id,
            "tuning": self._tuning,
            "configuration": self._xml or os.environ.get("CYCLONEDDS_URI", ""),
        }

    def close(self) -> None:
        """Delete the participant, which tells peers at once that we leave."""
        if self._participant is not None:
            atexit.unregister(self.close)
            participant, self._participant = self._participant, None
            participant._delete(participant._ref)  # noqa: SLF001 - __del__ may come seconds later

    def _joined(self) -> DomainParticipant:
        if self._participant is None:
            raise TransportError("the middleware is closed")
        return self._participant
