"""Hold what all commands share: the command line, parallel tasks, reports, statistics."""
