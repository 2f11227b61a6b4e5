"""Allowed imports between packages, read from the sources, so that no import has to happen."""

import ast
import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.data.corpus import write_lerobot

ROOT = Path(__file__).parents[1]
PACKAGE = "sb3_dtfm"


def module_name(path: Path) -> str:
    """Full name of a file's module: an installation has `envs` and `zoo_configs` inside the package."""
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts if parts[0] == PACKAGE else (PACKAGE, *parts)).removesuffix(".__init__")


SOURCES = sorted(path for folder in (PACKAGE, "envs", "zoo_configs") for path in (ROOT / folder).rglob("*.py"))
MODULES = {module_name(path): path for path in SOURCES}

# Part: its files, and the parts of the package that it may import.
PARTS = {
    "networks": ("sb3_dtfm/networks", {"networks"}),
    "windows": ("sb3_dtfm/windows.py", set()),
    "transitions": ("sb3_dtfm/transitions.py", set()),
    "arguments": ("sb3_dtfm/arguments.py", set()),
    "actions": ("sb3_dtfm/actions.py", set()),
    "files": ("sb3_dtfm/files", {"files"}),
    "heads": ("sb3_dtfm/heads", {"heads", "networks", "arguments"}),
    "envs": ("envs", {"envs"}),
    "data": ("sb3_dtfm/data", {"actions", "arguments", "data", "envs", "files", "transitions", "windows"}),
    "recording": ("sb3_dtfm/recording", {"recording", "actions", "algorithms", "envs", "data", "files", "finetuning"}),
    "policies": ("sb3_dtfm/policies", {"networks", "heads", "transitions", "windows", "actions", "arguments", "policies"}),
    "callbacks": ("sb3_dtfm/callbacks.py", {"data", "files"}),
    "optimization": ("sb3_dtfm/optimization.py", set()),
    "distributed": ("sb3_dtfm/distributed.py", {"windows"}),
    "algorithms": (
        "sb3_dtfm/algorithms",
        {
            "algorithms",
            "policies",
            "heads",
            "data",
            "envs",
            "transitions",
            "windows",
            "actions",
            "arguments",
            "callbacks",
            "optimization",
            "distributed",
            "files",
        },
    ),
    "finetuning": (
        "sb3_dtfm/finetuning",
        {
            "finetuning",
            "algorithms",
            "arguments",
            "data",
            "distributed",
            "envs",
            "optimization",
            "policies",
            "transitions",
            "windows",
        },
    ),
    "zoo": (
        "sb3_dtfm/zoo",
        {
            "",
            "algorithms",
            "arguments",
            "policies",
            "callbacks",
            "data",
            "envs",
            "distributed",
            "files",
            "finetuning",
            "recording",
            "zoo",
        },
    ),
    "benchmark": (
        "sb3_dtfm/benchmark",
        {"", "actions", "algorithms", "data", "envs", "optimization", "zoo", "benchmark", "files"},
    ),
    "cli": (
        "sb3_dtfm/cli",
        {"", "actions", "algorithms", "data", "envs", "finetuning", "recording", "zoo", "benchmark", "files", "cli"},
    ),
}


def files(part: str) -> list[Path]:
    path = ROOT / PARTS[part][0]
    found = sorted(path.rglob("*.py")) if path.is_dir() else [path]
    assert found
    return found


def imported_modules(path: Path) -> list[str]:
    """Full names of all modules that a file imports, wherever in the file."""
    modules = []
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            modules += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            named = [f"{node.module}.{alias.name}" for alias in node.names]
            modules += [name if name in MODULES else str(node.module) for name in named]
    return modules


@pytest.mark.parametrize("part", PARTS)
def test_a_package_imports_only_the_packages_below_it(part):
    for path in files(part):
        own = {module for module in imported_modules(path) if module.split(".")[0] == PACKAGE}
        parts = {module.split(".")[1] if "." in module else "" for module in own}
        assert parts <= PARTS[part][1], f"{path.relative_to(ROOT)} imports {sorted(own)}"


def test_packages_form_no_circle():
    """A part comes after all parts that it may import, so that some order has them all."""
    below = {part: allowed - {part, ""} for part, (_, allowed) in PARTS.items()}
    below["zoo"] |= {"algorithms"}  # what "" is: the package's own names
    ordered: set[str] = set()
    while free := {part for part in below if part not in ordered and below[part] <= ordered}:
        ordered |= free
    assert ordered == set(PARTS), f"a circle among {sorted(set(PARTS) - ordered)}"


def test_modules_form_no_circle_not_even_for_types():
    """Imports for type checkers alone count: a reader follows them, too."""
    below = {name: {each for each in imported_modules(path) if each in MODULES} for name, path in MODULES.items()}
    ordered: set[str] = set()
    while free := {name for name in below if name not in ordered and below[name] <= ordered}:
        ordered |= free
    assert ordered == set(MODULES), f"a circle among {sorted(set(MODULES) - ordered)}"


def test_networks_need_torch_and_numpy_alone():
    standard = {"collections", "contextlib", "dataclasses", "inspect", "math", "typing", "__future__", "abc", "functools"}
    for path in files("networks"):
        roots = {module.split(".")[0] for module in imported_modules(path)}
        assert roots <= standard | {"torch", "numpy", PACKAGE}, path


def test_every_module_belongs_to_a_package():
    known = {path for part in PARTS for path in files(part)} | {
        ROOT / "sb3_dtfm" / name for name in ("__init__.py", "__main__.py")
    }
    assert set((ROOT / "sb3_dtfm").rglob("*.py")) <= known


# One module of each extra. None in `sys.modules` is a package that is not there.
EXTRAS = (
    "gymnasium_robotics",
    "huggingface_hub",
    "mujoco",
    "onnx",
    "pyarrow",
    "rl_zoo3",
    "robosuite",
    "sb3_contrib",
    "scipy",
)
WITHOUT_EXTRAS = f"import sys; sys.modules.update(dict.fromkeys({EXTRAS}))\n"
LEARN = """
import gymnasium as gym
import numpy as np
from sb3_dtfm import DTFM
from sb3_dtfm.envs import ReturnToGoWrapper

episode = dict(observations=np.zeros((9, 3)), actions=np.zeros((9, 1)), rewards=np.ones(9))
env = ReturnToGoWrapper(gym.make("Pendulum-v1"), target_return=0.0)
small = dict(embed_dim=8, n_layers=1, n_heads=1, flow_hidden_dim=8)
DTFM("MultiInputPolicy", env, [episode], batch_size=2, context_length=2, policy_kwargs=small).learn(2).save("model")
model = DTFM.load("model", env)
print("acts", model.predict(model.get_env().reset())[0].shape)
"""


def python(program: str, folder: Path) -> str:
    environment = {**os.environ, "MINARI_DATASETS_PATH": str(folder / "minari")}
    command = [sys.executable, "-c", program]
    process = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=False)
    assert process.returncode == 0, process.stdout + process.stderr
    return process.stdout


def test_an_import_registers_tasks_and_leaves_pytorch_for_later(tmp_path):
    heavy = '{"h5py", "minari", "mujoco", "stable_baselines3", "torch"} & set(sys.modules)'
    program = (
        f"import sys, gymnasium, sb3_dtfm; print('robosuite/Lift-v0' in gymnasium.registry, {heavy}, sb3_dtfm.DT.__name__)"
    )
    assert python(program, tmp_path) == "True set() DT\n"


def test_help_and_version_come_within_a_second_of_the_processor(tmp_path):
    call = "with contextlib.suppress(SystemExit):\n    main([option])\n"
    measured = "print(time.process_time())"
    for option, text in (("--help", "commands:"), ("--version", "sb3-dtfm ")):
        program = f"import contextlib, time\nfrom sb3_dtfm.cli.main import main\noption = {option!r}\n{call}{measured}"
        said = [python(program, tmp_path) for _ in range(3)]
        assert all(text in each for each in said)
        assert min(float(each.splitlines()[-1]) for each in said) < 1.0  # neighbours only add


def test_a_model_learns_from_arrays_and_acts_without_any_extra(tmp_path):
    """Nor with torch's compiler, which takes longer to load than such a training does."""
    compiler = 'import sys\nprint({"sympy", "torch._dynamo"} & set(sys.modules))\n'
    assert python(WITHOUT_EXTRAS + LEARN + compiler, tmp_path).endswith("acts (1, 1)\nset()\n")


MISSING = {
    "train --algo dtfm": 'needs RL-Zoo: pip install "sb3-dtfm[zoo]"',
    "record --demonstrator lift --episodes 1 --output lift.hdf5": 'pip install "sb3-dtfm[robosuite]"',
    "record --algo tqc --model a.zip --env Pendulum-v1 --episodes 1 --dataset-id my/own-v0": 'pip install "sb3-dtfm[zoo]"',
    "record --algo sac --model a.zip --env Ant-v5 --episodes 1 --dataset-id my/own-v0": 'pip install "gymnasium[mujoco]"',
    "record --algo sac --model a.zip --env Go1Velocity-v0 --episodes 1 --dataset-id my/own-v0": "needs MuJoCo: pip install",
    "inspect no/such-v0": 'cannot be downloaded: for that, pip install "sb3-dtfm[minari]"',
    "inspect arm": 'to read Parquet and Arrow files: pip install "sb3-dtfm[minari]"',
}


def test_an_extra_that_is_missing_is_named(tmp_path):
    (tmp_path / "a.zip").touch()
    write_lerobot(tmp_path / "arm")
    program = f"""
from sb3_dtfm.cli.main import main
for line in {list(MISSING)}:
    assert main(line.split()) == 2
"""
    messages = python(WITHOUT_EXTRAS + "sys.stderr = sys.stdout\n" + program, tmp_path).splitlines()
    for line, expected, found in zip(MISSING, MISSING.values(), messages, strict=True):
        assert expected in found, line
