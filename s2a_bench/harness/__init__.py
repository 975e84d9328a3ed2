"""What is measured: sessions, interleaving, servers as processes, environment, guards."""

from __future__ import annotations

from typing import Any, Final

from s2a_bench.options import option

RECORD: Final[Any] = option(None, "also record frames, requests and tokens, as run.mcap (rosbag2)")
"""The option of a recording, where configurations with few imports find it."""
