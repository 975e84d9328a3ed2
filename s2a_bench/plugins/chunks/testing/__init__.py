"""The test suite for packages that add a mode of acting on chunks: `mode.ModeSuite`."""

import pytest

pytest.register_assert_rewrite(f"{__name__}.mode")
