"""Text from files, made safe for terminals."""

import warnings


def printable(text: str) -> str:
    """Write control characters, which a file may hold to change what a terminal shows, as escapes."""
    return "".join(each if each.isprintable() else repr(each)[1:-1] for each in text)


def warn(text: str, stacklevel: int = 1) -> None:
    """
    Warn with text that may come from a file.

    :param text: text of the warning
    :param stacklevel: number of frames above the warning's line, as in `warnings.warn`; 1 is the call of this function
    """
    warnings.warn(printable(text), stacklevel=stacklevel + 1)
