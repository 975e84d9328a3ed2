from signal import SIGILL, SIGKILL

from s2a_bench.errors import COMPILE_AGAIN, how_it_ended


def test_an_exit_code_is_told_as_it_is() -> None:
    assert how_it_ended(3) == "exit code 3"
    assert how_it_ended(None) == "exit code None"


def test_a_signal_is_told_by_its_number() -> None:
    assert how_it_ended(-SIGKILL) == "killed by signal 9"


def test_an_illegal_instruction_says_where_it_comes_from_and_the_way_out() -> None:
    assert how_it_ended(-SIGILL) == (
        "killed by signal 4 (SIGILL): llama.cpp was compiled for another processor, or by a compiler whose code for "
        "AMX does not work; run `make setup` again"
    )
    assert how_it_ended(-SIGILL, COMPILE_AGAIN).endswith("; compile it on this machine")
