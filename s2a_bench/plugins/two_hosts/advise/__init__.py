"""Advice on a transport for a link."""
