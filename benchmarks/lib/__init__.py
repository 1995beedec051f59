"""Shared infrastructure of the commands."""
