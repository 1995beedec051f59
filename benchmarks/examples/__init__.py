"""Hold scripts to copy, which train policies."""
