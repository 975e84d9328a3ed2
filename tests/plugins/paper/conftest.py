"""Runs as those that the page's tests have, and what makes them."""

from tests.plugins.paper.test_claim_cases import kit
from tests.report.conftest import beside, spoken

__all__ = ["beside", "kit", "spoken"]
