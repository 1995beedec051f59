"""Provide the controllers to compare: the roster, and those that know a whole plant."""
