"""Which of the paper's claims hold? `python -m benchmarks.claims`."""
