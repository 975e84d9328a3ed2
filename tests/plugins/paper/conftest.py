"""Runs as those that the page's tests have."""

from tests.report.conftest import beside, spoken

__all__ = ["beside", "spoken"]
