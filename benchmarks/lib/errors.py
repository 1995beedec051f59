"""Define the exceptions whose messages a command prints, without a traceback."""


class UsageError(ValueError):
    """An option of a command is invalid.

    The message tells the user which option is invalid and why. A command that raises a
    `UsageError` ends with exit status 2.
    """


class UnfinishedError(RuntimeError):
    """A command could not do all of its work.

    The message tells the user what is missing. A command that raises an `UnfinishedError` ends
    with exit status 1.
    """


class NoBoundError(ValueError):
    """A scenario has no lower bound on the error, or no bound of the kind that was asked for.

    For example, the bound of the kind "reference" exists only if the plant settles before each
    change of the set point.
    """
