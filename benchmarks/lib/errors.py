"""The errors that a command prints as a sentence."""


class UsageError(ValueError):
    """An option is invalid, as the message says; the exit status of the command is 2."""


class UnfinishedError(RuntimeError):
    """A command could not do all of its work; its exit status is 1."""


class NoBoundError(ValueError):
    """A scenario has no bound of a kind, such as a reference if the plant never settles."""
