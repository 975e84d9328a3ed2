"""What every middleware promises, as one suite."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from threading import Thread
from typing import Any

import numpy as np
import pytest

from s2a_bench.clock import now_ns
from s2a_bench.errors import TransportError
from s2a_bench.ros import Middleware, Offer, Publisher, QoS, Subscription
from s2a_bench.ros import messages as ros
from s2a_bench.types import Frame

Join = Callable[[], Middleware]
STRING = "std_msgs/msg/String"
GET_TYPES = "rcl_interfaces/srv/GetParameterTypes"
LIST = "rcl_interfaces/srv/ListParameters"
WAIT_S = 20.0


@contextmanager
def joining(open_one: Callable[[], Middleware]) -> Iterator[Join]:
    """Open a participant each time that it is asked to, and close all at the end."""
    with ExitStack() as stack:

        def join() -> Middleware:
            middleware = open_one()
            stack.callback(middleware.close)
            return middleware

        yield join


def until(met: Callable[[], object], meanwhile: Callable[[], object] = lambda: time.sleep(0.002)) -> None:
    """Wait until something holds, and fail where it does not come about."""
    deadline = now_ns() + int(WAIT_S * 1e9)
    while not met():
        assert now_ns() < deadline, "it did not come about"
        meanwhile()


def text(value: str) -> Any:
    """Return a std_msgs/String."""
    return ros.message(STRING, data=value)


def wait_matched(publisher: Publisher, subscription: Subscription) -> None:
    """Wait until each knows the other."""
    until(lambda: publisher.matched() and subscription.matched(), lambda: subscription.take(0.01))


def check_interrupt(end: Any, wait: Callable[[float], object]) -> None:
    """Check that an interrupt ends a blocked wait and those that come later."""
    got: list[Any] = [1]
    thread = Thread(target=lambda: got.append(wait(60)))
    thread.start()
    end.interrupt()
    thread.join(20)
    assert not thread.is_alive()
    assert got == [1, None]
    assert wait(60) is None


class MiddlewareSuite:
    """What every middleware does.

    Fixture: ``join``, which opens one more participant of the same domain and closes all when the test ends.
    """

    def pair(self, join: Join, topic: str, type_name: str, qos: QoS) -> tuple[Publisher, Subscription]:
        """Return a publisher and a subscription of two participants, matched."""
        publisher = join().publisher(topic, type_name, qos)
        subscription = join().subscription(topic, type_name, qos)
        wait_matched(publisher, subscription)
        return publisher, subscription

    def test_messages_arrive_in_order(self, join: Join) -> None:
        publisher, subscription = self.pair(join, "/test/order", STRING, QoS(0))
        sent = [f"message {number}" + "é" * number for number in range(50)]
        for value in sent:
            publisher.send(publisher.pack(text(value)))
        got = [subscription.unpack(subscription.take(5)).data for _ in sent]
        assert got == sent

    def test_a_raw_image_arrives_unchanged(self, join: Join) -> None:
        width, height = 1920, 1080
        publisher, subscription = self.pair(join, "/test/image", ros.IMAGE, QoS(1))
        pixels = np.random.default_rng(1).integers(0, 256, (height, width, 3), np.uint8)
        message = ros.image_message(Frame(0, 0, width, height, "bgr8", pixels), 5_000_000_001, "camera")
        publisher.send(publisher.pack(message))
        got = ros.frame_of_image(subscription.unpack(subscription.take(10)))
        np.testing.assert_array_equal(got.data, pixels)
        assert got.stamp_ns == 5_000_000_001

    def test_received_pixels_outlive_the_middleware(self, join: Join) -> None:
        middleware = join()
        subscription = middleware.subscription("/test/outlive", ros.IMAGE, QoS(1))
        publisher = join().publisher("/test/outlive", ros.IMAGE, QoS(1))
        wait_matched(publisher, subscription)
        pixels = np.full((48, 64, 3), 77, np.uint8)
        publisher.send(publisher.pack(ros.image_message(Frame(0, 0, 64, 48, "bgr8", pixels), 0, "c")))
        got = ros.frame_of_image(subscription.unpack(subscription.take(5))).data
        middleware.close()
        del middleware, subscription
        np.testing.assert_array_equal(got, pixels)

    def test_nothing_to_take_is_none(self, join: Join) -> None:
        assert join().subscription("/test/silence", STRING, QoS()).take(0.01) is None

    def test_an_interrupt_ends_a_blocked_take_and_later_ones(self, join: Join) -> None:
        subscription = join().subscription("/test/interrupt", STRING, QoS())
        check_interrupt(subscription, subscription.take)

    def test_publishers_are_told_with_type_and_reliability_until_they_leave(self, join: Join) -> None:
        first, second, asking = join(), join(), join()
        subscription = asking.subscription("/test/offer/two", ros.IMAGE, QoS(1))
        kept = [
            first.publisher("/test/offer/one", STRING, QoS()),
            first.publisher("/test/offer/two", ros.IMAGE, QoS(1, reliable=False)),
            second.publisher("/test/offer/two", ros.COMPRESSED_IMAGE, QoS(1)),
        ]
        offers = [
            Offer("/test/offer/one", STRING, reliable=True),
            Offer("/test/offer/two", ros.COMPRESSED_IMAGE, reliable=True),
            Offer("/test/offer/two", ros.IMAGE, reliable=False),
        ]

        def found() -> list[Offer]:
            here = [offer for offer in asking.offers() if offer.topic.startswith("/test/offer/")]
            return sorted(here, key=lambda offer: (offer.topic, offer.type_name))

        assert subscription.topic == "/test/offer/two"
        until(lambda: found() == offers)
        second.close()
        until(lambda: found() == [offers[0], offers[2]])
        first.close()
        until(lambda: not found())
        assert len(kept) == 3

    def test_a_sender_hears_a_publisher_once_it_subscribes(self, join: Join) -> None:
        server, client = join(), join()
        requests, answers = (
            server.subscription("/test/request", STRING, QoS()),
            server.publisher("/test/answer", STRING, QoS()),
        )
        publisher = client.publisher("/test/request", STRING, QoS())
        wait_matched(publisher, requests)
        publisher.send(publisher.pack(text("x")))
        assert requests.take(WAIT_S) is not None
        sender = requests.sender()
        assert not requests.sender_hears(sender, answers)
        _kept = client.subscription("/test/answer", STRING, QoS())
        until(lambda: requests.sender_hears(sender, answers))

    def test_services_answer_who_asked(self, join: Join) -> None:
        def types(request: Any) -> Any:
            return ros.default(GET_TYPES + "_Response", types=[len(name) for name in request.names])

        server = join()
        server.service("/robot/node/get_parameter_types", GET_TYPES, types)
        server.service("/robot/node/list_parameters", LIST, lambda _: ros.default(LIST + "_Response"))
        clients = [join().service_client("/robot/node/get_parameter_types", GET_TYPES) for _ in range(2)]
        for names in (["a", "four"], [], ["ééé"]):
            for client in clients:
                got = client.call(ros.default(GET_TYPES + "_Request", names=names), WAIT_S)
                assert got.types.tolist() == [len(name) for name in names]
        other = join().service_client("/robot/node/list_parameters", LIST)
        assert other.call(ros.default(LIST + "_Request"), WAIT_S).result.names == []

    def test_a_service_whose_answer_fails_answers_the_next_request(self, join: Join) -> None:
        def answer(request: Any) -> Any:
            if not request.names:
                raise ValueError("nothing to say")
            return ros.default(GET_TYPES + "_Response", types=[7])

        join().service("/picky", GET_TYPES, answer)
        client = join().service_client("/picky", GET_TYPES)
        assert client.call(ros.default(GET_TYPES + "_Request", names=["a"]), WAIT_S).types.tolist() == [7]
        with pytest.raises(TransportError, match=r"/picky did not answer in 0\.2 s"):
            client.call(ros.default(GET_TYPES + "_Request"), 0.2)
        assert client.call(ros.default(GET_TYPES + "_Request", names=["a"]), WAIT_S).types.tolist() == [7]

    def test_a_service_that_nobody_offers_is_named(self, join: Join) -> None:
        client = join().service_client("/nobody", LIST)
        with pytest.raises(TransportError, match="no server of the service /nobody appeared"):
            client.call(ros.default(LIST + "_Request"), 0.1)

    def test_it_describes_itself_in_plain_data(self, join: Join) -> None:
        described = join().describe()
        assert {"middleware", "version", "domain_id"} <= set(described)
        assert all(isinstance(value, (str, int)) for value in described.values())

    def test_once_closed_it_says_so_and_closing_twice_does_no_harm(self, join: Join) -> None:
        middleware = join()
        publisher = middleware.publisher("/test/closed", STRING, QoS())
        middleware.service("/test/types", GET_TYPES, lambda _: ros.default(GET_TYPES + "_Response"))
        middleware.close()
        middleware.close()
        with pytest.raises(TransportError):
            publisher.send(publisher.pack(text("x")))
        with pytest.raises(TransportError, match="closed"):
            middleware.subscription("/test/closed", STRING, QoS())
        with pytest.raises(TransportError, match="closed"):
            middleware.service("/test/list", LIST, lambda _: ros.default(LIST + "_Response"))
