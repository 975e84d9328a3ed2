"""What cyclonedds shares between threads: one set of buffers for every quality of service that is read."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing

import pytest

pytest.importorskip("cyclonedds")

from s2a_bench.ros import QoS, open_middleware
from s2a_bench.ros.dds import RawReader, RawWriter, dds_qos, user_data
from tests.waiting import until

STRING = "std_msgs/msg/String"


@pytest.fixture
def hasty() -> Iterator[None]:
    """Switch threads as often as possible."""
    interval = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    yield
    sys.setswitchinterval(interval)


@pytest.mark.usefixtures("hasty")
def test_each_thread_reads_the_user_data_of_its_own_peer(dds_domain: int) -> None:
    readers = []
    node = open_middleware("cyclonedds", domain_id=dds_domain)
    participant = node._participant  # type: ignore[attr-defined]
    for number in range(2):
        topic, qos = f"rt/threads_{number}", dds_qos(QoS(1), f"number={number};")
        writer = RawWriter(participant, topic, STRING, qos)
        reader = RawReader(participant, topic, STRING, qos)
        until(lambda reader=reader: reader.matched() == 1)  # type: ignore[misc]  # bound at once
        readers.append((writer, reader))

    def numbers(reader: RawReader) -> set[str]:
        return {user_data(peer)["number"] for _ in range(2000) for peer in reader.endpoints()}

    with closing(node), ThreadPoolExecutor(2) as pool:
        assert [*pool.map(numbers, [reader for _, reader in readers])] == [{"0"}, {"1"}]
