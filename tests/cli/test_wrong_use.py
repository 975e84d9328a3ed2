"""Wrong use of any command: one line that names the flag, before anything is kept."""

from __future__ import annotations

import shlex
from pathlib import Path

import pytest

from tests.cli.program import refused

ECHO, LLAMA = (Path(__file__).parents[2] / "results" / "reference" / name for name in ("echo-jpeg", "llama-jpeg"))
WRONG = {
    "compare": [
        (f"{ECHO}", "Missing argument 'B'"),
        (f"{ECHO} /no/such", "/no/such is not a run folder", 1),
        (f"{ECHO} {LLAMA}", "the runs are unlike: model engine: echo against llama; provenance engine: echo ", 1),
        (f"{ECHO} {ECHO} --fail-if 'zmq:e2e>5%'", "no cell with e2e is called 'zmq'; there are ros/topic, http/as-"),
        (f"{ECHO} {ECHO} --strict", "--strict: no gate; add --fail-if"),
        (f"{ECHO} {ECHO} --one-launch", "--one-launch: no gate; add --fail-if"),
        (f"{ECHO} {ECHO} --min-effect -1", "--min-effect"),
        (f"{ECHO},{ECHO} {ECHO}", "A: a folder is named twice"),
        (f"{ECHO} ' , '", "B: name a run folder"),
        (f"{ECHO} {ECHO} --output {__file__}", f"--output {__file__}: ", 1),
    ],
    "ccrb": [
        ("--simulator gazebo", "--simulator: 'gazebo' is not one of longitudinal, embedded"),
        ("--lane-change", "--lane-change: the longitudinal simulator knows one lane"),
        ("--live --rate 9", "--rate is an option of mode computed: leave out --live"),
        ("--closed-loop --ttc", "--ttc is an option of mode computed: leave out --closed-loop"),
        ("--live --engine echo", "--engine echo computes nothing; a plan takes a model's time: use llama or replay"),
    ],
    "chunks": [
        ("--rules calibrated --eps 0.001 --calibration-cycles 100", "or take --rules maximum,mean,oracle"),
        ("--latency ''", "--latency: name at least one"),
        ("--control-hz 0", "--control-hz: 0"),
        ("--modes 'queue?execute=99'", "a chunk has 16 actions (--horizon)"),
    ],
    "throughput": [
        ("--engine echo", "--engine echo computes nothing"),
        ("--url http://x --transport ros", "--url needs http among --transport"),
    ],
    "timeline": [
        ("--policy 'stream-to-act?cauton=2'", "; did you mean caution?"),
        ("--jitter fog", "--jitter fog: family: 'fog' is not one of"),
        ("--pace 4.8", "--pace is an option of mode live: give --live"),
        ("--live --real-time", "--live and --real-time exclude each other"),
        ("--live --url http://localhost:1 --pace 3", "--pace needs the package's server"),
    ],
    "boundary": [
        ("--rates 60,0.3", "--rates: should be two tokens/s, the lower first"),
    ],
    "latency": [
        ("--requests many", "'--requests'"),
        ("--sample-resources -1", "--sample-resources: -1.0 should be"),
        ("--trnsport ros", "No such option: --trnsport; did you mean --transport?"),
        ("--transport http/best-efort", "; did you mean best-effort?"),
        ("--transport http?conection=x", "; did you mean connection?"),
        ("--engine lama", "'lama' is not one of llama, echo, replay, call; did you mean llama?"),
        ("--url grpc+http://x", "--url: no installed transport speaks grpc+http://, only http://"),
        ("--payload gif", "--payload: 'gif' is not one of raw, yuyv, jpeg, jpeg-preencoded, png"),
        ("--url http://127.0.0.1:9 --transport http", "nothing answers at http://127.0.0.1:9", 1),
        ("--transport http,ros --template openvla-oft", "--template is about a server that runs already"),
        ("--transport grpc", "--transport grpc/lerobot is a client alone: name its --url, grpc://HOST:PORT"),
        ("--url http://x --dialect openvla --payload jpeg", "can send a picture as raw, not as jpeg"),
        ("--url http://x --api-key-env sk-1234", "takes the name of an environment variable, not the key itself"),
        ("--output /dev/null", "/dev/null is not a folder; name another one", 1),
        ("--profile rtx-4080", "--profile needs --engine replay; --engine llama answers at its own speed"),
        ("--engine replay --profile rtx-4080 --url http://x", "--engine replay needs our own servers; leave out --url"),
    ],
    "doctor": [
        ("--url foo", "--url: 'foo' should look like http://192.168.0.5:8000: one of http://"),
        ("--url me:key@host", "--url: 'me://' should look like http"),
    ],
    "model": [
        ("dummy --size huge", "--size: 'huge' should be 'tiny' or 'full'"),
        ("dummy --output /dev/null/x", "--output /dev/null/x: cannot write mmproj-", 1),
        ("fetch gpt", "model fetch: 'gpt' is neither minicpm-v-2.6, qwen2.5-vl-3b"),
        ("fetch a/b:c.gguf --quant Q8_0", "--quant Q8_0: goes with a name or OWNER/REPO"),
    ],
    "profile": [
        ("capture ../x", "NAME: '../x' should be a plain file name"),
    ],
    "sweep": [
        ("papr", "; did you mean paper?"),
        ("", "name a sweep file, or the folder of a sweep with --resume"),
        ("paper --retry-failed", "--retry-failed: name the sweep's folder with --resume"),
        ("--resume /nowhere", "/nowhere is not a run folder", 1),
    ],
    "serve": [
        ("pigeon", "--transport: 'pigeon' is not one of http, ros, loopback"),
        ("grpc", "--transport: grpc is a client alone"),
        ("http --port 99999", "--port: 99999 should be less than or equal to 65535"),
        ("http --model /no/such", "--model /no/such: no such file; check the path", 1),
        ("http --ros-args -r a:=b", "--ros-args are for ROS 2 nodes, not for serve http"),
        ("ros --ros-args -r __ns:=robot", "--namespace: 'robot' should look like /name"),
        ("ros --ros-args -r __node:=a/b", "--node-name"),
    ],
    "": [
        ("latncy", "No such command 'latncy'; did you mean latency? (see 's2a-bench --help')"),
        ("--bogus", "No such option: --bogus"),
    ],
}
"""Command -> the rest of the line, the message, and the exit code if it is not 2."""


@pytest.mark.parametrize(("command", "case"), [(name, case) for name, cases in WRONG.items() for case in cases])
def test_it_is_one_line_and_leaves_nothing(
    command: str, case: tuple[str, str] | tuple[str, str, int], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    line, message, *code = case
    assert message in refused(*command.split(), *shlex.split(line), code=code[0] if code else 2)
    assert not list(tmp_path.iterdir())
