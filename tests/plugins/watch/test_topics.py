"""Two topics of ROS 2 as a tap, live and recorded."""

from __future__ import annotations

import json
from collections.abc import Callable
from contextlib import ExitStack, closing
from pathlib import Path
from threading import Event, Thread
from typing import Any

import numpy as np
import pytest
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from s2a_bench.clock import now_ns
from s2a_bench.errors import SourceError, TransportError, UsageError
from s2a_bench.experiments.cells import Cells
from s2a_bench.plugins.watch.config import WatchBag, WatchTopics
from s2a_bench.plugins.watch.pairs import ORDER, STAMP, UNDECIDED, Pairs, TopicMessage
from s2a_bench.plugins.watch.rows import EXCHANGES, ExchangeRow
from s2a_bench.plugins.watch.topics import run_bag, run_topics, stamp_of
from s2a_bench.progress import NullProgress
from s2a_bench.provenance import AT_TOPICS, RECORDED
from s2a_bench.ros import QoS, open_middleware
from s2a_bench.ros import messages as ros
from s2a_bench.store.run import StoredRun, read_run
from s2a_bench.transport.tap import MOST_WAITING, Seen
from tests.cli.program import called, only_run, refused
from tests.made_bags import CAMERA, MS, STRING, T0_NS, TOKENS, image, pose, record, string, tokens
from tests.suites import once
from tests.waiting import until

WHAT = f"{CAMERA} -> {TOKENS}"


def paired(written: str, *, stamped: bool = True) -> tuple[Pairs, list[tuple[int, int, int, list[int]]]]:
    """Feed messages one ns after the other: "o7 a7" is an observation of stamp 7 and an answer of that stamp."""
    seen: list[Seen] = []
    pairs = Pairs(WHAT, seen.append, stamped=stamped)
    for at_ns, each in enumerate(written.split(), 1):
        pairs.feed(TopicMessage(each[0] == "a", at_ns, 10, int(each[1:]) if each[1:] else None))
    pairs.end()
    assert all(each.what == WHAT and not each.sent_ns and each.up_bytes == 10 for each in seen)
    return pairs, [(each.request_ns, each.answer_ns, each.end_ns, each.pieces_ns) for each in seen]


@pytest.mark.parametrize(
    ("written", "how", "exchanges", "unpaired"),
    [
        ("o1 a1 o2 a2", STAMP, [(1, 2, 2, []), (3, 4, 4, [])], 0),
        ("o1 o2 a2 a1", STAMP, [(2, 3, 3, []), (1, 4, 4, [])], 0),
        ("o1 o2 a1 o3 a2 a3", STAMP, [(1, 3, 3, []), (2, 5, 5, []), (4, 6, 6, [])], 0),
        ("a0 o2 o3 o4 o5 a1 a4", STAMP, [(4, 7, 7, [])], 2),
        ("o1 o2 a1 a1 a1 a2", STAMP, [(1, 3, 5, [3, 4, 5]), (2, 6, 6, [])], 0),
        ("o1 o2 a1 a2 a1", STAMP, [(1, 3, 3, []), (2, 4, 4, [])], 1),
        ("o1 a1 o1 a1 o1 a1", STAMP, [(1, 2, 2, []), (3, 4, 4, []), (5, 6, 6, [])], 0),
        ("o1 a1 o a o3 a3", STAMP, [(1, 2, 2, []), (5, 6, 6, [])], 1),
        ("o1 a7 o2 a8", ORDER, [(1, 2, 2, []), (3, 4, 4, [])], 0),
        ("o a o a", ORDER, [(1, 2, 2, []), (3, 4, 4, [])], 0),
        ("o a o o a", ORDER, [(1, 2, 2, []), (4, 5, 5, [])], 0),
        ("o a a a o a a", ORDER, [(1, 2, 4, [2, 3, 4]), (5, 6, 7, [6, 7])], 0),
        ("a a o a", ORDER, [(3, 4, 4, [])], 2),
        ("o o o", ORDER, [], 0),
        ("a", ORDER, [], 1),
        ("", ORDER, [], 0),
    ],
)
def test_an_answer_has_the_stamp_of_its_observation_or_is_to_the_newest(
    written: str, how: str, exchanges: list[Any], unpaired: int
) -> None:
    pairs, seen = paired(written)
    assert (pairs.paired, seen, pairs.unpaired) == (how, exchanges, unpaired)
    assert (pairs.observations, pairs.answers) == (written.count("o"), written.count("a"))


def test_types_without_a_header_pair_by_order_at_once() -> None:
    seen: list[Seen] = []
    pairs = Pairs(WHAT, seen.append, stamped=False)
    for at_ns, answer in enumerate((False, True, False, True), 1):
        pairs.feed(TopicMessage(answer, at_ns, 10))
    assert (len(seen), pairs.paired) == (1, ORDER)


def test_stamps_that_never_match_are_given_up_after_a_few_answers() -> None:
    written = [f"o{i} a{1000 + i}" for i in range(1, UNDECIDED + 1)]
    assert paired(" ".join(written[:-1]) + " o99 a99")[0].paired == STAMP
    pairs, seen = paired(" ".join([*written, "o99 o100 a99"]))
    assert pairs.paired == ORDER
    assert seen[-1][:2] == (2 * UNDECIDED + 2, 2 * UNDECIDED + 3)


def test_an_observation_is_not_kept_for_ever() -> None:
    late = " ".join(f"o{stamp}" for stamp in range(1, MOST_WAITING + 3))
    pairs, seen = paired(f"{late} a{MOST_WAITING} a1")
    assert (pairs.unpaired, [request_ns for request_ns, *_ in seen]) == (1, [MOST_WAITING])
    assert paired(f"{late} a1")[0].paired == ORDER
    assert paired(late)[0].observations == MOST_WAITING + 2


@pytest.mark.parametrize("order", ["little", "big"])
def test_the_stamp_is_read_in_either_byte_order(order: Any) -> None:
    stamp = (3).to_bytes(4, order) + (7).to_bytes(4, order)
    cdr = bytes([0, order == "little", 0, 0]) + stamp
    assert stamp_of(cdr) == stamp_of(memoryview(cdr)) == 3_000_000_007
    assert stamp_of(cdr[:11]) is None
    assert stamp_of(cdr[:4] + bytes(8)) is None


def rows_of(run: StoredRun) -> list[ExchangeRow]:
    return Cells.of(run, EXCHANGES).rows


def read_bag(path: Path, output: Path, out: str = TOKENS, progress: Any = None, **options: Any) -> StoredRun:
    given: dict[str, Any] = {"in_": CAMERA, "out": out, "bag": path}
    config = WatchBag(**given | options)
    return read_run(run_bag(config, output, progress or NullProgress()))


@pytest.mark.parametrize("plugin", list(StoragePlugin))
def test_rows_of_a_recording_are_its_log_times(tmp_path: Path, plugin: StoragePlugin) -> None:
    run = read_bag(record(tmp_path / "bag", tokens(), plugin), tmp_path / "out")
    first, second = rows_of(run)
    assert {first.cell, second.cell} == {WHAT}
    assert [each.request_ns - T0_NS for each in (first, second)] == [100 * MS, 400 * MS]
    assert first.upload_ns is second.upload_ns is first.inference_ns is None
    assert [each.server_ns for each in (first, second)] == [50 * MS, 25 * MS]
    assert [each.download_ns for each in (first, second)] == [30 * MS, 0]
    assert [each.age_ns for each in (first, second)] == [50 * MS, 25 * MS]
    assert [each.pieces for each in (first, second)] == [3, 0]
    assert (second.think_ns, second.period_ns) == (220 * MS, 300 * MS)
    assert (first.think_ns, first.period_ns) == (None, None)
    assert first.up_bytes > 64 * 48 * 3
    assert (first.down_bytes, second.down_bytes) == (3 * 10, 12)
    assert run.manifest["topics"] == {"paired": ORDER, "observations": 3, "answers": 5, "unpaired": 1, "lost": 0}
    assert run.origins.run.tokens == RECORDED


def test_a_recording_of_stamped_answers_is_paired_by_stamp(tmp_path: Path) -> None:
    messages = [(0, CAMERA, image(1)), (33, CAMERA, image(2)), (66, CAMERA, image(3))]
    messages += [(80, "/pose", pose(1)), (90, "/pose", pose(3))]
    run = read_bag(record(tmp_path / "bag", messages), tmp_path / "out", "/pose")
    assert [(each.request_ns - T0_NS, each.server_ns) for each in rows_of(run)] == [(0, 80 * MS), (66 * MS, 24 * MS)]
    assert run.manifest["topics"]["paired"] == STAMP


def test_types_that_only_the_recording_defines_are_read(tmp_path: Path) -> None:
    types = get_typestore(Stores.ROS2_JAZZY)
    types.register(get_types_from_msg("std_msgs/Header header\nfloat32[] chunk", "vla_msgs/msg/Actions"))
    types.register(get_types_from_msg("string text", "vla_msgs/msg/Prompt"))
    actions, prompt = types.types["vla_msgs/msg/Actions"], types.types["vla_msgs/msg/Prompt"]
    chunk = np.zeros(3, np.float32)
    messages = [(0, "/obs", pose(7)), (10, "/obs", pose(8)), (20, "/act", actions(ros.header(7), chunk))]
    messages += [(21, "/said", prompt("x"))]
    with Writer(tmp_path / "bag", version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        for at_ms, topic, message in messages:
            connection = next((each for each in writer.connections if each.topic == topic), None)
            connection = connection or writer.add_connection(topic, message.__msgtype__, typestore=types)
            writer.write(connection, T0_NS + at_ms * MS, types.serialize_cdr(message, message.__msgtype__))
    for out, how, gap_ms in (("/act", STAMP, 20), ("/said", ORDER, 11)):
        run = read_bag(tmp_path / "bag", tmp_path / out[1:], out, in_="/obs")
        assert run.manifest["topics"]["paired"] == how
        assert [each.server_ns for each in rows_of(run)] == [gap_ms * MS]


@pytest.mark.parametrize(("options", "asked_ms"), [({"seconds": 0.4}, [100]), ({"requests": 1}, [100])])
def test_a_bound_ends_the_reading(tmp_path: Path, options: dict[str, Any], asked_ms: list[int]) -> None:
    run = read_bag(record(tmp_path / "bag", tokens()), tmp_path / "out", **options)
    assert [(each.request_ns - T0_NS) // MS for each in rows_of(run)] == asked_ms


@pytest.mark.parametrize("lines", [b"", b"no recording"])
def test_a_file_that_is_no_recording_is_one_line(tmp_path: Path, lines: bytes) -> None:
    (tmp_path / "x.mcap").write_bytes(lines)
    with pytest.raises(SourceError, match=r"^`bag`: .*x.mcap is not a recording that can be read"):
        read_bag(tmp_path / "x.mcap", tmp_path / "out")


def test_a_recording_with_damage_in_its_middle_is_one_line(tmp_path: Path) -> None:
    (path,) = record(tmp_path / "bag", tokens()).glob("*.mcap")
    data = bytearray(path.read_bytes())
    middle = data.index(b"\x09" * 9000)
    data[middle : middle + 9000] = b"\x08" * 9000
    data[middle - 200 : middle - 100] = b"\xff" * 100
    path.write_bytes(data)
    with pytest.raises(SourceError, match=r"^`bag`: .*mcap recover"):
        read_bag(path, tmp_path / "out")


@pytest.mark.parametrize(
    ("options", "line"),
    [
        ({"in_": "/camera"}, f"^`in_`: .* has no topic /camera; it has {CAMERA}, {TOKENS}, /other$"),
        ({"out": "/tokens"}, f"^`out`: .* has no topic /tokens; it has {CAMERA}, {TOKENS}, /other$"),
        ({"bag": Path("/nowhere")}, "^`bag`: no recording at /nowhere$"),
    ],
)
def test_a_topic_that_is_not_recorded_lists_those_that_are(tmp_path: Path, options: dict[str, Any], line: str) -> None:
    path = record(tmp_path / "bag", tokens())
    with pytest.raises(SourceError, match=line):
        read_bag(path, tmp_path / "out", **options)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("run", [run_bag, run_topics])
@pytest.mark.parametrize(
    ("options", "line"),
    [
        ({"in_": "camera"}, "^`in_`: 'camera' should look like /camera/image_raw"),
        ({"out": "/a b"}, "^`out`: '/a b' should look like"),
        ({"out": CAMERA}, "^`out`: /camera/image_raw is the topic of the observations, too"),
    ],
)
def test_what_is_no_topic_is_refused(tmp_path: Path, run: Any, options: dict[str, str], line: str) -> None:
    topics: dict[str, Any] = {"in_": CAMERA, "out": TOKENS, **options}
    config = WatchBag(**topics, bag=tmp_path) if run is run_bag else WatchTopics(**topics)
    with pytest.raises(UsageError, match=line):
        run(config, tmp_path, NullProgress())


def test_a_recording_has_no_domain(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"^`in_`: '/camera/image_raw\?domain_id=1' should look like"):
        read_bag(tmp_path, tmp_path / "out", in_=f"{CAMERA}?domain_id=1")


@pytest.mark.parametrize("plugin", list(StoragePlugin))
def test_a_time_out_of_all_bounds_is_damage(tmp_path: Path, plugin: StoragePlugin) -> None:
    path = record(tmp_path / "bag", [(0, CAMERA, image(1)), (5 * 10**12, TOKENS, string("x"))], plugin)
    with pytest.raises(SourceError, match=r"^`bag`: .* is not a recording that can be read \(a message of the time 6"):
        read_bag(path, tmp_path / "out")


def test_a_recording_without_an_exchange_says_what_it_has(tmp_path: Path) -> None:
    path = record(tmp_path / "bag", [(0, TOKENS, string("x")), (1, CAMERA, image(1)), (2, CAMERA, image(2))])
    with pytest.raises(TransportError, match=rf"^no exchange was seen: 2 messages of {CAMERA}, 1 of {TOKENS}, none"):
        read_bag(path, tmp_path / "out")


def test_the_command_line_reads_a_recording(tmp_path: Path) -> None:
    path, output = record(tmp_path / "bag", tokens()), tmp_path / "out"
    arguments = ("--bag", path, "--in", CAMERA, "--out", TOKENS, "--output", output, "--json")
    printed = json.loads(called("watch", *arguments).stdout)
    (cell,) = printed["cells"]
    assert (cell["cell"], cell["errors"]) == (WHAT, 0)
    assert [each.server_ns for each in rows_of(only_run(output))] == [50 * MS, 25 * MS]


@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        (("--in", CAMERA), "--out is needed"),
        (("--out", TOKENS), "--out is an option of mode topics: give --in"),
        (("--bag", "x.mcap"), "--bag needs --in"),
        (("--in", CAMERA, "--out", TOKENS, "--to", "tcp://a:1"), "--to is an option of mode tap: leave out --in"),
    ],
)
def test_half_of_the_topics_is_wrong_use(arguments: tuple[str, ...], line: str) -> None:
    assert refused("watch", *arguments).startswith(f"error: {line}")


LATER_NS = 50 * MS


def robot(stack: ExitStack, node: Any, answers: int, answer_of: Callable[[int], Any]) -> dict[int, int]:
    """Publish observations until the test ends, each with answers that much later; return when each was sent."""
    camera = node.publisher(CAMERA, ros.IMAGE, QoS(1, reliable=False))
    server = node.publisher(TOKENS, answer_of(1).__msgtype__, QoS(1))
    sent_ns: dict[int, int] = {}
    ended = Event()

    def work() -> None:
        number = 0
        while not ended.wait(0.02):
            number += 1
            sent_ns[number] = now_ns()
            camera.send(camera.pack(image(number, 64 + number)))
            for _ in range(answers):
                ended.wait(LATER_NS / 1e9)
                server.send(server.pack(answer_of(number)))

    thread = Thread(target=work)
    thread.start()
    stack.callback(thread.join)
    stack.callback(ended.set)
    return sent_ns


def live(stack: ExitStack, from_pypi: str, place: str) -> tuple[Any, str]:
    """Return a robot's node, and how to meet it."""
    node = stack.enter_context(closing(open_middleware(from_pypi, node_name="/robot", place=place, host=True)))
    return node, f"?middleware={from_pypi}" + f"&router={place}" * bool(place)


def test_live_answers_with_the_stamp_of_their_observation(
    tmp_path: Path, from_pypi: str, place: str, stack: ExitStack
) -> None:
    node, meet = live(stack, from_pypi, place)
    sent_ns = robot(stack, node, 1, pose)
    run = read_run(run_topics(WatchTopics(in_=CAMERA + meet, out=TOKENS, requests=4), tmp_path, NullProgress()))
    rows = rows_of(run)
    assert [(each.error, each.pieces, each.upload_ns) for each in rows] == [("", 0, None)] * 4
    for each in rows:
        number = each.up_bytes // (48 * 3) - 64
        assert each.server_ns is not None
        assert sent_ns[number] <= each.request_ns
        assert sent_ns[number] + LATER_NS <= each.request_ns + each.server_ns <= now_ns()
    assert run.manifest["topics"]["paired"] == STAMP
    assert run.manifest["middleware"]["middleware"] == from_pypi
    assert run.origins.run.tokens == AT_TOPICS


@once
def test_live_tokens_are_pieces_of_the_answer_to_the_newest_observation(
    tmp_path: Path, from_pypi: str, place: str, stack: ExitStack
) -> None:
    node, meet = live(stack, from_pypi, place)
    robot(stack, node, 3, lambda _: string("ab"))
    run = read_run(run_topics(WatchTopics(in_=CAMERA + meet, out=TOKENS, requests=4), tmp_path, NullProgress()))
    assert run.manifest["topics"]["paired"] == ORDER
    assert any(each.pieces == 3 for each in rows_of(run))


def test_a_topic_without_a_publisher_lists_those_that_have_one(
    tmp_path: Path, from_pypi: str, place: str, stack: ExitStack
) -> None:
    node, meet = live(stack, from_pypi, place)
    robot(stack, node, 1, pose)
    with pytest.raises(TransportError) as error:
        run_topics(WatchTopics(in_=f"{CAMERA}{meet}&wait_s=1", out="/token"), tmp_path, NullProgress())
    (line,) = str(error.value).splitlines()
    assert line.startswith("/token has no publisher after 1 s; topics here: ")
    assert f"{CAMERA}, {TOKENS}" in line
    assert "`?domain_id=` of --in" in line
    assert not [*tmp_path.iterdir()]


@once
def test_topics_without_an_exchange_are_one_line(tmp_path: Path, from_pypi: str, place: str, stack: ExitStack) -> None:
    node, meet = live(stack, from_pypi, place)
    silent = [node.publisher(CAMERA, ros.IMAGE, QoS()), node.publisher(TOKENS, STRING, QoS())]
    with pytest.raises(TransportError, match=f"^no exchange was seen: 0 messages of {CAMERA}, 0 of {TOKENS}, none"):
        run_topics(WatchTopics(in_=CAMERA + meet, out=TOKENS, seconds=0.2), tmp_path, NullProgress())
    assert silent


@pytest.mark.parametrize(("from_pypi", "known"), [("cyclonedds", True), ("zenoh", False)], indirect=["from_pypi"])
def test_a_type_we_do_not_know_is_watched_where_the_middleware_needs_no_hash(
    tmp_path: Path, from_pypi: str, place: str, stack: ExitStack, monkeypatch: pytest.MonkeyPatch, known: bool
) -> None:
    node, meet = live(stack, from_pypi, place)
    robot(stack, node, 1, lambda _: string("ab"))
    until(lambda: any(offer.topic == TOKENS for offer in node.offers()))
    monkeypatch.delitem(ros.typestore().fielddefs, STRING)
    ros.type_hash.cache_clear()
    stack.callback(ros.type_hash.cache_clear)
    config = WatchTopics(in_=CAMERA + meet, out=TOKENS, requests=1)
    if known:
        assert rows_of(read_run(run_topics(config, tmp_path, NullProgress())))
    else:
        with pytest.raises(
            TransportError, match=f"^{TOKENS} is of type {STRING}, which is not known here: use .middle"
        ):
            run_topics(config, tmp_path, NullProgress())
