"""This machine measured as a hardware profile."""
