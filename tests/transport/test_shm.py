"""The transport `shm` keeps the contract, and what its wire adds."""

from __future__ import annotations

from s2a_bench.testing.transport import TransportSuite


class TestShm(TransportSuite):
    name = "shm"


class TestShmYuyv(TransportSuite):
    name = "shm?payload=yuyv"


class TestShmJpeg(TransportSuite):
    name, lossless = "shm?payload=jpeg", False


class TestShmPng(TransportSuite):
    name = "shm?payload=png"
