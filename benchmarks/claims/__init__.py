"""Test the paper's claims, each on many runs."""
