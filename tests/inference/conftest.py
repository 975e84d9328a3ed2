from collections.abc import Iterator
from pathlib import Path

import pytest

from s2a_bench.inference import EngineConfig
from s2a_bench.inference.models import resolve


@pytest.fixture(scope="session")
def cached(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("cache")


@pytest.fixture(scope="module", autouse=True)
def cache(cached: Path) -> Iterator[None]:
    """For a module: the next one of this process may be of another folder, which has a cache of its own."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("S2A_BENCH_CACHE", str(cached))
        yield


@pytest.fixture(scope="session")
def tiny(cached: Path) -> EngineConfig:
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("S2A_BENCH_CACHE", str(cached))
        model, mmproj = resolve(EngineConfig())
    return EngineConfig(model=model, mmproj=mmproj, threads=1)  # two would wait for each other on a busy machine


@pytest.fixture(scope="session")
def texts(tiny: EngineConfig, tmp_path_factory: pytest.TempPathFactory) -> EngineConfig:
    """The tiny dummy's language model alone, without a vision tower beside it."""
    model = tmp_path_factory.mktemp("texts") / "texts.gguf"
    model.symlink_to(tiny.model)
    return EngineConfig(model=model, threads=1)
