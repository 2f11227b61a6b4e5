"""
The code of README and docs/ runs, block by block.

Python is run, in the order of its page, in a folder that has what docs/start.md leaves behind. Shell lines are only
parsed, by the command's own parser. A comment before a block, `<!-- test: ... -->`, says otherwise:

- `run`: the shell lines are run, too;
- `slow`: run as a slow test only;
- `parse`, `none`: shell lines that are only parsed, or Python that is only compiled, with the reason.

Slow tests run whole pages as they are written, where the fast ones take smaller numbers.
"""

import argparse
import importlib
import inspect
import re
import runpy
import shlex
import sys
import textwrap
from collections.abc import Callable
from importlib.metadata import metadata
from pathlib import Path
from typing import Any, NamedTuple

import pytest
import yaml
from torch.distributed.run import get_args_parser

from sb3_dtfm.algorithms import ALGORITHMS
from sb3_dtfm.cli.benchmark import parse_arguments
from sb3_dtfm.cli.main import COMMANDS, main
from sb3_dtfm.zoo.manager import OF_RL_ZOO

ROOT = Path(__file__).parents[1]
START = "docs/start.md"
# They need no other page's files.
FROM_NOTHING = (START, "README.md")
PAGES = ["README.md", "CONTRIBUTING.md", *sorted(str(page.relative_to(ROOT)) for page in (ROOT / "docs").rglob("*.md"))]
MARK = r"<!-- test: (\w+)(?:\. ([^>]*))? -->\n"
FENCE = re.compile(rf"^( *)(?:{MARK}\1)?```([^\n]*)\n(.*?)^\1```$", re.MULTILINE | re.DOTALL)
SHELL = ("", "sh")
# Smaller numbers that the fast tests take.
FEWER = {
    "range(30)": "range(3)",
    "learn(1_000)": "learn(2)",
    "n_eval_episodes=10": "n_eval_episodes=1",
    'make("MountainCarContinuous-v0")': 'make("MountainCarContinuous-v0", max_episode_steps=20)',
}


class Block(NamedTuple):
    """
    A fenced block.

    :param page: path from the repository's root
    :param line: of its first line of code
    :param mark: what the comment before it says, "" without one
    """

    page: str
    line: int
    language: str
    code: str
    mark: str
    reason: str

    @property
    def commands(self) -> list[list[str]]:
        """Words of the command lines."""
        lines = self.code.replace("\\\n", " ").splitlines() if self.language in SHELL else []
        return [words for words in (shlex.split(line, comments=True) for line in lines) if words]

    def run(self, namespace: dict[str, Any], fewer: bool) -> None:
        """Run Python in the namespace, and this package's commands."""
        code = self.code
        for many, few in FEWER.items() if fewer else ():
            code = code.replace(many, few)
        if self.language == "python":
            lines = "\n" * (self.line - 1)  # an error names the page's line
            exec(compile(lines + code, ROOT / self.page, "exec"), namespace)
        for words in self.commands:
            if words[0] == "sb3-dtfm":
                assert main(words[1:]) == 0, " ".join(words)


def blocks(page: str) -> list[Block]:
    text = (ROOT / page).read_text()
    found = []
    for fence in FENCE.finditer(text):
        _, mark, reason, language, code = fence.groups(default="")
        line = text.count("\n", 0, fence.start(5)) + 1
        found.append(Block(page, line, language, textwrap.dedent(code), mark, reason))
    return found


def pages_with(language: tuple[str, ...], *marks: str) -> list[str]:
    """Pages that have such blocks."""
    return [page for page in PAGES if any(block.language in language and block.mark in marks for block in blocks(page))]


def run(page: str, *marks: str, fewer: bool) -> None:
    """Run a page's Python blocks without a mark, and all blocks that are marked so."""
    namespace: dict[str, Any] = {"__name__": page}
    for block in blocks(page):
        if block.mark in marks or (block.language == "python" and not block.mark):
            block.run(namespace, fewer)


@pytest.fixture(scope="module")
def started(tmp_path_factory) -> Path:
    """The folder that docs/start.md leaves behind, with few episodes and steps."""
    folder = tmp_path_factory.mktemp("started")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        run(START, "run", fewer=True)
    return folder


@pytest.mark.parametrize("page", PAGES)
def test_blocks_are_of_a_kind_that_is_tested(page):
    text = (ROOT / page).read_text()
    assert len(re.findall(r"^ *```", text, re.MULTILINE)) == 2 * len(blocks(page))
    assert text.count("<!-- test: ") == sum(bool(block.mark) for block in blocks(page))
    for block in blocks(page):
        assert block.language in (*SHELL, "python", "yaml", "text"), f"{page}:{block.line}"
        assert block.mark in ("", "run", "slow") or block.reason, f"{page}:{block.line}"


@pytest.mark.parametrize("page", [page for page in pages_with(("python",), "") if page != START])
def test_python_runs(page, started, monkeypatch):
    monkeypatch.chdir(started)
    run(page, "run", fewer=True)


def test_the_start_runs_with_few_episodes(started):
    assert {"mine.npz", "car.zip"} <= {path.name for path in started.iterdir()}


@pytest.mark.slow
@pytest.mark.parametrize("page", pages_with((*SHELL, "python"), "slow"))
def test_a_page_runs_as_it_is_written(page, started, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path if page in FROM_NOTHING else started)
    run(page, "run", "slow", fewer=False)


@pytest.mark.parametrize("page", pages_with(("python",), "none"))
def test_what_is_not_run_is_python(page):
    for block in blocks(page):
        if block.language == "python":
            compile(block.code, page, "exec")


class ParsedError(Exception):
    """A parser took its arguments, which these are; the command would begin now."""


def parse_only(command: Callable[[], Any]) -> None:
    """Call a command that ends where its arguments are parsed."""
    parse_args = argparse.ArgumentParser.parse_args

    def parse(self: argparse.ArgumentParser, *args: Any, **kwargs: Any) -> None:
        raise ParsedError(parse_args(self, *args, **kwargs))

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(argparse.ArgumentParser, "parse_args", parse)
        with pytest.raises(ParsedError) as parsed:
            command()
    check_hyperparameters(parsed.value.args[0])


def check_hyperparameters(options: argparse.Namespace) -> None:
    """Those of `train -params`, the policy's among them; the command learns of unknown ones when it makes the model."""
    algorithm = ALGORITHMS.get(getattr(options, "algo", None) or "")
    if algorithm is not None and isinstance(getattr(options, "hyperparams", None), dict):
        of_the_policy = algorithm.policy_aliases["MultiInputPolicy"].parameter_names()
        check_settings(algorithm, {key: value for key, value in options.hyperparams.items() if key not in of_the_policy})


def check_settings(algorithm: type, settings: dict[str, Any]) -> None:
    assert set(settings) <= {*inspect.signature(algorithm).parameters, *OF_RL_ZOO}
    assert set(settings.get("policy_kwargs") or {}) <= algorithm.policy_aliases["MultiInputPolicy"].parameter_names()


def understand(words: list[str]) -> None:
    """Parse a command line by what it calls."""
    while "=" in words[0]:  # variables of the environment
        words = words[1:]
    words = words[: next((i for i, word in enumerate(words) if word in (">", ">>")), None)]
    program, *arguments = words
    if program == "sb3-dtfm":
        assert arguments[0] in COMMANDS
        module = importlib.import_module(f"sb3_dtfm.cli.{arguments[0]}")
        if arguments[0] == "video":  # it looks for the model before RL-Zoo's script parses what is left, nothing here
            assert module._parser().parse_known_args(arguments[1:])[1] == []
        else:
            parse_only(lambda: module.main(arguments[1:]))
    elif program == "torchrun":
        options = get_args_parser().parse_args(arguments)
        assert options.module
        assert options.training_script == "sb3_dtfm"
        understand(["sb3-dtfm", *options.training_script_args])
    elif program == "python":
        is_module = arguments[0] == "-m"
        path = f"studies/{arguments[1].replace('.', '/')}.py" if is_module else arguments[0]
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(sys, "argv", arguments[is_module:])
            patch.syspath_prepend(str(ROOT / "studies" if is_module else (ROOT / path).parent))
            parse_only(lambda: runpy.run_path(str(ROOT / path), run_name="__main__"))
    elif program == "make":
        makefile = (ROOT / "Makefile").read_text()
        targets = re.findall(r"^\.PHONY: (.*)$", makefile, re.MULTILINE)[0].split()
        assert {word for word in arguments if "=" not in word} <= set(targets)
        for name, _, value in (word.partition("=") for word in arguments if "=" in word):
            assert f"$({name})" in makefile
            if name == "ARGUMENTS":
                understand_baselines(value)
    else:
        assert words[:3] == ["pip", "install", "-c"], f"{program}: no command that this test knows"
        assert (ROOT / words[3]).is_file()
        extras = {extra for word in words for extra in re.findall(r"^\.\[(.*)\]$", word)}
        assert extras <= set(metadata("sb3-dtfm").get_all("Provides-Extra"))


def understand_baselines(arguments: str) -> None:
    """Parse the arguments that `make baselines` passes on."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(ROOT / "studies"))
        command = importlib.import_module("baselines.command")
    command.parse_arguments(shlex.split(arguments))


@pytest.mark.parametrize("page", pages_with(SHELL, "", "parse", "slow"))
def test_command_lines_are_understood(page, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("my_tasks.py").touch()  # the reader's own, in the current folder
    for block in blocks(page):
        for words in block.commands if block.mark not in ("run", "none") else ():
            try:
                understand(words)
            except (Exception, SystemExit) as error:
                raise AssertionError(f"{page}:{block.line}: {' '.join(words)}: {error}") from error


@pytest.mark.parametrize("page", pages_with(("yaml",), ""))
def test_settings_are_those_of_the_algorithms(page, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for block in blocks(page):
        if block.language != "yaml":
            continue
        if page == "docs/howto/benchmark.md":
            Path("data.yml").write_text(block.code)
            assert parse_arguments(["--datasets", "data.yml", "-o", "results"])
            continue
        for settings in yaml.safe_load(block.code).values():
            check_settings(ALGORITHMS["dtfm"], settings)
