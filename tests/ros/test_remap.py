"""Remapped names: what rules mean, and a middleware whose every end is under its other name."""

from __future__ import annotations

from typing import Any

import pytest

from s2a_bench.errors import TransportError, UsageError
from s2a_bench.ros import QoS, open_middleware
from s2a_bench.ros import messages as ros
from s2a_bench.ros.llama import GENERATE_RESPONSE
from s2a_bench.ros.remap import Remapped, table
from s2a_bench.testing.transport import wiring_of
from s2a_bench.transport.ros.joining import remapped
from s2a_bench.transport.ros.options import RosOptions
from tests.ros.middleware_suite import LIST, STRING, WAIT_S, joining, until, wait_matched

pytest.importorskip("cyclonedds", reason="cyclonedds has wheels for x86-64 only")

RULES = {name: "/other" + name for name in ("/order", "/answer", "/ours", "/theirs")}


@pytest.mark.parametrize(
    ("rule", "source", "target"),
    [
        ("token:=words", "/llama/token", "/llama/words"),
        ("camera/image_raw:=/front/image", "/llama/camera/image_raw", "/front/image"),
        ("/rosout:=/quiet", "/rosout", "/quiet"),
        ("~/get_parameters:=/get", "/llama/brain/get_parameters", "/get"),
        ("/a:=~/b", "/a", "/llama/brain/b"),
    ],
)
def test_names_are_relative_private_or_absolute(rule: str, source: str, target: str) -> None:
    assert table([rule], "/llama/brain") == {source: target}


def test_the_first_rule_for_a_name_holds() -> None:
    assert table(["a:=b", "/n/a:=c"], "/n/x") == {"/n/a": "/n/b"}


@pytest.mark.parametrize(
    ("options", "compressed"),
    [
        ({"remap": ("camera/image_raw:=/front/image",)}, "/front/image/compressed"),
        ({"camera_topic": "/front/image"}, "/front/image/compressed"),
        ({"remap": ("camera/image_raw:=/front/image", "camera/image_raw/compressed:=/jpeg")}, "/jpeg"),
    ],
)
def test_what_is_compressed_follows_its_topic(options: dict[str, Any], compressed: str) -> None:
    names = remapped(wiring_of("ros/topic", "/llama", **options))
    assert names == {"/llama/camera/image_raw": "/front/image", "/llama/camera/image_raw/compressed": compressed}


@pytest.mark.parametrize("rule", ["a", "a:=", ":=b", "a b:=c", "a:=b:=c", "rostopic://a:=b", "a//b:=c", "1:=b", "a:=/"])
def test_what_is_no_rule_is_refused(rule: str) -> None:
    with pytest.raises(UsageError, match=r"`remap`: .* should look like from:=to"):
        RosOptions(remap=(rule,))


def test_every_end_meets_those_of_its_other_name(dds_domain: int) -> None:
    """In both directions, between a node that is remapped and one that is not; what has no rule keeps its name."""
    with joining(lambda: open_middleware("cyclonedds", domain_id=dds_domain)) as join:
        plain, inner = join(), join()
        ours = Remapped(inner, RULES)
        assert ours.describe() == inner.describe()
        publishers = []
        for one, name, other, other_name in (
            (ours, "/order", plain, "/other/order"),
            (plain, "/other/answer", ours, "/answer"),
            (ours, "/same", plain, "/same"),
        ):
            publishers.append(one.publisher(name, STRING, QoS()))
            wait_matched(publishers[-1], other.subscription(other_name, STRING, QoS()))
        until(lambda: {"/other/order", "/other/answer", "/same"} <= {offer.topic for offer in ours.offers()})
        for name, server, client, other in (
            ("/ours", ours.service, plain.service_client, "/other/ours"),
            ("/other/theirs", plain.service, ours.service_client, "/theirs"),
        ):
            server(name, LIST, lambda _: ros.default(LIST + "_Response"))
            assert client(other, LIST).call(ros.default(LIST + "_Request"), WAIT_S).result.names == []
        for name, act, ask, other in (
            ("/ours", ours.action_server, plain.action_client, "/other/ours"),
            ("/other/theirs", plain.action_server, ours.action_client, "/theirs"),
        ):
            kept = act(name, GENERATE_RESPONSE)
            assert ask(other, GENERATE_RESPONSE).wait_for_server(WAIT_S)
            del kept
        ours.close()
        with pytest.raises(TransportError, match="closed"):
            inner.subscription("/late", STRING, QoS())
