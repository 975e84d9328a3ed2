from signal import SIGILL

import pytest

from s2a_bench.errors import COMPILE_AGAIN, RequestFailed, S2AError, StoreError, UsageError, how_it_ended


@pytest.mark.parametrize("kind", [S2AError, StoreError, UsageError, RequestFailed])
def test_text_from_outside_forges_no_line_and_moves_no_cursor(kind: type[S2AError]) -> None:
    message = str(kind("`source`: a\nerror: b\r\x1b[2J\x07\u2028\ud800 é漢 is none"))
    assert message == r"`source`: a\nerror: b\u000d\u001b[2J\u0007\u2028\ud800 é漢 is none"


def test_an_illegal_instruction_says_where_it_comes_from_and_the_way_out() -> None:
    assert how_it_ended(-SIGILL) == (
        "killed by signal 4 (SIGILL): llama.cpp was compiled for another processor, or by a compiler whose code for "
        "AMX does not work; run `make setup` again"
    )
    assert how_it_ended(-SIGILL, COMPILE_AGAIN).endswith("; compile it on this machine")
