"""The controllers that are compared: the roster, and those that know a whole plant."""
