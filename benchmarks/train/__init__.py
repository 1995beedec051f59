"""How are the learnt controllers trained? `python -m benchmarks.train`."""
