import pytest

from s2a_bench.errors import RequestFailed, S2AError, StoreError, UsageError


@pytest.mark.parametrize("kind", [S2AError, StoreError, UsageError, RequestFailed])
def test_text_from_outside_forges_no_line_and_moves_no_cursor(kind: type[S2AError]) -> None:
    message = str(kind("`source`: a\nerror: b\r\x1b[2J\x07\u2028\ud800 é漢 is none"))
    assert message == r"`source`: a\nerror: b\u000d\u001b[2J\u0007\u2028\ud800 é漢 is none"
