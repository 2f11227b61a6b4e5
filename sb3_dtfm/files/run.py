"""The environment of an RL-Zoo run's training, read as data."""

import ast
import contextlib
import functools
import importlib
import re
import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

# Settings may name classes of these packages and of modules that are imported already.
PACKAGES = ("gymnasium", "gymnasium_robotics", "rl_zoo3", "sb3_contrib", "sb3_dtfm", "stable_baselines3")
# Settings that name classes, which RL-Zoo imports and calls, with what those have to be.
CLASSES = {
    "env_wrapper": "gymnasium.Wrapper",
    "vec_env_wrapper": "stable_baselines3.common.vec_env.VecEnvWrapper",
    "callback": "stable_baselines3.common.callbacks.BaseCallback",
    "policy": "stable_baselines3.common.policies.BasePolicy",
}
# Settings that RL-Zoo evaluates as Python where they are strings.
EVALUATED = ("normalize", "policy_kwargs", "replay_buffer_class", "replay_buffer_kwargs", "monitor_kwargs")
# Those of both that matter to whoever acts with a model.
OF_ACTING = ("env_wrapper", "vec_env_wrapper", "normalize")
ENV_KWARGS = ("env_kwargs", "eval_env_kwargs")


def read_run(run: Path) -> dict[str, Any]:
    """
    A run's hyperparameters; its `env_kwargs` are those of the command line, before those of the YAML file, and its
    `eval_env_kwargs` those of its evaluations.

    :param run: the folder that holds config.yml and args.yml
    :raises ImportError: PyYAML is needed and not installed
    :raises ValueError: a file that is no YAML, or names what is not imported
    """
    try:
        hyperparams, given = (_read(run / name) for name in ("config.yml", "args.yml"))
    except ImportError as error:
        raise ImportError(f'{run} is an RL-Zoo run; to read it: pip install "sb3-dtfm[zoo]" ({error})') from error
    env_kwargs = given.get("env_kwargs") or hyperparams.get("env_kwargs") or {}
    eval_env_kwargs = given.get("eval_env_kwargs") or env_kwargs
    return {"normalize": False, **hyperparams, "env_kwargs": env_kwargs, "eval_env_kwargs": eval_env_kwargs}


def _read(path: Path) -> dict[str, Any]:
    import yaml

    if not path.is_file():
        return {}
    with path.open("rb") as file:
        return yaml.load(file, Loader=settings_loader())


@functools.cache
def settings_loader() -> Any:
    """
    PyYAML's safe loader, which also knows the types that RL-Zoo writes, and checks the settings in a file.

    OrderedDicts become dicts; a class or a function becomes its dotted name.
    """
    import yaml

    @contextlib.contextmanager
    def reading(name: str) -> Iterator[None]:
        try:
            yield
        except (yaml.YAMLError, ValueError, TypeError, RecursionError) as error:
            reason = " ".join(str(error).split())
            raise ValueError(f"{name}: expected a run's settings as YAML, found {reason}.") from error

    class SettingsLoader(yaml.SafeLoader):
        def __init__(self, stream: Any) -> None:
            with reading(stream.name):
                super().__init__(stream)

        def get_single_data(self) -> dict[str, Any]:
            with reading(self.name):
                data = super().get_single_data() or {}
            if not isinstance(data, dict):
                raise ValueError(f"{self.name}: expected a mapping of settings, found a {type(data).__name__}.")
            return check_settings(data, self.name, OF_ACTING)

    def sequence(loader: Any, node: Any) -> list[Any]:
        return loader.construct_sequence(node, deep=True)

    tag = "tag:yaml.org,2002:python/"
    SettingsLoader.add_constructor(f"{tag}tuple", lambda loader, node: tuple(sequence(loader, node)))
    ordered = f"{tag}object/apply:collections.OrderedDict"
    SettingsLoader.add_constructor(ordered, lambda loader, node: dict(*sequence(loader, node)))
    SettingsLoader.add_multi_constructor(f"{tag}name:", lambda loader, name, node: name)
    return SettingsLoader


def check_settings(settings: Mapping[str, Any], where: str, names: Sequence[str]) -> dict[str, Any]:
    """
    Settings that a file says, of which RL-Zoo runs nothing that others wrote.

    :param settings: settings by name
    :param where: name of the file that they stand in, for messages
    :param names: names in `CLASSES` and `EVALUATED` of the settings that are used
    :return: the settings, with literals instead of the strings that RL-Zoo would evaluate
    :raises ValueError: a class that is not known here, or Python that is no literal
    """
    checked = _checked(settings, where, names)
    for name in (name for name in names if name in CLASSES):
        for each in _listed(checked.get(name)):
            found = _check_class(each, name, where)
            # Ours may make environments of its arguments.
            if found is not None and found.__module__.startswith("sb3_dtfm."):
                _check_nested(each, f"{where}: {name}", set())
    return checked


def _checked(settings: Mapping[str, Any], where: str, names: Sequence[str]) -> dict[str, Any]:
    """As :func:`check_settings`, without the arguments of classes."""
    settings = dict(settings)
    for name in (name for name in names if settings.get(name) is not None):
        if name in CLASSES:
            for each in _listed(settings[name]):
                _check_class(each, name, where)
        elif isinstance(settings[name], str):
            try:
                settings[name] = literal(settings[name])
            except ValueError as error:
                raise ValueError(f"{where}: {name}: {error}") from error
    for name in ENV_KWARGS:
        kwargs = settings.get(name) or {}
        if not isinstance(kwargs, dict) or not all(isinstance(key, str) and key.isidentifier() for key in kwargs):
            raise ValueError(f"{where}: {name} must map names of arguments to values, found {kwargs!r}.")
    dataset_kwargs = settings.get("dataset_kwargs") or {}
    if not isinstance(dataset_kwargs, dict):
        raise ValueError(f"{where}: dataset_kwargs must map names of arguments to values, found {dataset_kwargs!r}.")
    if "allow_pickle" in dataset_kwargs:
        raise ValueError(f"{where}: dataset_kwargs: allow_pickle is given on the command line or not at all.")
    return settings


def _listed(value: Any) -> list[Any]:
    return value if isinstance(value, list) else [] if value is None else [value]


def _check_nested(value: Any, where: str, seen: set[int]) -> None:
    """
    Check settings among a class's arguments, as the benchmark's evaluations have them.

    :param seen: ids of values that have been checked, since YAML may refer to one again
    """
    if id(value) in seen or not isinstance(value, dict | list | tuple):
        return
    seen.add(id(value))
    if isinstance(value, dict):
        _checked(value, where, OF_ACTING)
        task = value.get("env_id", value.get("task"))
        if isinstance(task, str) and re.fullmatch(r"[\w.]+:\S+", task):  # whose module Gymnasium would import
            raise ValueError(f"{where}: expected the id of a registered task, found {task!r}.")
    for each in value.values() if isinstance(value, dict) else value:
        _check_nested(each, where, seen)


def _check_class(each: Any, name: str, where: str) -> type | None:
    """Return a class that is named, alone or with its arguments; None for the alias of a policy."""
    named: Any = next(iter(each), None) if isinstance(each, dict) else each
    module = named.rpartition(".")[0] if isinstance(named, str) else ""
    if name == "policy" and not module:
        return None  # an alias, as "MlpPolicy"
    if not module:
        raise ValueError(f"{where}: {name} is {named!r}; expected the dotted name of a {CLASSES[name]}.")
    if module not in sys.modules and module.partition(".")[0] not in PACKAGES:
        raise ValueError(
            f"{where}: {name} names {named!r}, which is imported only if you name its module: --gym-packages {module}."
        )
    kind = _import(CLASSES[name])
    try:
        found = _import(named)
    except (ImportError, AttributeError) as error:
        raise ValueError(f"{where}: {name} names {named!r}, which cannot be imported: {error}.") from error
    if not (isinstance(found, type) and issubclass(found, kind)):
        raise ValueError(f"{where}: {name} names {named!r}, which is no {CLASSES[name]}.")
    return found


def _import(name: str) -> Any:
    module, _, attribute = name.rpartition(".")
    return getattr(importlib.import_module(module), attribute)


class _DictCalls(ast.NodeTransformer):
    """`dict(a=1)`, as RL-Zoo's users write it, becomes `{"a": 1}`."""

    def visit_Call(self, node: ast.Call) -> ast.AST:
        self.generic_visit(node)
        names = [keyword.arg for keyword in node.keywords]
        if not isinstance(node.func, ast.Name) or node.func.id != "dict" or node.args or None in names:
            return node
        return ast.Dict([ast.Constant(name) for name in names], [keyword.value for keyword in node.keywords])


def literal(text: str) -> Any:
    """
    The value of a literal of Python; dict(a=1) is one, too.

    :raises ValueError: it is none
    """
    try:
        return ast.literal_eval(_DictCalls().visit(ast.parse(text.strip(), mode="eval")))
    except (SyntaxError, ValueError, TypeError, MemoryError, RecursionError):
        raise ValueError(f"expected a number, 'text', list or other literal of Python, found {text!r}.") from None
