"""Two topics of ROS 2, live or recorded, as a tap: observations, and the answers to them."""

from __future__ import annotations

import struct
from collections.abc import Container, Iterable, Iterator
from contextlib import closing, contextmanager, suppress
from dataclasses import asdict, dataclass
from threading import Event, Lock, Thread
from typing import TYPE_CHECKING, Any, Final

from rosbags.interfaces import MessageDefinition, MessageDefinitionFormat, Nodetype
from rosbags.typesys import get_types_from_msg

from s2a_bench.clock import now_ns
from s2a_bench.errors import SourceError, TransportError, UsageError
from s2a_bench.frames.bag import open_recording, unreadable
from s2a_bench.frames.ros import POLL_S, unpublished
from s2a_bench.plugins.watch.pairs import ORDER, Pairs, TopicMessage
from s2a_bench.plugins.watch.run import Watch, opened
from s2a_bench.policy.parameters import build
from s2a_bench.provenance import AT_TOPICS, RECORDED, Provenance
from s2a_bench.ros import Middleware, QoS, Subscription
from s2a_bench.ros import messages as ros
from s2a_bench.ros.join import RosParameters
from s2a_bench.ros.remap import ABSOLUTE
from s2a_bench.ros.service import appeared
from s2a_bench.store.manifest import RunWarning

if TYPE_CHECKING:
    from pathlib import Path

    from s2a_bench.plugins.watch.config import WatchBag, WatchTopics
    from s2a_bench.progress import Progress

HEADER: Final = ("header", (Nodetype.NAME, "std_msgs/msg/Header"))
STAMP_ENDS: Final = 12
"""Bytes of CDR up to the end of the stamp in a header that is a message's first field."""
LATEST_NS: Final = 1 << 62
MOST_LISTED: Final = 20


@dataclass(frozen=True, slots=True)
class Topic:
    """A subscription to one of the two, or its like in a recording."""

    answer: bool
    stamped: bool

    def message(self, at_ns: int, cdr: Any) -> TopicMessage:
        return TopicMessage(self.answer, at_ns, len(cdr), stamp_of(cdr) if self.stamped else None)


def stamp_of(cdr: Any) -> int | None:
    """Return the stamp of a message that begins with a header; None for none."""
    if len(cdr) < STAMP_ENDS:
        return None
    seconds, nanoseconds = struct.unpack_from("<iI" if cdr[1] & 1 else ">iI", cdr, ros.CDR_HEADER)
    return int(seconds) * 1_000_000_000 + int(nanoseconds) or None


def is_stamped(type_name: str, recorded: MessageDefinition | None = None) -> bool:
    """Return whether a type's first field is a header; of one we do not know, a recording has the definition."""
    definitions = ros.typestore().fielddefs
    if type_name not in definitions and recorded and recorded.format == MessageDefinitionFormat.MSG:
        definitions = get_types_from_msg(recorded.data, type_name)
    return bool(definitions.get(type_name, ((), []))[1][:1] == [HEADER])


def run_topics(config: WatchTopics, output: Path, progress: Progress) -> Path:
    """Subscribe to both topics until the end and return the run folder; raises S2AError, also if no exchange was seen.

    A message's time is that of its arrival here: the way from its publisher is before that, for both alike.
    """
    names = topic_names(config.in_.partition("?")[0], config.out)
    how = build(RosParameters, config.in_, "in_")
    with closing(how.join("/s2a_bench/watch", lambda node: node)) as node:
        subscribed: list[tuple[Topic, Subscription]] = []
        for name in names:  # no comprehension: Zenoh cannot drop its items while an error passes
            subscribed.append(_subscribed(node, name, how.wait_s, answer=name == names[1]))  # noqa: PERF401
        with opened(config, output, progress, "ros", Provenance(tokens=AT_TOPICS)) as watch:
            pairs = _pairs(watch, names, [topic for topic, _ in subscribed])
            with _received(subscribed, pairs, progress):
                watch.keep_until_done()
            watch.writer.update(middleware=node.describe())
            return _finish(watch, pairs, names)


@contextmanager
def _received(subscribed: list[tuple[Topic, Subscription]], pairs: Pairs, progress: Progress) -> Iterator[None]:
    """Feed the pairs within the context, by a thread for each topic, in order of time."""
    lock, ended = Lock(), Event()

    def receive(topic: Topic, subscription: Subscription) -> None:
        try:
            while not ended.is_set():
                if packed := subscription.take(POLL_S):
                    with lock:
                        pairs.feed(topic.message(now_ns(), packed))
        except TransportError as error:
            progress.say(str(error))

    threads = [Thread(target=receive, args=each, name="topic", daemon=True) for each in subscribed]
    for thread in threads:
        thread.start()
    try:
        yield
    finally:
        ended.set()
        for (_, subscription), thread in zip(subscribed, threads, strict=True):
            subscription.interrupt()
            thread.join()


def _subscribed(node: Middleware, name: str, wait_s: float, *, answer: bool) -> tuple[Topic, Subscription]:
    """Wait for publishers of a topic and subscribe, reliably if all of them are."""
    appeared(lambda: any(offer.topic == name for offer in node.offers()), wait_s)
    every = node.offers()
    offers = [offer for offer in every if offer.topic == name]
    if not offers:
        listed = f"topics here: {_listed(offer.topic for offer in every)}"
        raise TransportError(unpublished(name, wait_s, listed, "--in"))
    type_name = offers[0].type_name
    try:
        reliable = all(offer.reliable for offer in offers)
        subscription = node.subscription(name, type_name, QoS(depth=0, reliable=reliable))
    except KeyError as error:
        raise TransportError(
            f"{name} is of type {type_name}, which is not known here: use ?middleware=cyclonedds, which need not know "
            "it, or record it and watch the recording with --bag"
        ) from error
    return Topic(answer, is_stamped(type_name)), subscription


def run_bag(config: WatchBag, output: Path, progress: Progress) -> Path:
    """Read both topics of a recording and return the run folder; raises S2AError, also if no exchange was seen.

    Times are those of the recording's log, on the clock of the system that recorded it: that may have been set
    meanwhile, and is not CLOCK_MONOTONIC. `seconds` are counted from the recording's beginning.
    """
    names, path = topic_names(config.in_, config.out), str(config.bag)
    reader = open_recording(path, "bag")
    try:
        topics = _recorded(reader, path, names)
        with opened(config, output, progress, "ros", Provenance(tokens=RECORDED, clock="log time")) as watch:
            pairs = _pairs(watch, names, topics.values())
            progress.stage(f"reading {path}")
            for connection, at_ns, cdr in _messages(reader, path, topics, config.seconds):
                topic = topics[connection.id]
                pairs.feed(topic.message(at_ns, cdr))
                if watch.keep_rest() >= config.requests > 0:
                    break
            return _finish(watch, pairs, names)
    finally:
        with suppress(Exception):  # a damaged file may not even close
            reader.close()


def _recorded(reader: Any, path: str, names: tuple[str, str]) -> dict[int, Topic]:
    """Return the connections of both topics, by their ids; raises SourceError where one is not there."""
    there = {each.topic for each in reader.connections}
    for field, name in zip(("in_", "out"), names, strict=True):
        if name not in there:
            raise SourceError(f"`{field}`: {path} has no topic {name}; it has {_listed(there)}")
    try:
        return {
            each.id: Topic(each.topic == names[1], is_stamped(each.msgtype, each.msgdef))
            for each in reader.connections
            if each.topic in names
        }
    except Exception as error:  # rosbags raises any exception on a damaged file
        raise unreadable(path, error, "bag") from error


def _messages(reader: Any, path: str, ids: Container[int], seconds: float) -> Iterator[tuple[Any, int, bytes]]:
    try:
        stop_ns = reader.start_time + round(seconds * 1e9) if seconds else None
        for message in reader.messages([each for each in reader.connections if each.id in ids], stop=stop_ns):
            if not 0 <= message[1] < LATEST_NS:
                raise ValueError(f"a message of the time {message[1]} ns")
            yield message
    except Exception as error:  # rosbags raises any exception on a damaged file
        raise unreadable(path, error, "bag") from error


def topic_names(observations: str, answers: str) -> tuple[str, str]:
    """Return both; raises UsageError for an invalid topic, or twice the same."""
    for field, name in (("in_", observations), ("out", answers)):
        if not ABSOLUTE.fullmatch(name):
            raise UsageError(f"`{field}`: '{name}' should look like /camera/image_raw, from the root")
    if observations == answers:
        raise UsageError(f"`out`: {answers} is the topic of the observations, too; name that of the answers")
    return observations, answers


def _listed(topics: Iterable[str]) -> str:
    names = sorted({*topics})
    return ", ".join(names[:MOST_LISTED]) + ", ..." * (len(names) > MOST_LISTED) or "none"


def _pairs(watch: Watch, names: tuple[str, str], topics: Iterable[Topic]) -> Pairs:
    stamped = all(topic.stamped for topic in topics)
    return Pairs(" -> ".join(names), lambda seen: watch.report(0, seen), stamped=stamped)


def _finish(watch: Watch, pairs: Pairs, names: tuple[str, str]) -> Path:
    """Write the last exchanges and return the run folder; raises TransportError if none was seen."""
    pairs.end()
    exchanges = watch.keep_rest()
    counts = {name: getattr(pairs, name) for name in ("paired", "observations", "answers", "unpaired")}
    watch.writer.update(topics={**counts, "lost": watch.lost})
    if not exchanges:
        counted = f"{pairs.observations} messages of {names[0]}, {pairs.answers} of {names[1]}"
        raise TransportError(f"no exchange was seen: {counted}, none of them an answer after an observation")
    if pairs.paired == ORDER and pairs.observations > exchanges + 1:
        unanswered = f"{pairs.observations - exchanges} of {pairs.observations} observations have no answer"
        about = (
            f"paired by order, and {unanswered}: an answer may be to an older one, server and age are at least those"
        )
        advice = "give both topics headers with the same stamps"
        watch.writer.update(warnings=[asdict(RunWarning("paired-by-order", about, advice))])
    return watch.writer.path
