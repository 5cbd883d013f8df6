"""The one exception that a user's mistake may raise: its text is all they see."""


class InputError(ValueError):
    """Bad input. The message is one sentence: the file or argument, what was expected, what was found, what to do."""
