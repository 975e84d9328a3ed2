"""What is fuzzed: everything that reads what comes from outside, each with seeds that are right as they are.

A target takes bytes. It may raise S2AError, whose text is one line, and nothing else.
"""

from __future__ import annotations

import base64
import json
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from tempfile import mkdtemp

import cv2
import numpy as np
from starlette.testclient import TestClient

from s2a_bench.boards.profile import parse_profile
from s2a_bench.errors import RequestFailed
from s2a_bench.frames.bag import Recording
from s2a_bench.frames.convert import encode_png
from s2a_bench.harness.serving import engine_handler
from s2a_bench.inference import EngineConfig, open_engine
from s2a_bench.plan.parser import Parser
from s2a_bench.plan.skill_file import parse_skills
from s2a_bench.plugins.policy_servers import observed
from s2a_bench.plugins.policy_servers.observation import template_of
from s2a_bench.plugins.policy_servers.websocket.codec import packb, unpackb
from s2a_bench.plugins.policy_servers.zmq import layouts
from s2a_bench.plugins.policy_servers.zmq import wire as gr00t
from s2a_bench.report.compare.comparison import compare, metrics_of, open_comparison, warnings_of
from s2a_bench.report.compare.shown import compare_json
from s2a_bench.report.page.chapters import read_chapters
from s2a_bench.report.page.files import make_report
from s2a_bench.ros import messages as ros
from s2a_bench.store.files import count_rows, read_csv, read_parquet
from s2a_bench.store.requests import TOKENS, TokenRow, samples_table
from s2a_bench.store.run import RunWriter, read_run
from s2a_bench.sweep.file import read_sweep_file
from s2a_bench.trace import Remote, Trace
from s2a_bench.transport.access import Access, WebOptions
from s2a_bench.transport.http.chat import of_json, of_picture
from s2a_bench.transport.http.dialects import DIALECTS, open_dialect
from s2a_bench.transport.http.dialects.decoder import Decoder
from s2a_bench.transport.http.fast import Head
from s2a_bench.transport.http.native import PARAMETERS_HEADER, PATHS, Refused
from s2a_bench.transport.http.server import application
from s2a_bench.transport.limits import LIMITS
from s2a_bench.transport.pictures import decoded
from s2a_bench.transport.pipeline import pipelines
from s2a_bench.transport.ros import wire
from s2a_bench.transport.serving import Core
from s2a_bench.types import Frame, Request, Token
from s2a_bench.vectors import actions_of
from tests.made_runs import STAGES
from tests.plan.test_parser import FORMATS
from tests.servers.speakers import SPEAKERS

ROOT = Path(__file__).parents[2]


@dataclass(frozen=True)
class Target:
    """One reader; ``json`` seeds are changed as JSON too, a value at a time."""

    read: Callable[[bytes], object]
    seeds: Callable[[], list[bytes]]
    json: bool = False


@cache
def place() -> Path:
    """Return a folder of this process for files that readers want."""
    return Path(mkdtemp(prefix="s2a-fuzz-"))


def as_file(name: str, data: bytes) -> Path:
    path = place() / name
    path.write_bytes(data)
    return path


def answers() -> list[bytes]:
    tokens = [Token(1, " a"), Token(2, "é\n")]
    said = [
        speaker.opening() + b"".join(map(speaker.token, tokens)) + speaker.closing(tokens) + speaker.error("no")
        for speaker in SPEAKERS
    ]
    return [*said, *(line.removeprefix(b"data: ") for text in said for line in text.splitlines() if line)]


def read_answer(data: bytes) -> None:
    for name in DIALECTS:
        decoder = Decoder(open_dialect(name))
        for cut in (data[: len(data) // 2], data[len(data) // 2 :]):
            list(decoder.feed(cut))
        list(decoder.end())


def bodies() -> list[bytes]:
    pixel = f"data:image/png;base64,{base64.b64encode(pictures()[1]).decode()}"
    parts = [{"type": "text", "text": "go"}, {"type": "image_url", "image_url": {"url": pixel}}]
    facts = {"max_tokens": 2, "seed": 1, "grammar": "", "request_id": "r1"}
    chats = [{"messages": [{"role": "user", "content": parts}], "stream": stream, **facts} for stream in (True, False)]
    raw = {"prompt": "go", "images": [], "media_types": [], "lengths": [], **facts}
    return [json.dumps(body).encode() for body in (*chats, raw)]


@cache
def client() -> TestClient:
    core = Core(engine_handler(open_engine(EngineConfig(name="echo"))), LIMITS)
    return TestClient(application(core, Access(WebOptions(), "127.0.0.1", "", "Bearer")), "http://localhost")


def ask_server(data: bytes) -> None:
    answer = client().post(PATHS["as-deployed"], content=data, headers={"content-type": "application/json"})
    assert answer.status_code in {200, 400, 413}, answer.text
    with suppress(Refused):
        Head(data)
    for headers, body in (([(PARAMETERS_HEADER, data.decode("latin-1"))], b""), ([], data)):
        with suppress(RequestFailed):
            (of_picture if headers else of_json)(headers, body, Trace(), LIMITS)


def cdrs() -> list[bytes]:
    picture = ros.image_message(Frame(0, 0, 4, 2, "bgr8", np.zeros((2, 4, 3), np.uint8)), 5, "camera")
    jpeg = ros.compressed_image_message(cv2.imencode(".jpg", np.zeros((2, 4, 3), np.uint8))[1].reshape(-1), 5, "camera")
    remote = Remote("c", [("queue", 1), ("inference", 2)], [3, 4], 5, [("capture", 6)], {"load": 0.5})
    said = [
        (ros.REQUEST, wire.request_message(Request("r1", "go", (), 2), [picture], [jpeg])),
        (ros.TOKEN, wire.token_message("r1", Token(1, "a"), last=True)),
        (ros.MARKS, wire.marks_message("r1", remote)),
        (ros.IMAGE, picture),
    ]
    return [bytes(ros.serialise(value, name)) for name, value in said]


def read_cdr(data: bytes) -> None:
    for name in (ros.REQUEST, ros.TOKEN, ros.MARKS, ros.IMAGE):
        try:
            value = ros.deserialise(memoryview(data), name)
        except ros.TransportError:
            continue
        if name == ros.MARKS:
            wire.remote_of(value)
        for image in {ros.IMAGE: [value], ros.REQUEST: getattr(value, "images", [])}.get(name, []):
            ros.frame_of_image(image)


def gguf_files() -> list[bytes]:
    from gguf import GGUFWriter

    path = place() / "seed.gguf"
    writer = GGUFWriter(path, "qwen2")
    writer.add_block_count(2)
    writer.add_float32("qwen2.x", 0.5)
    writer.add_token_list(["a", "bc", "é"])
    writer.add_token_types([1, 1, 3])
    writer.add_eos_token_id(2)
    writer.add_chat_template("{{ x }}")
    writer.add_tensor("blk.0.w", np.zeros((2, 4), np.float32))
    writer.write_header_to_file()
    writer.write_kv_data_to_file()
    writer.write_tensors_to_file()
    writer.close()
    return [path.read_bytes()]


def read_gguf(data: bytes) -> None:
    from s2a_bench.inference.gguf_file import read_header

    assert isinstance(read_header(as_file("a.gguf", data), "`model`").architecture, str)


def tomls(*patterns: str) -> Callable[[], list[bytes]]:
    return lambda: [path.read_bytes()[:6000] for pattern in patterns for path in sorted(ROOT.glob(pattern))]


def a_run() -> Path:
    found = place() / "runs"
    if not found.exists():
        with RunWriter.create(found, "latency", {"warnings": [{"code": "x", "message": "m", "advice": "a"}]}) as run:
            run.tokens(
                [TokenRow("r1", "ros/topic", 0, 1, "a,\n", 5, 6), TokenRow("r1", "ros/topic", 1, 2, "", None, 7)]
            )
    return next(iter(found.iterdir()))


def manifests() -> list[bytes]:
    return [path.read_bytes() for path in sorted(ROOT.glob("results/reference/echo-*/manifest.json"))]


def read_manifest(data: bytes) -> None:
    reference = ROOT / "results/reference/echo-raw"
    folder = place() / "changed"
    folder.mkdir(exist_ok=True)
    if not (folder / "samples.parquet").exists():
        for path in reference.glob("*.parquet"):
            (folder / path.name).write_bytes(path.read_bytes())
    (folder / "manifest.json").write_bytes(data)
    make_report(read_chapters([folder], against="paper"), against="paper")
    compared = open_comparison([read_run(reference)], [read_run(folder)], unlike=True, least=0.05)
    compared = compare(compared, metrics_of(compared, ())[:1])
    compare_json(compared, [], warnings_of(compared))


def read_rows(data: bytes) -> None:
    for table in (TOKENS, samples_table(STAGES)):
        read_csv(as_file("a.csv", data), table.columns)
    count_rows(place() / "a.csv")


def read_stored(data: bytes) -> None:
    read_parquet(as_file("a.parquet", data), TOKENS.columns)


def read_plan(data: bytes) -> None:
    for format_ in FORMATS.values():
        parser = Parser(format_)
        parser.feed(data[: len(data) // 2])
        parser.feed(data[len(data) // 2 :].decode("utf-8", "replace"))
        parser.close()


def pictures() -> list[bytes]:
    pixels = np.arange(4 * 6 * 3, dtype=np.uint8).reshape(4, 6, 3)
    return [cv2.imencode(suffix, pixels)[1].tobytes() for suffix in (".jpg", ".png")]


def read_yaml(data: bytes) -> None:
    folder = place() / "bag"
    folder.mkdir(exist_ok=True)
    (folder / "metadata.yaml").write_bytes(data)
    Recording(str(folder), 64, 48)


METADATA = b"""rosbag2_bagfile_information:
  version: 5
  storage_identifier: mcap
  duration: {nanoseconds: 1}
  starting_time: {nanoseconds_since_epoch: 1}
  message_count: 1
  topics_with_message_count:
    - topic_metadata: {name: /c, type: sensor_msgs/msg/Image, serialization_format: cdr, offered_qos_profiles: ""}
      message_count: 1
  compression_format: ""
  compression_mode: ""
  relative_file_paths: []
"""


def read_observation(data: bytes) -> None:
    """Read what a policy server is asked, and what its client is answered."""
    message = unpackb(data)
    observed.request_of(message, observed.take_extension(message), Trace(), LIMITS)
    actions_of(message.get("actions") if isinstance(message, dict) else message)


def observations() -> list[bytes]:
    """Return observations and answers."""
    picture = np.zeros((4, 6, 3), np.uint8)
    told = {"image": picture, "more": [picture.transpose(2, 0, 1), encode_png(picture)], "gripper": np.float32(0.5)}
    told |= {"state": np.zeros(7), "prompt": "go", "s2a": {"id": "a", "max_tokens": 5, "seed": 1, "grammar": "x"}}
    return [packb(told), packb({**told, "actions": np.zeros((4, 2))}), packb({"actions": [[1, 2.5]]})]


def read_gr00t(data: bytes) -> None:
    """Read what a GR00T server is asked, and what its client is answered."""
    message, _ = gr00t.read(data)
    with suppress(RequestFailed):
        observed.remote_of(message)
    if isinstance(message, dict):
        observation, layout = layouts.observation_in(message.get("data"))
        observed.request_of(observation, observed.take_extension(message), Trace(), LIMITS)
        layouts.answer_of(observation, layout, np.zeros((1, 2), np.float32))
    layouts.actions_in(message)


def gr00ts() -> list[bytes]:
    """Return requests of both layouts in both codecs, answers, and marks."""
    picture, state = np.zeros((1, 4, 6, 3), np.uint8), np.zeros((1, 5), np.float64)
    flat = {"video.a": picture, "state.a": state, "annotation.human.task_description": ["go"]}
    nested = {"video": {"a": picture[None]}, "state": {"a": state[None]}, "language": {"task": [["go"]]}}
    told = {"id": "a", "max_tokens": 5, "seed": 1, "grammar": "x"}
    messages = [
        {"endpoint": "get_action", "data": flat, "s2a": told},
        {"endpoint": "get_action", "data": {"observation": nested, "options": None}},
        [{"a": np.zeros((1, 4, 2)), "b": np.zeros((1, 4, 1))}, {}],
        {"action.a": np.zeros((4, 2), np.float32)},
        observed.ActionsExchange().marks(),
    ]
    return [bytes(gr00t.pack(message, maps=maps)) for message in messages for maps in (False, True)]


NAMES = [b"http/binary?payload=png&connection=per-request", b"ros/topic?result_timeout=2.5", b"loopback", b"ros/action"]
RAW = b"application/x-raw; width=6; height=4; encoding=bgr8"

TARGETS = {
    "answers": Target(read_answer, answers, json=True),
    "requests": Target(ask_server, bodies, json=True),
    "cdr": Target(read_cdr, cdrs),
    "gguf": Target(read_gguf, gguf_files),
    "profile": Target(
        lambda data: parse_profile("p", data.decode("utf-8", "replace"), "p.toml"), tomls("profiles/*.toml")
    ),
    "skills": Target(
        lambda data: parse_skills(data.decode("utf-8", "replace"), "s.toml"), tomls("s2a_bench/plan/skills/*.toml")
    ),
    "sweep": Target(lambda data: read_sweep_file(as_file("s.toml", data)), tomls("profiles/sweeps/*.toml")),
    "manifest": Target(read_manifest, manifests, json=True),
    "csv": Target(read_rows, lambda: [(a_run() / "tokens.csv").read_bytes()]),
    "parquet": Target(read_stored, lambda: [(a_run() / "tokens.parquet").read_bytes()]),
    "plan": Target(read_plan, lambda: [b"1. open(fridge)\n2. close(fridge)\n", b'[{"skill": "go"}]', b"ABAB"]),
    "picture": Target(lambda data: decoded("image/png", data, Trace()), pictures),
    "raw": Target(lambda data: decoded(data.decode("utf-8", "replace"), bytes(72), Trace()), lambda: [RAW]),
    "pipeline": Target(lambda data: pipelines([data.decode("utf-8", "replace")]), lambda: NAMES),
    "yaml": Target(read_yaml, lambda: [METADATA]),
    "observation": Target(read_observation, observations),
    "marks": Target(
        lambda data: observed.remote_of(unpackb(data)), lambda: [packb(observed.ActionsExchange().marks())]
    ),
    "gr00t": Target(read_gr00t, gr00ts),
    "template": Target(
        lambda data: template_of(str(as_file("t.toml", data))),
        tomls("s2a_bench/plugins/policy_servers/templates/*.toml"),
    ),
    "template, JSON": Target(
        lambda data: template_of(str(as_file("t.json", data))),
        lambda: [b'{"a": "{image:0|CHW}", "b?": [["{state:0:7}"]], "prompt": "Task: {prompt}"}'],
        json=True,
    ),
}
