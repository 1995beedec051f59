"""The errors that commands turn into a sentence."""


class UsageError(ValueError):
    """An option that does not fit, named by the message: the exit status is 2."""


class UnfinishedError(RuntimeError):
    """A command could not do all of its work, or write a file: the exit status is 1."""


class NoBoundError(ValueError):
    """A kind of bound does not exist for a case, such as a reference that never settles."""
