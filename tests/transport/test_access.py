"""Who is let in by the headers of a request."""

from __future__ import annotations

import pytest

from s2a_bench.transport.access import Access, WebOptions

HERE, ANY = "127.0.0.1", "0.0.0.0"  # noqa: S104


def refused(
    *headers: tuple[str, str], host: str = HERE, key: str = "", path_is_open: bool = False, names: str = ""
) -> int:
    refusal = Access(WebOptions(allow_host=names), host, key, "Bearer").refusal(path_is_open, headers)
    return refusal[0] if refusal else 0


@pytest.mark.parametrize(
    "host", ["localhost", "LocalHost:8080", "127.0.0.1", "127.1.2.3:80", "[::1]", "[::1]:8080", "", ":80"]
)
def test_names_of_this_machine_pass_on_loopback(host: str) -> None:
    assert refused(("host", host)) == 0


@pytest.mark.parametrize(
    "host",
    ["example.com", "127.0.0.1.example.com", "localhost.example.com:80", "192.0.2.1", "[2001:db8::1]", ANY],
)
def test_other_names_are_refused_on_loopback_alone(host: str) -> None:
    assert refused(("host", host)) == 403
    assert refused(("host", "localhost"), ("host", host)) == 403
    assert refused(("host", host), path_is_open=True) == 403
    assert refused(("host", host), host=ANY) == 0


def test_a_proxys_name_is_allowed() -> None:
    names = "robot.example.com, Lab.example.com"
    assert refused(("host", "robot.example.com:443"), names=names) == 0
    assert refused(("host", "lab.example.com"), names=names) == 0
    assert refused(("host", "example.com"), names=names) == 403


@pytest.mark.parametrize("host", [HERE, ANY])
@pytest.mark.parametrize("origin", ["http://localhost", "null", ""])
def test_a_page_in_a_browser_is_refused(host: str, origin: str) -> None:
    assert refused(("origin", origin), ("authorization", "Bearer k"), host=host, key="k") == 403
    assert refused(("origin", origin), host=host, path_is_open=True) == 403


def test_the_key_is_asked_for_once() -> None:
    key = ("authorization", "Bearer k")
    assert refused(key, key="k") == 0
    assert refused(key) == 0
    assert refused(key="k", path_is_open=True) == 0
    for wrong in [(), (key, key), (("authorization", "Bearer \udce9"),), (("authorization", "Basic k"),)]:
        assert refused(*wrong, key="k") == 401
