"""Emulated links: they carry what their profiles say, and nothing is left of them."""

from __future__ import annotations

import fcntl
import json
import os
import shutil
import socket
import struct
import subprocess
import sys
from collections.abc import Callable
from functools import cache
from pathlib import Path
from select import select
from shutil import which
from threading import Thread
from typing import Any

import pytest

import s2a_bench as s2a
from s2a_bench.clock import SystemClock
from s2a_bench.errors import NotPermitted, UsageError
from s2a_bench.harness.config import RequestsConfig
from s2a_bench.plugins.two_hosts.advise.prediction import HEADERS, Tcp, tcp_adds_ms
from s2a_bench.plugins.two_hosts.links import CLIENT, SERVER, EmulatedLink, emulated
from s2a_bench.plugins.two_hosts.links.probe import probed
from s2a_bench.plugins.two_hosts.profiles import bound_s, load_link
from tests.cli.program import called

SIOCGIFTXQLEN = 0x8942
MAKE = """
import fcntl, os, struct
fcntl.ioctl(os.open("/dev/net/tun", os.O_RDWR), 0x400454CA, struct.pack("16sH22x", b"tried", 0x1001))
open("/proc/sys/net/ipv4/conf/tried/route_localnet", "w").write("1")
"""


@cache
def can_be_made() -> bool:
    """Tell whether this machine lets other programs make the namespaces and the device of a link."""
    command = ["unshare", "-n", sys.executable, "-c", MAKE]
    return bool(which("unshare")) and not subprocess.run(command, capture_output=True, check=False).returncode


def on_link(link: str, use: Callable[[EmulatedLink], Any]) -> Any:
    """Use a link; a machine where none can be made, or that is too busy for it, skips the test with its reason."""
    try:
        with emulated(load_link(link)) as made:
            return use(made)
    except (NotPermitted, UsageError) as refused:
        if can_be_made() and "does not carry" not in str(refused):
            raise
        pytest.skip(str(refused))


@pytest.mark.slow
@pytest.mark.parametrize(
    "link", ["rate=20/40,delay=5", "rate=30,loss=10%", "rate=20,burst_kib=150,burst_mbps=60", "delay=9,jitter=8"]
)
def test_a_link_carries_what_its_profile_says(link: str) -> None:
    found = on_link(link, probed)["probe"]["quantities"]
    names = {each["what"] for each in found}
    assert {"added one-way delay", "loss up", "loss down"} <= names
    assert ({"rate up", "rate down"} <= names) == ("rate" in link)
    assert ("burst up" in names) == ("burst" in link)


def _echo(listener: socket.socket, size: int) -> None:
    peer, _ = listener.accept()
    with peer:
        while peer.recv(size, socket.MSG_WAITALL):
            peer.send(b"x")


def _requests_ms(link: EmulatedLink, tcp: Tcp, size: int, period_ms: float) -> list[float]:
    """Return the times of bodies of ``size`` bytes until their answers, each sent ``period_ms`` after the last."""
    clock, times_ms = SystemClock(), []
    with link.server_side():
        listener = socket.create_server((SERVER, 0))
    with listener, socket.socket() as client:
        Thread(target=_echo, args=(listener, size), daemon=True).start()
        client.setsockopt(socket.IPPROTO_TCP, socket.TCP_CONGESTION, tcp.congestion_control.encode())
        client.connect(listener.getsockname())
        for _ in range(8):
            started_ns = clock.now_ns()
            client.sendall(bytes(size))
            client.recv(1)
            times_ms.append((clock.now_ns() - started_ns) / 1e6)
            clock.sleep_until_ns(started_ns + round(period_ms * 1e6))
    return times_ms[3:]


@pytest.mark.slow
@pytest.mark.parametrize("name", ["cubic", "reno"])
def test_the_kernel_starts_slowly_after_idle_as_advice_predicts(name: str) -> None:
    if name not in Path("/proc/sys/net/ipv4/tcp_available_congestion_control").read_text().split():
        pytest.skip(f"this kernel has no {name}")
    tcp, size = Tcp(name, slow_start_after_idle=True), 70_000

    def use(link: EmulatedLink) -> None:
        plain_ms = bound_s(link.directions, size * HEADERS) * 1e3
        least_ms, most_ms = tcp_adds_ms(size, link.directions, 1000, tcp)
        assert least_ms == most_ms > 0.7 * plain_ms
        busy_ms, idle_ms = (min(_requests_ms(link, tcp, size, period_ms)) for period_ms in (0, 1000))
        assert 0.9 < busy_ms / plain_ms < 1.4
        assert 0.9 < idle_ms / (plain_ms + least_ms) < 1.4

    on_link("rate=30,delay=30", use)


def test_the_manifest_has_both_directions_without_their_steps(monkeypatch: pytest.MonkeyPatch) -> None:
    profile, said = load_link("rate=9,rate_cv=0.3,delay=4,seed=5"), list[str]()
    monkeypatch.setattr("s2a_bench.plugins.two_hosts.links.probed", lambda _: {"probe": {}})
    facts = EmulatedLink(profile, 0, 0, None).facts(said.append)["link"]  # type: ignore[arg-type]
    assert (said, facts["probe"]) == ([f"probing the link {profile.name}"], {})
    up, down = facts["directions"]
    assert (up["steps"], down["steps"]) == ((), ())
    assert (up["delay_ms"], up["seed"], down["seed"]) == (4, 10, 11)
    assert facts["profile"]["rate_cv"] == 0.3


def test_the_servers_side_has_the_usual_address_and_the_thread_returns_home(monkeypatch: pytest.MonkeyPatch) -> None:
    home = str(Path("/proc/thread-self/ns/net").readlink())
    seen: dict[str, Any] = {}

    monkeypatch.setenv("ROS_STATIC_PEERS", "mine")
    monkeypatch.delenv("ROS_AUTOMATIC_DISCOVERY_RANGE", raising=False)

    def use(link: EmulatedLink) -> None:
        seen["inside"] = str(Path("/proc/thread-self/ns/net").readlink())
        with link.server_side():
            seen["server"] = str(Path("/proc/thread-self/ns/net").readlink())
            server = socket.create_server((SERVER, 0))
        assert seen["inside"] == str(Path("/proc/thread-self/ns/net").readlink())
        with socket.socket() as any_socket:
            asked = fcntl.ioctl(any_socket, SIOCGIFTXQLEN, struct.pack("16si20x", b"link", 0))
        seen["queue"] = struct.unpack("16si20x", asked)[1]
        ipv6 = Path("/proc/sys/net/ipv6/conf/all/disable_ipv6")
        assert not ipv6.exists() or ipv6.read_text().strip() == "1"
        with server, socket.create_connection(server.getsockname()) as client:
            seen["client"] = client.getsockname()[0]
        assert os.environ["ROS_STATIC_PEERS"] == "127.0.0.1;127.0.0.2"
        assert os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] == "LOCALHOST"
        assert link.totals()["link"]["relay"]["packets"] > 0

    on_link("delay=1", use)
    assert seen["client"] == CLIENT
    assert seen["inside"] != home == str(Path("/proc/thread-self/ns/net").readlink())
    assert seen["queue"] == 10_000
    assert seen["server"] not in {seen["inside"], home}
    assert os.environ["ROS_STATIC_PEERS"] == "mine"
    assert "ROS_AUTOMATIC_DISCOVERY_RANGE" not in os.environ


HOLD = """
import sys
import s2a_bench as s2a
from s2a_bench.plugins.two_hosts.profiles import load_link
from s2a_bench.plugins.two_hosts.links import emulated
with emulated(load_link("delay=1")) as link:
    print(link._relay.pid, flush=True)
    sys.stdin.read()
"""


def test_nothing_is_left_after_a_kill() -> None:
    with subprocess.Popen(
        [sys.executable, "-c", HOLD], stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE
    ) as holder:
        line = holder.stdout.readline()
        if not line:
            pytest.skip(holder.stderr.read().decode()[-200:])
        relay = os.pidfd_open(int(line))
        holder.kill()
    assert select([relay], [], [], 60)[0]
    os.close(relay)


@pytest.mark.parametrize("transport", ["iceoryx2", "loopback"])
def test_a_transport_without_a_network_is_refused(transport: str) -> None:
    with pytest.raises(UsageError, match=f"{transport} sends nothing over a network"):
        RequestsConfig(link="4g", transports=transport, engine={"name": "echo"})


def test_a_server_that_runs_already_is_refused() -> None:
    with pytest.raises(UsageError, match="is not behind it; leave out `url`"):
        RequestsConfig(link="4g", url="http://localhost:1")


@pytest.mark.slow
def test_a_run_over_a_link_is_labelled_and_bounded(tmp_path: Path) -> None:
    link = "rate=40,delay=10"
    try:
        run = s2a.latency(
            output=tmp_path, transports="http/binary", link=link, engine="echo", quick=True, requests=3, warmup=1
        )
    except (NotPermitted, UsageError) as refused:
        pytest.skip(str(refused))
    (origin,) = (each for each in run._run.origins.every if each.known)
    assert (origin.link, origin.link_profile) == ("emulated", f"{link} (the user's)")
    assert "link EMULATED after rate=40,delay=10" in run._run.origins.line
    shown = run.table("summary").set_index("metric")
    assert shown.loc["bound_ms", "median"] == pytest.approx(640 * 480 * 3 * 8 / 40e3 + 20, rel=0.02)
    assert shown.loc["bound_ratio", "median"] >= 1
    assert run.manifest["link"]["relay"]["packets"] > 1000


@pytest.mark.slow
@pytest.mark.parametrize("link", ["mine.toml", "ride.csv", "delay=3"])
def test_a_run_over_every_form_of_link_is_shown_everywhere(
    link: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("mine.toml").write_text("up_mbps = 54\ndown_mbps = 54\ndelay_ms = 3\n")
    Path("ride.csv").write_text("t_s,up_mbps,down_mbps,delay_ms\n0,54,54,3\n1,40,40,4\n")
    small = "latency --engine echo --quick --size 64x48 --requests 2 --warmup 1 --max-tokens 2 --transport http/binary"
    arguments = [sys.executable, "-m", "s2a_bench", *small.split(), "--link", link, "--output", "runs", "--json"]
    done = subprocess.run(arguments, capture_output=True, text=True, check=False, timeout=120)
    if not Path("runs").exists() and "link" in done.stderr:
        pytest.skip(done.stderr)
    assert (done.returncode, json.loads(done.stdout)["command"]) == (0, "latency"), done.stderr
    (folder,) = Path("runs").iterdir()
    manifest = json.loads((folder / "manifest.json").read_text())
    assert manifest["link"]["profile"]["source"]
    older = Path(shutil.copytree(folder, "older"))
    manifest["link"]["profile"] = load_link(link).model_dump(exclude_defaults=True)
    (older / "manifest.json").write_text(json.dumps(manifest))
    probed = link != "ride.csv"  # nothing of a link that changes is probed
    assert (folder / "figures" / "link.png").exists() == probed
    assert (folder / "tables" / "summary.csv").exists()
    for run in (folder, older):
        called("report", run, "--output", "page.html", "--csv", "csv", "--latex", "tex", "--markdown", "all.md")
        assert ("Emulated link" in Path("page.html").read_text()) == probed
        assert ("link" in s2a.Run(run).figures()) == probed
    assert "e2e" in called("compare", folder, older).stdout
