from signal import SIGILL

from s2a_bench.errors import COMPILE_AGAIN, how_it_ended


def test_an_illegal_instruction_says_where_it_comes_from_and_the_way_out() -> None:
    assert how_it_ended(-SIGILL) == (
        "killed by signal 4 (SIGILL): llama.cpp was compiled for another processor, or by a compiler whose code for "
        "AMX does not work; run `make setup` again"
    )
    assert how_it_ended(-SIGILL, COMPILE_AGAIN).endswith("; compile it on this machine")
