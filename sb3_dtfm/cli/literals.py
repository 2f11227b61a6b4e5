"""Arguments of the command line that are literals of Python."""

import argparse
from typing import Any

from sb3_dtfm.files import literal


def key_value(text: str) -> tuple[str, Any]:
    """
    An argument as RL-Zoo spells it, `key:value`, with a literal of Python as value.

    :raises argparse.ArgumentTypeError: another text
    """
    key, _, value = text.partition(":")
    try:
        return key, literal(value)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is no key:value with a number, 'text', list, ... of Python") from None
