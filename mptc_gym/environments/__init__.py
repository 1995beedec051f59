"""Record and draw environments.

- `record` stores the latest samples of an episode, and `drawing` draws a picture of a record.
"""
