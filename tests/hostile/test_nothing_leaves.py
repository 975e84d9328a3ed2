"""Nothing leaves the machine unasked: sockets are on loopback, and a file that names another host is not trusted."""

from __future__ import annotations

import ipaddress
from pathlib import Path

import pytest

from s2a_bench.boards.profile import read_profile
from s2a_bench.cli.serve import served_options
from s2a_bench.errors import UsageError
from s2a_bench.options import extra_of
from s2a_bench.transport import TRANSPORTS
from tests.cli.program import called, refused
from tests.hostile.conftest import KilledRun

ROOT = Path(__file__).parents[2]


def is_local(address: str) -> bool:
    """Return True for loopback, and for paths and descriptors of this machine."""
    if address in {"localhost", "None", ""} or address.startswith(("/", "b'", "\\0")) or address.isdigit():
        return True
    try:
        return ipaddress.ip_address(address).is_loopback
    except ValueError:
        return False


def test_a_run_names_no_other_host_and_its_sockets_are_on_loopback(killed_run: KilledRun) -> None:
    assert [address for address in killed_run.calls if not is_local(address)] == []
    assert len(killed_run.sockets) > 5
    for kind, own, other in killed_run.sockets:
        loopback = own.startswith("0100007F:")
        listens_to_datagrams = kind == "udp" and own.startswith("00000000:")  # Cyclone's, which sends from loopback
        assert loopback or listens_to_datagrams, (kind, own, other)
        assert other.startswith(("0100007F:", "00000000:")), (kind, own, other)


REPLAY = 'engine = "replay"\nprofile = "rtx-4080"\npolicy = "naive"'
AWAY = "--url sends requests off this machine"
RISKY = [
    ("throughput", 'reference = "{file}"', "--reference runs a program"),
    ("latency", 'transport = "http"\nllama-server = "{file}"', "--llama-server runs a program"),
    ("latency", 'transport = "http/llama-server?llama_server={file}"', "--llama-server runs a program"),
    ("latency", 'transport = "http/llama-server?llama-server={file}"', "--llama-server runs a program"),
    ("chunks", 'live = true\nengine = "echo"\nrobot = "call?function=os:abort"', "--robot runs a program"),
    ("timeline", f'live = true\n{REPLAY}\nrobot = "call?function=os:abort"', "--robot runs a program"),
    ("latency", 'url = "http://127.0.0.1:9"\napi-key-env = "SECRET"', "--api-key-env sends a key"),
    ("latency", 'transport = "http?url=http://127.0.0.1:9&api_key_env=SECRET"', "--api-key-env sends a key"),
    ("latency", 'transport = "http?url=http://127.0.0.1:9"\napi-key-env = "SECRET"', "--api-key-env sends a key"),
    ("chunks", 'live = true\nurl = "ws://127.0.0.1:9"\napi-key-env = "SECRET"', "--api-key-env sends a key"),
    ("latency", 'url = "http://192.0.2.1:9"\nprompt = "@/sys/devices/pci0000:00/../../../../etc/hostname"', AWAY),
    ("latency", 'transport = "http?url=http://localhost.example:9&extra_body=@{file}.json"', AWAY),
    ("timeline", 'live = true\nurl = "http://192.0.2.1:9"\ntask = "@{file}"', AWAY),
    ("ccrb", 'live = true\ntransport = "http?url=http://192.0.2.1:9"', AWAY),
    (
        "latency",
        'transport = "ros"\nmiddleware = "zenoh"\nrouter = "tcp/192.0.2.1:7447"',
        "--router sends requests off",
    ),
]


@pytest.mark.parametrize(("command", "settings", "message"), RISKY)
def test_a_file_that_runs_programs_or_sends_secrets_is_refused_unless_it_is_trusted(
    command: str, settings: str, message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SECRET", "sesame-open-the-door")
    program, ran = tmp_path / "program", tmp_path / "ran"
    program.write_text(f"#!/bin/sh\ntouch {ran}\n")
    program.chmod(0o755)
    (tmp_path / "program.json").write_text("{}")
    file = tmp_path / "sent.toml"
    file.write_text(f'command = "{command}"\n[settings]\n{settings.format(file=program)}\n')
    line = refused("sweep", file, "--output", tmp_path / "results")
    assert message in line
    assert line.endswith("read the file, and allow it with --trust-file")
    assert "sesame" not in line
    assert not ran.exists()
    assert not (tmp_path / "results").exists()
    assert called("sweep", file, "--trust-file", "--dry-run").stdout


def test_a_url_on_loopback_and_a_key_of_our_own_servers_need_no_trust(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SECRET", "sesame-open-the-door")
    file = tmp_path / "plain.toml"
    for settings in (
        'url = "http://127.0.0.1:9"\nprompt = "' + "go on " * 99 + '"',
        'transport = "http"\napi-key-env = "SECRET"',
    ):
        file.write_text(f'command = "latency"\n[settings]\n{settings}\n')
        called("sweep", file, "--dry-run")


def test_no_other_file_can_name_a_program_or_a_server(tmp_path: Path) -> None:
    for _, transport in TRANSPORTS.loaded():  # the keys of serve --config
        for name in served_options(transport):
            assert extra_of(transport.options.model_fields[name])["risk"] != "program"
            assert name != "url"
    profile = tmp_path / "board.toml"
    profile.write_text('reference = "/bin/true"\n' + (ROOT / "profiles" / "rtx-4080.toml").read_text())
    with pytest.raises(UsageError, match="reference: there is no such key"):
        read_profile(profile)
