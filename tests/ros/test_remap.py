"""Remapped names: what rules mean, and a middleware that keeps its contract under other names."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest

from s2a_bench.errors import UsageError
from s2a_bench.ros import QoS, open_middleware
from s2a_bench.ros.remap import Remapped, table
from s2a_bench.testing.transport import wiring_of
from s2a_bench.transport.ros.joining import remapped
from s2a_bench.transport.ros.options import RosOptions
from tests.ros.action_suite import CANCEL, NAME, ActionSuite
from tests.ros.middleware_suite import STRING, Join, MiddlewareSuite, joining, text, wait_matched

pytest.importorskip("cyclonedds", reason="cyclonedds has wheels for x86-64 only")

RULES = {
    NAME: "/elsewhere/answer",
    CANCEL: "/elsewhere/answer/_action/cancel_goal",
    "/test/order": "/other/order",
    "/picky": "/picky",
}


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


@pytest.fixture
def join(dds_domain: int) -> Iterator[Join]:
    with joining(lambda: Remapped(open_middleware("cyclonedds", domain_id=dds_domain), RULES)) as join:
        yield join


class TestRemapped(MiddlewareSuite):
    """Topics and services under other names."""


class TestRemappedActions(ActionSuite):
    """An action under another name."""


def test_peers_find_what_is_remapped_under_its_other_name(join: Join, dds_domain: int) -> None:
    publisher = join().publisher("/test/order", STRING, QoS())
    plain = open_middleware("cyclonedds", domain_id=dds_domain)
    try:
        subscription = plain.subscription("/other/order", STRING, QoS())
        wait_matched(publisher, subscription)
        publisher.send(publisher.pack(text("x")))
        assert subscription.unpack(subscription.take(5)).data == "x"
    finally:
        plain.close()
