"""Attributes of several values that a model's file holds, and what saving and loading accept of them alike."""

from collections.abc import Mapping
from typing import Any

from sb3_dtfm.arguments import COUNT, Choice, Listed, Number, Rule, Text, check_arguments
from sb3_dtfm.data.readers import check_options
from sb3_dtfm.envs.robosuite import arm_motion

STRUCTURED = ("policy_kwargs", "dataset_kwargs", "score_reference", "return_reference", "controller", "online_actor")
# Options of `dataset_kwargs` that a file may hold; the loading user says where a cache lies and whether a pickle may run.
DATASET_OPTIONS = (
    *("env_id", "max_episode_steps", "min_return", "best_share", "success_only", "fraction", "fraction_seed", "on_invalid"),
    *("observation_keys", "action_keys", "action_bounds", "clip_actions", "filter_key", "episodes", "image_size"),
)
# Rules for those that `load_dataset` leaves to single readers.
READER_OPTIONS: dict[str, Rule] = {
    "env_id": Text(),
    "filter_key": Text(),
    "on_invalid": Choice(("raise", "drop")),
    "episodes": Listed(Number(low=0, high=2**63, whole=True)),
    "image_size": Listed(COUNT, 2),
    "action_bounds": Listed(Number(), 2, nested=True),
}


def check_structured(name: str, value: Any) -> None:
    """
    Check an attribute of :data:`STRUCTURED` as a file holds it.

    :param name: name of the attribute
    :param value: plain values
    :raises ValueError: names the attribute, what was found and what is accepted
    """
    if name == "dataset_kwargs":
        check_dataset_kwargs(value)
    if name == "controller":
        check_controller_settings(value)
    check_text(value, name)


def check_dataset_kwargs(given: Any) -> None:
    """
    Check options as a file holds them.

    :param given: options by name, or None
    :raises ValueError: names the option, what was found and what is accepted
    """
    if given is None:
        return
    if not isinstance(given, dict):
        raise ValueError(f"dataset_kwargs are {given!r:.40}, expected arguments by name, or None.")
    for name in sorted(given.keys() - set(DATASET_OPTIONS)):
        raise ValueError(f"dataset_kwargs: {name!r:.40} is no option in a file; accepted: {', '.join(DATASET_OPTIONS)}.")
    try:
        check_options(given)
        check_arguments(given, {name: rule for name, rule in READER_OPTIONS.items() if name in given})
    except ValueError as error:
        raise ValueError(f"dataset_kwargs: {error}") from error


def check_controller_settings(given: Any) -> None:
    """
    Check a controller as a file holds it.

    :param given: settings of the controller, see :func:`~sb3_dtfm.envs.robosuite.arm_motion`, or None
    :raises ValueError: names the setting, what was found and what is accepted
    """
    if given is None:
        return
    if not isinstance(given, dict):
        raise ValueError(f"controller is {given!r:.40}, expected settings by robosuite's names, or None.")
    names = arm_motion({}).keys()
    for name in sorted(given.keys() - names):
        raise ValueError(f"controller: {name!r:.40} is no setting; accepted: {', '.join(names)}.")
    for name, value in given.items():
        entries = value if isinstance(value, list) else [value]
        if not all(each is None or isinstance(each, str | bool) or Number().accepts(each) for each in entries):
            raise ValueError(f"controller: {name} is {value!r:.40}, expected a number, text, or a list of such.")


def check_text(value: Any, name: str) -> None:
    """
    Refuse control characters, wherever they are, which would change what a terminal shows.

    :param value: dictionaries, lists and plain values
    :param name: name of the value in the message
    :raises ValueError: text with such characters
    """
    if isinstance(value, Mapping):
        check_text(list(value.items()), name)
    elif isinstance(value, list | tuple):
        for each in value:
            check_text(each, name)
    elif isinstance(value, str) and not Text().accepts(value):
        raise ValueError(f"{name} holds {value!r:.40}; {Text()} is expected.")
