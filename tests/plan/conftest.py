import pytest
from gguf import GGUFWriter

from s2a_bench.inference import EngineConfig
from s2a_bench.inference.dummy.vocab import make_vocab
from s2a_bench.inference.tokenizer import Tokenizer
from s2a_bench.plan import Format, SkillSet, Tokenize, choose_format, load_skills, paper_format
from tests.inference.conftest import cached, tiny  # noqa: F401 - fixtures

GRANULARITIES = (6, 4, 2, 1)
"""Tokens a skill in the paper (section IV-E)."""


@pytest.fixture(scope="session")
def of_bytes(tiny: EngineConfig) -> Tokenizer:  # noqa: F811
    return Tokenizer(tiny.model)


@pytest.fixture(scope="session")
def of_words(tmp_path_factory: pytest.TempPathFactory) -> Tokenizer:
    """Qwen2's kind and number of tokens, with merges of the full dummy: pairs, triples, fours of letters."""
    path = tmp_path_factory.mktemp("vocabulary") / "words.gguf"
    vocab = make_vocab(full=True)
    writer = GGUFWriter(path, "qwen2")
    writer.add_tokenizer_model("gpt2")
    writer.add_tokenizer_pre("qwen2")
    writer.add_token_list(vocab.tokens)
    writer.add_token_types(vocab.types)
    writer.add_token_merges(vocab.merges)
    writer.write_header_to_file()
    writer.write_kv_data_to_file()
    writer.write_tensors_to_file()
    writer.close()
    return Tokenizer(path)


@pytest.fixture(scope="session", params=["household", "driving"])
def skills(request: pytest.FixtureRequest) -> SkillSet:
    return load_skills(request.param)


@pytest.fixture(scope="session", params=["of_bytes", "of_words"])
def tokenize(request: pytest.FixtureRequest) -> Tokenize:
    tokenizer: Tokenizer = request.getfixturevalue(request.param)
    return tokenizer


@pytest.fixture(scope="session", params=["paper", *GRANULARITIES])
def format_(request: pytest.FixtureRequest, skills: SkillSet, tokenize: Tokenize) -> Format:
    if request.param == "paper":
        return paper_format(skills)
    return choose_format(skills, request.param, tokenize)
