from collections.abc import Iterator

import pytest

from s2a_bench.inference import EngineConfig
from s2a_bench.inference.models import resolve


@pytest.fixture(scope="session", autouse=True)
def cache(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("S2A_BENCH_CACHE", str(tmp_path_factory.mktemp("cache")))
        yield


@pytest.fixture(scope="session")
def tiny(cache: None) -> EngineConfig:  # noqa: ARG001 the files lie there
    model, mmproj = resolve(EngineConfig())
    return EngineConfig(model=model, mmproj=mmproj, threads=1)  # two would wait for each other on a busy machine
