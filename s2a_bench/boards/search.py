"""Where hardware profiles are found: a path, ./profiles, the user's folder, those that come with the package."""

from __future__ import annotations

import os
from pathlib import Path

from s2a_bench.boards.file import read_profile
from s2a_bench.boards.profile import Profile
from s2a_bench.errors import UsageError

SHIPPED = Path(__file__).parent.parent / "profiles"
"""A link to profiles/ at the top of the repository; files in an installed package."""


def search_path() -> list[Path]:
    """Return the folders that are searched for a name, the first first."""
    config = Path(os.environ.get("XDG_CONFIG_HOME") or Path.home() / ".config")
    return [Path("profiles"), config / "s2a-bench" / "profiles", SHIPPED]


def profile_files() -> dict[str, Path]:
    """Return the file of every name that can be given, sorted by name; a name found twice is the first folder's."""
    found: dict[str, Path] = {}
    for folder in search_path():
        for path in sorted(folder.glob("*.toml")):
            found.setdefault(path.stem, path)
    return dict(sorted(found.items()))


def profiles() -> list[Profile]:
    """Read every profile that can be given by name; raises UsageError for one that is wrong."""
    return [read_profile(path) for path in profile_files().values()]


def find_profile(name: str) -> Path:
    """Return the file of a profile, given by name or as a path; raises UsageError naming what there is."""
    if "/" in name or name.endswith(".toml"):
        if not Path(name).is_file():
            raise UsageError(f"`profile`: there is no file {name}")
        return Path(name)
    files = profile_files()
    if name not in files:
        where = ", ".join(map(str, search_path()))
        raise UsageError(f"`profile`: '{name}' is none of {', '.join(files)} (looked in {where}), and no path")
    return files[name]


def load_profile(name: str) -> Profile:
    """Read a profile, given by name or as a path (with a slash, or ending in .toml)."""
    return read_profile(find_profile(name))
