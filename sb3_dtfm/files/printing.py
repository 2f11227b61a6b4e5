"""Text from files, made safe for terminals."""


def printable(text: str) -> str:
    """Write control characters, which a file may hold to change what a terminal shows, as escapes."""
    return "".join(each if each.isprintable() else repr(each)[1:-1] for each in text)
