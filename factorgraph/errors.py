"""Errors a user can act on."""


class InputError(ValueError):
    """Wrong input: the message names the file, line or key, and says what would help.

    The command line prints it as one line and exits with status 2.
    """
