"""Services on Cyclone DDS: what strangers may send them; test_cyclone_action has their names and QoS."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from s2a_bench.ros import QoS
from s2a_bench.ros import messages as ros
from tests.ros.middleware_suite import GET_TYPES, WAIT_S, Join, until

pytest.importorskip("cyclonedds", reason="cyclonedds has wheels for x86-64 only")

NAME = "/robot/node/get_parameter_types"


def lengths(request: Any) -> Any:
    return ros.default(GET_TYPES + "_Response", types=[len(name) for name in request.names])


def test_garbage_is_dropped_and_logged_once(join: Join, caplog: pytest.LogCaptureFixture) -> None:
    from s2a_bench.ros.dds import RawWriter, dds_qos

    server, stranger = join(), join()
    server.service(NAME, GET_TYPES, lengths)
    writer = RawWriter(stranger._participant, f"rq{NAME}Request", GET_TYPES + "_Request", dds_qos(QoS(), "x=y;"))  # type: ignore[attr-defined]
    until(writer.matched)
    head = bytes.fromhex("00010000") + bytes(16)
    many, endless = head + b"\xff\xff\xff\x7f", head + bytes.fromhex("01000000 ffffff7f")
    for body in (b"\0\1\0\0", head, many, endless, head + b"\xff" * 64):
        for _ in range(20):
            writer.send(bytearray(body))
    client = join().service_client(NAME, GET_TYPES)
    assert client.call(ros.default(GET_TYPES + "_Request", names=["abc"]), WAIT_S).types.tolist() == [3]
    assert sum("dropped a request" in record.getMessage() for record in caplog.records) == 1


def test_a_peer_that_leaves_while_it_is_looked_at_is_nobody() -> None:
    from s2a_bench.ros.dds import _Endpoint

    def errored(_handle: int) -> None:
        raise Exception("Callfunc cqos errored.")  # noqa: TRY002 - as cyclonedds does

    def wrong(_handle: int) -> None:
        raise Exception("something else")  # noqa: TRY002

    entity = SimpleNamespace(_ref=0)
    assert _Endpoint(entity, list, errored).endpoint(1) is None
    assert _Endpoint(entity, list, lambda handle: handle).endpoint(7) == 7
    with pytest.raises(Exception, match="something else"):
        _Endpoint(entity, list, wrong).endpoint(1)
