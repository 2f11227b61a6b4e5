"""Arguments that a user gives, checked by name: one way to say what is accepted, one message for what is not."""

import dataclasses
import difflib
import inspect
import itertools
import math
import numbers
import re
import unicodedata
from collections.abc import Container, Iterable, Mapping
from typing import Any, NamedTuple, Protocol, TypeVar

import numpy as np


class Number(NamedTuple):
    """
    A number in a range.

    :param low: smallest value
    :param high: largest value
    :param whole: whether only whole numbers are accepted
    :param above_low: whether `low` itself is refused
    :param below_high: whether `high` itself is refused
    :param optional: whether None is accepted, too
    """

    low: float = -math.inf
    high: float = math.inf
    whole: bool = False
    above_low: bool = False
    below_high: bool = False
    optional: bool = False

    def accepts(self, value: Any) -> bool:
        """Return whether a value is such a number; True and False, NaN and infinity are none."""
        if value is None:
            return self.optional
        kind = numbers.Integral if self.whole else numbers.Real
        if type(value) is bool or not isinstance(value, kind):
            return False
        try:
            number = float(value)
        except OverflowError:  # 10**400
            return False
        if not math.isfinite(number) or (self.whole and math.isinf(self.high) and number >= 2**63):  # 64 bits hold less
            return False
        at_least = number > self.low if self.above_low else number >= self.low
        return at_least and (number < self.high if self.below_high else number <= self.high)

    def __str__(self) -> str:
        kind = "whole number" if self.whole else "number"
        low, high = (f"{limit:.0f}" if self.whole else f"{limit:g}" for limit in (self.low, self.high))
        if math.isinf(self.high):
            limits = "" if math.isinf(self.low) else f" {'above' if self.above_low else 'of at least'} {low}"
            text = f"a {'' if limits else 'finite '}{kind}{limits}"
        else:
            left, right = "(" if self.above_low else "[", ")" if self.below_high else "]"
            text = f"a {kind} in {left}{low}, {high}{right}"
        return f"{text}, or None" if self.optional else text


class Choice(NamedTuple):
    """One of some values, of the same type."""

    values: tuple[Any, ...]

    def accepts(self, value: Any) -> bool:
        """Return whether a value is one of them; 1 is not True."""
        return any(type(value) is type(one) and value == one for one in self.values)

    def __str__(self) -> str:
        return f"one of {', '.join(map(str, self.values))}"


class Rule(Protocol):
    """The accepted values of an argument, as a message says them."""

    def accepts(self, value: Any) -> bool:
        """Return whether a value is one of them."""
        ...


class Listed(NamedTuple):
    """
    A list of numbers, or of lists of them.

    :param rule: rule for each number
    :param length: length of the list, None for any
    :param nested: whether an entry may be such a list of any length
    """

    rule: Rule
    length: int | None = None
    nested: bool = False

    def accepts(self, value: Any) -> bool:
        """Return whether a value is such a list, or None."""
        if value is None:
            return True
        if not isinstance(value, list) or self.length not in (None, len(value)):
            return False
        entries = (each if self.nested and isinstance(each, list) else [each] for each in value)
        return all(map(self.rule.accepts, itertools.chain.from_iterable(entries)))

    def __str__(self) -> str:
        lists = " or a list of such" if self.nested else ""
        return f"a list of {self.length or 'any number of'} entries, each {self.rule}{lists}, or None"


class Text:
    """Text without control characters."""

    def accepts(self, value: Any) -> bool:
        """Return whether a value is such a text, or None."""
        return value is None or (isinstance(value, str) and not any(unicodedata.category(each)[0] == "C" for each in value))

    def __str__(self) -> str:
        return "text without control characters, or None"


BOOLEAN = Choice((True, False))
COUNT = Number(low=1, whole=True)
POSITIVE = Number(low=0, above_low=True)
NOT_NEGATIVE = Number(low=0)
PROBABILITY_BELOW_1 = Number(low=0, high=1, below_high=True)


def check_arguments(given: Mapping[str, Any], accepted: Mapping[str, Rule]) -> dict[str, Any]:
    """
    :param given: values by name; others than `accepted` are left alone
    :param accepted: rule for each argument, by name
    :return: values of these arguments by name, NumPy's scalars as Python's, which every file format can hold
    :raises ValueError: names the argument, what was given and what is accepted
    """
    values = {name: given[name].item() if isinstance(given[name], np.generic) else given[name] for name in accepted}
    for name, rule in accepted.items():
        if not rule.accepts(values[name]):
            raise ValueError(f"{name} must be {rule}, got {given[name]!r}.")
    return values


def whole_timesteps(total_timesteps: Any, reset_num_timesteps: bool) -> int:
    """
    :param total_timesteps: value of this argument of `learn`; 1e5 is whole, too
    :param reset_num_timesteps: whether they count from zero; else what is left of them may be below 0
    :raises ValueError: no such number
    """
    whole = int(total_timesteps) if isinstance(total_timesteps, float) and total_timesteps.is_integer() else total_timesteps
    check_arguments(
        {"total_timesteps": whole}, {"total_timesteps": Number(low=0 if reset_num_timesteps else -math.inf, whole=True)}
    )
    return int(whole)


def option(default: Any, rule: Rule, acting: bool = False) -> Any:
    """
    A field of :class:`Options`.

    :param default: value where none is given
    :param rule: the accepted values
    :param acting: whether it may change after training
    """
    return dataclasses.field(default=default, metadata={"rule": rule, "acting": acting})


@dataclasses.dataclass(frozen=True)
class Options:
    """
    Arguments as one value, checked when it is made; subclasses make their fields by :func:`option`.

    :raises ValueError: names the argument, what was given and what is accepted
    """

    def __post_init__(self) -> None:
        rules = {each.name: each.metadata["rule"] for each in dataclasses.fields(self)}
        vars(self).update(check_arguments(vars(self), rules))

    @classmethod
    def of(cls: "type[SelfOptions]", given: Mapping[str, Any]) -> "SelfOptions":
        """
        Options of these names, and defaults of the others.

        :param given: values by name, also of other arguments
        """
        return cls(**{name: given[name] for name in cls.defaults() if name in given})

    @classmethod
    def defaults(cls) -> dict[str, Any]:
        """All names with their defaults."""
        return {each.name: each.default for each in dataclasses.fields(cls)}

    def acting(self) -> dict[str, Any]:
        """The values that may change after training."""
        return {each.name: getattr(self, each.name) for each in dataclasses.fields(self) if each.metadata["acting"]}

    def changed(self: "SelfOptions", **values: Any) -> "SelfOptions":
        """A copy with other values, checked."""
        return dataclasses.replace(self, **values)


SelfOptions = TypeVar("SelfOptions", bound=Options)


def with_nearest(names: Iterable[str], known: Iterable[str]) -> str:
    """
    Unknown names, for a message, each with the known one that may be meant.

    :param names: unknown names as the user spelled them
    :param known: names that are accepted
    :return: list such as "bach_size (did you mean batch_size?)"
    """
    known = list(known)
    nearest = {name: difflib.get_close_matches(name, known, n=1) for name in names}
    return ", ".join(name + (f" (did you mean {found[0]}?)" if found else "") for name, found in nearest.items())


def documented_parameters(*described: type, order: Iterable[str] = (), decided: Container[str] = ()) -> str:
    """
    The `:param` entries of classes' docstrings, those of :class:`Options` with their defaults and ranges.

    :param described: the classes
    :param order: names of the parameters that come first, in this order; others follow
    :param decided: names of options that the data decide by default
    """
    found: dict[str, str] = {}
    for each in described:
        defaults = each.defaults() if issubclass(each, Options) else {}
        rules = {field.name: field.metadata["rule"] for field in dataclasses.fields(each)} if defaults else {}
        text = inspect.cleandoc(each.__doc__ or "")
        for name, entry in re.findall(r"^:param (\w+):(.*?)(?=^:|\Z)", text, re.DOTALL | re.MULTILINE):
            default = "decided from the data" if name in decided else repr(defaults.get(name))
            limits = f"; {rules[name]}" if isinstance(rules.get(name), Number) else ""
            found[name] = entry.rstrip() + (f" (default: {default}{limits})" if name in defaults else "")
    names = [*(name for name in order if name in found), *found]
    return "\n".join(f":param {name}:{found[name]}" for name in dict.fromkeys(names))
