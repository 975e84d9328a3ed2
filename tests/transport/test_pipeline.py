"""Pipeline names: what they stand for, and what cells are called."""

from __future__ import annotations

from itertools import islice
from typing import Any

import pytest

from s2a_bench.errors import UsageError
from s2a_bench.transport.pipeline import one_pipeline, pipelines


def names(*texts: str, **options: dict[str, Any]) -> list[str]:
    return [pipeline.name for pipeline in pipelines(texts, options)]


@pytest.mark.parametrize(
    ("text", "name"),
    [
        ("loopback", "loopback"),
        ("http/binary", "http/binary"),
        ("http/binary?payload=jpeg", "http/binary"),
        ("http/binary?payload=png&connection=per-request", "http/binary?connection=per-request&payload=png"),
        ("http/binary?port=0", "http/binary"),
        ("ros", "ros/topic"),
        ("ros/topic?dds-tuning=default", "ros/topic?dds_tuning=default"),
        ("ros/topic?result-timeout=60", "ros/topic"),
        ("ros/topic?result_timeout=2.50", "ros/topic?result_timeout=2.5"),
        ("ros/action?publish_tokens=yes", "ros/action?publish_tokens=true"),
        ("http/binary?served_model=a%2Cb", "http/binary?served_model=a%2Cb"),
    ],
)
def test_a_cell_has_one_name(text: str, name: str) -> None:
    assert names(text) == [name]
    assert names(name) == [name]


def test_what_flags_give_is_left_out_of_a_name_and_overridden_by_it() -> None:
    flags = {"payload": "png", "connection": "per-request"}
    assert names("http/binary", http=flags) == ["http/binary"]
    assert names("http/binary?payload=png", http=flags) == ["http/binary"]
    (cell,) = pipelines(["http/binary?payload=jpeg"], {"http": flags})
    assert (cell.name, cell.payload) == ("http/binary?payload=jpeg", "jpeg")


def test_a_cell_that_is_named_twice_is_measured_once() -> None:
    assert names("http", "http/binary", "http/binary?payload=jpeg") == [
        *("http/as-deployed", "http/best-effort", "http/binary"),
    ]


def test_options_hold_for_every_variant_that_is_meant() -> None:
    assert names("http?payload=png")[:2] == ["http/as-deployed?payload=png", "http/best-effort?payload=png"]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("ros/topic?wire=bgr", "ros has no option 'wire'; it has payload, action, url, namespace"),
        ("ros?payload", "'ros?payload' should look like ros?option=value"),
        ("http?port=x", "`port`: 'x' should be a valid integer"),
        ("ros?publish_tokens=maybe", "`publish_tokens`: 'maybe' should be a valid boolean"),
        ("", "`transport`: '' is not one of http, ros, loopback"),
    ],
)
def test_what_a_name_cannot_say_is_one_line(text: str, message: str) -> None:
    with pytest.raises(UsageError) as error:
        names(text)
    assert message in str(error.value)


def test_cells_share_a_server_unless_it_would_be_told_something_else() -> None:
    one, two, three = pipelines(["ros/topic", "ros/action?payload=yuyv", "ros/topic?dds_tuning=default"])
    assert one.server == two.server != three.server
    deployed, best_effort, binary = pipelines(["http"])
    assert deployed.server != best_effort.server == binary.server


def test_two_servers_of_one_transport_do_not_collide() -> None:
    http, ros = one_pipeline("http", port=8000), one_pipeline("ros?namespace=/mine")
    assert list(http.transport.addresses(http.options)) == ["127.0.0.1:8000", "127.0.0.1:0"]
    assert list(islice(ros.transport.addresses(ros.options), 3)) == ["/mine", "/mine_2", "/mine_3"]
    unnamed = one_pipeline("ros")
    assert len({address for _ in range(9) for address in unnamed.transport.addresses(unnamed.options)}) == 9
