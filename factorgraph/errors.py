"""Errors a user can act on."""


class InputError(ValueError):
    """Wrong input: the message names the file, line or key, and says what would help.

    The command line prints it as one line and exits with status 2.
    """


def not_negative(owner: object, *names: str) -> None:
    """Raises InputError naming a field of `owner` that is negative or NaN."""
    for name in names:
        value = getattr(owner, name)
        if not value >= 0:
            raise InputError(f"{type(owner).__name__}.{name} must not be negative, got {value}")


def positive(owner: object, *names: str) -> None:
    """Raises InputError naming a field of `owner` that is not positive."""
    for name in names:
        value = getattr(owner, name)
        if not value > 0:
            raise InputError(f"{type(owner).__name__}.{name} must be positive, got {value}")
