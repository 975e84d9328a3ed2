"""Wrong use of any command: one line that names the flag, before anything is kept."""

from __future__ import annotations

import shlex
from pathlib import Path

import pytest

from tests.cli.program import refused

WRONG = {
    "ccrb": [
        ("--simulator gazebo", "--simulator: 'gazebo' is none of longitudinal, embedded, carla"),
        ("--phase-gaps 6", "--phase-gaps: should be two numbers"),
        ("--phase-rates a,b", "--phase-rates: 'a' should be a valid number"),
        ("--lane-change", "--lane-change: the longitudinal simulator knows one lane"),
        ("--simulator carla --host localhost:1", "carla", 1),
        ("--pace 4.8", "--pace is about a model that answers; it needs --live"),
        ("--transport ros", "--transport is about a model that answers; it needs --live"),
        ("--live --rate 9", "--rate is about tokens that are modelled; leave it out with --live"),
        ("--live --prompt-time 0.2", "--prompt-time is about tokens that are modelled"),
        ("--live --profile rtx-4080", "--profile is about tokens that are modelled"),
        ("--live --phase", "--phase is about tokens that are modelled; leave it out with --live"),
        ("--live --random 9", "--random is about tokens that are modelled; leave it out with --live"),
        ("--live --pace -1", "--pace: -1.0 should be greater than 0"),
        ("--live --pace 0.01", "the whole plan takes"),
        ("--live --transport pigeon", "--transport: 'pigeon' is none of http, ros, loopback"),
        ("--live --engine echo", "--engine echo writes no plans"),
        ("--live --engine replay --pace 5", "--engine replay has its profile's rate"),
        ("--live --engine replay --tokens-per-skill 4", "--engine replay writes 6 tokens a skill"),
    ],
    "chunks": [
        ("--latency fast", "--latency: 'fast' should be a number of ms"),
        ("--latency lognormal:cv=1", "--latency: lognormal:cv=1: mean_ms should be above 0"),
        ("--modes walk", "--modes: 'walk' is none of sync, queue"),
        ("--modes 'queue?speed=2'", "--modes: queue: 'speed' is no parameter"),
        ("--modes 'queue?execute=99'", "a chunk has 16 actions (--horizon)"),
        ("--rules guess", "--rules: 'guess' is none of calibrated"),
        ("--eps 0.001 --calibration-cycles 100", "--eps: 100 calibration plans promise"),
        ("--rounding up", "--rounding"),
        ("--live --zmq gr00t", "--zmq has another name: write --transport zmq/gr00t"),
    ],
    "throughput": [
        ("--transport pigeon", "--transport: 'pigeon' is none of http, ros, loopback"),
        ("--transport ''", "--transport: name at least one"),
        ("--kv-type q3", "--kv-type: 'q3' is none of f32, f16, q8_0, q4_0"),
        ("--kv-type q4_0 --flash-attention off", "--kv-type q4_0 needs flash attention"),
        ("--flash-attention 1", "--flash-attention: '1' is none of auto, on, off"),
        ("--sampling hot", "--sampling: 'hot' is none of model, greedy"),
        ("--batch 1", "--batch: 1 should be greater than or equal to 32"),
        ("--engine echo", "--engine echo computes nothing"),
        ("--runs 20", "--runs has another name: write --requests 20"),
        ("--max-tokens 1", "--max-tokens: a rate needs 2 tokens or more"),
        ("--reference /no/such", "--reference: /no/such is no program that can be run"),
        ("--against us", "--against: 'us' should be paper"),
        ("--url http://x", "--url needs http among --transport"),
        ("--bogus", "No such option: --bogus"),
    ],
    "timeline": [
        ("--policy eager", "--policy: 'eager' is none of naive, wait-then-act, stream-to-act"),
        ("--profile abacus", "--profile: 'abacus' is none of"),
        ("--rate fast", "--rate: 'fast' should be a valid number"),
        ("--tokens-per-skill 1.5", "--tokens-per-skill: '1.5' should be a valid integer"),
        ("--jitter fog", "--jitter fog: family: 'fog' is none of"),
        ("--rate 3 --jitter profile", "--jitter: profile needs --profile"),
        ("--plans 5", "--plans: without --jitter or --t-nom-cv all plans are the same"),
        ("--calibrate /nowhere", "--calibrate: the recorded machine is one board"),
        ("--pace 4.8", "--pace is about a model that answers; it needs --live"),
        ("--warmup 0", "--warmup is about a model that answers; it needs --live"),
        ("--no-grammar --real-time", "--no-grammar is about a model that answers; it needs --live"),
        ("--live --plans 3", "--plans are computed; with --live write --requests 3"),
        ("--requests 3", "--requests is about a model that answers; it needs --live"),
        ("--live --real-time", "--live and --real-time are two things"),
        ("--live --rate 4.8", "--rate is about tokens that are modelled; leave it out with --live"),
        ("--live --jitter profile", "--jitter is about tokens that are modelled"),
        ("--live --t-nom-cv 0.2", "--t-nom-cv is about tokens that are modelled"),
        ("--live --pace 0", "--pace: 0.0 should be greater than 0"),
        ("--live --pace -3", "--pace: -3.0 should be greater than 0"),
        ("--live --timeout 0", "--timeout: 0.0 should be greater than or equal to 0.1"),
        ("--live --transport pigeon", "--transport: 'pigeon' is none of http, ros, loopback"),
        ("--live --transport ros/post", "--transport: 'post' is none of ros's topic, action"),
        ("--live --size 64", "--size: '64' should look like 640x480"),
        ("--live --tokens-per-skill six", "--tokens-per-skill: 'six' should be a valid integer"),
        ("--live --robot kuka", "--robot: 'kuka' is none of timed, plant, ros, call"),
        ("--live --robot plant", "--robot: plant carries out no skills; timed, ros, call do"),
        ("--live --profile rtx-4080", "--profile needs --engine replay"),
        ("--live --url http://localhost:1 --pace 3", "--pace needs our own server"),
        ("--real-time --profile cray", "--profile: 'cray' is none of"),
    ],
    "boundary": [
        ("--rates 60,0.3", "--rates: should be two tokens/s, the lower first"),
        ("--rates 0,10", "--rates: should be two tokens/s, the lower first"),
        ("--points 1", "--points: 1 should be greater than or equal to 2"),
        ("--plans 10", "--plans: without --jitter all plans are the same"),
        ("--jitter profile", "--jitter profile: family: 'profile' is none of"),
    ],
    "latency": [
        ("--bogus", "No such option: --bogus"),
        ("--requests many", "'--requests'"),
        ("--runs 20", "--runs has another name: write --requests 20"),
        ("--port 70000", "--port: 70000 should be less than"),
        ("--payload gif", "--payload: 'gif' is none of raw, yuyv, jpeg, jpeg-preencoded, png"),
        ("--transport http,pigeon", "--transport: 'pigeon'"),
        ("--transport http/fast", "--transport: 'fast'"),
        ("--http binary", "--http has another name: write --transport http/binary"),
        ("--size big", "--size: 'big' should look like 640x480"),
        ("--engine gpt", "--engine: 'gpt'"),
        ("--against rivals", "--against: 'rivals' should be paper"),
        ("--prompt @/no/such/file", "--prompt: cannot read /no/such/file"),
        ("--grammar /no/such/file", "--grammar: cannot read /no/such/file"),
        ("--source webcam", "--source: 'webcam' is none of synthetic, video"),
        ("--source video", "--source: 'video' should be video:FILE"),
        ("--engine replay", "--engine replay needs --profile NAME"),
        ("--profile rtx-4080", "--profile needs --engine replay; --engine llama answers at its own speed"),
        ("--engine replay --profile tx1", "--profile: 'tx1' is none of"),
        ("--engine replay --profile rtx-4080 --gaps wild", "--gaps: 'wild' is none of"),
        ("--engine replay --profile rtx-4080 --gaps trace", "profile rtx-4080 holds no recording"),
        ("--engine replay --profile rtx-4080 --url http://x", "--engine replay needs our own servers; leave out --url"),
    ],
    "model": [
        ("fetch", "Missing argument 'NAME'"),
        ("fetch gpt", "model fetch: 'gpt' is neither minicpm-v-2.6 nor ORG/REPO:FILE"),
        ("fetch a/b:c.gguf --quant Q8_0", "--quant Q8_0: goes with minicpm-v-2.6"),
        ("info", "Missing argument 'FILE'"),
        ("dummy --quant q2", "--quant: 'q2' should be 'f16'"),
    ],
    "profile": [
        ("show tx1", "--profile: 'tx1' is none of jetson-agx-orin"),
        ("show ./tx1", "--profile: there is no file ./tx1"),
        ("capture ../x", "NAME: '../x' should be a plain file name"),
        ("capture x --tokens 1", "--tokens: 1 should be greater than or equal to 2"),
        ("capture x --size big", "--size: 'big' should look like"),
    ],
    "sweep": [
        ("", "name a sweep file, or the folder of a sweep with --resume"),
        ("nothing", "'nothing' is none of paper, quick, transports, and no path"),
        ("none.toml", "cannot read the sweep file none.toml"),
        ("paper --retry-failed", "--retry-failed: name the sweep's folder with --resume"),
        ("paper --ray local --board x", "--board and --ray are two things"),
        ("--resume /nowhere", "/nowhere is no run folder", 1),
    ],
    "serve": [
        ("http --engine replay", "--engine replay needs --profile NAME"),
        ("ros --profile rtx-4080", "--profile needs --engine replay"),
        ("http --ros-args -r a:=b", "--ros-args are for ROS 2 nodes, not for serve http"),
        ("ros --ros-args -r 'a:=b c'", "--remap: 'a:=b c' should look like from:=to"),
        ("ros --ros-args -p qos:=fast", "--ros-args: --qos: 'fast'"),
        ("ros --ros-args -p max_tokens:=true", "--ros-args: max_tokens = True should be a number"),
        ("ros --ros-args -r __ns:=robot", "--namespace: 'robot' should look like /name"),
        ("ros --ros-args -r __node:=a/b", "--node-name"),
    ],
    "": [
        ("--bogus", "No such option: --bogus"),
        ("fly", "No such command 'fly'"),
    ],
}
"""Command -> the rest of the line, what is said, and the exit code where it is not 2."""


@pytest.mark.parametrize(("command", "case"), [(name, case) for name, cases in WRONG.items() for case in cases])
def test_it_is_one_line_and_leaves_nothing(
    command: str, case: tuple[str, str] | tuple[str, str, int], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    line, said, *code = case
    assert said in refused(*command.split(), *shlex.split(line), code=code[0] if code else 2)
    assert not list(tmp_path.iterdir())
