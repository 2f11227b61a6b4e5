"""
Train on data sets of `studies/suite.yml` by the classes' defaults and by behaviour cloning, then play the same episodes.

    PYTHONPATH=studies python studies/suite/measure.py hopper pendulum --seeds 0 1 2 -o results/suite
    PYTHONPATH=studies python studies/suite/measure.py hopper --algorithms dtfm -params batch_size:64 --steps 3000

Behaviour cloning is a plain MLP: three hidden layers of 256, Adam at 1e-3, 5,000 gradient steps of 256 windows, mean squared
error; `bc-best` learns from the best tenth of the episodes. Each run prints a line, and with `-o` writes a row of JSON.
"""

import argparse
import json
import time
from collections.abc import Callable, Sequence
from importlib import import_module
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
import yaml
from gymnasium import spaces
from torch import nn

from sb3_dtfm import DT, DTFM
from sb3_dtfm.actions import vector_space
from sb3_dtfm.benchmark import provenance
from sb3_dtfm.benchmark.evaluation import FINAL_STATES, evaluate, make_seeded_envs
from sb3_dtfm.cli.literals import key_value
from sb3_dtfm.data import TrajectoryBuffer, load_dataset
from sb3_dtfm.data.inspection import suggested_target_return
from sb3_dtfm.envs import register_gymnasium_robotics
from sb3_dtfm.zoo.registration import with_policy_options

SUITE = Path(__file__).parents[1] / "suite.yml"
STEPS, BC_STEPS, BATCH_SIZE, WIDTH = 5000, 5000, 256, 256
N_ENVS = 10


class Cloning:
    """
    Behaviour cloning by a plain MLP, which acts as `evaluate` asks a model to.

    :param buffer: to learn from
    :param seed: of weights and batches
    """

    def __init__(self, buffer: TrajectoryBuffer, seed: int) -> None:
        th.manual_seed(seed)
        self.action_space = buffer.action_space
        discrete = isinstance(self.action_space, spaces.Discrete)
        box = vector_space(self.action_space)
        self.low, self.high = th.as_tensor(box.low), th.as_tensor(box.high)
        self.mean, std = (th.as_tensor(each).float() for each in buffer.statistics()[:2])
        self.std = th.where(std > 1e-6, std, 1.0)
        sizes = (len(self.mean), WIDTH, WIDTH, WIDTH)
        layers = [layer for i in range(3) for layer in (nn.Linear(sizes[i], sizes[i + 1]), nn.ReLU())]
        self.network = nn.Sequential(*layers, nn.Linear(WIDTH, len(self.low)))
        optimizer = th.optim.Adam(self.network.parameters(), 1e-3, fused=True)
        generator = th.Generator().manual_seed(seed)
        for _ in range(BC_STEPS):
            batch = buffer.sample(BATCH_SIZE, 1, generator)
            output, actions = self._output(batch.observations[:, 0]), batch.actions[:, 0]
            loss = (
                nn.functional.cross_entropy(output, actions)
                if discrete
                else (output - self._scaled(actions)).square().mean()
            )
            optimizer.zero_grad(set_to_none=True)
            loss.backward()
            optimizer.step()

    def _output(self, observations: th.Tensor) -> th.Tensor:
        return self.network(((observations - self.mean) / self.std).clamp(-10.0, 10.0))

    def _scaled(self, actions: th.Tensor) -> th.Tensor:
        return 2.0 * (actions - self.low) / (self.high - self.low) - 1.0

    def predict(self, observation: dict[str, np.ndarray], *_: Any, **__: Any) -> tuple[np.ndarray, None]:
        """As a model of Stable-Baselines3."""
        with th.inference_mode():
            output = self._output(th.as_tensor(observation["observation"]))
        if isinstance(self.action_space, spaces.Discrete):
            return self.action_space.start + output.argmax(dim=1).numpy(), None
        actions = self.low + 0.5 * (output.clamp(-1.0, 1.0) + 1.0) * (self.high - self.low)
        return actions.numpy().astype(self.action_space.dtype), None


def learn(algorithm: type, buffer: TrajectoryBuffer, seed: int, n_steps: int, settings: dict[str, Any]) -> Any:
    """A model by the class's defaults, but for `settings`."""
    model = algorithm("MultiInputPolicy", dataset=buffer, seed=seed, device="cpu", **with_policy_options(settings))
    return model.learn(n_steps, log_interval=None)


LEARNERS: dict[str, Callable[..., Any]] = {
    "bc": lambda buffer, seed, *_: Cloning(buffer, seed),
    "bc-best": lambda buffer, seed, *_: Cloning(buffer.best(best_share=0.1), seed),
    "dt": lambda *arguments: learn(DT, *arguments),
    "dtfm": lambda *arguments: learn(DTFM, *arguments),
}


def load(entry: dict[str, Any]) -> TrajectoryBuffer:
    """The episodes of an entry of the suite, up to its task's time limit."""
    for package in entry.get("gym_packages", []):
        import_module(package)
    env = gym.make(entry["task"], **entry.get("env_kwargs", {}))
    limit = None if env.spec is None else env.spec.max_episode_steps
    options = {"action_space": env.action_space, "max_episode_steps": limit, **entry.get("dataset_kwargs", {})}
    env.close()
    return load_dataset(entry["dataset"], **options).random_fraction(entry.get("fraction", 1.0), 0)


def measure(name: str, entry: dict[str, Any], algorithm: str, seed: int, options: argparse.Namespace) -> dict[str, Any]:
    """Train and evaluate one run; what is told of it."""
    buffer = load(entry)
    target = suggested_target_return(buffer)
    start = time.perf_counter()
    settings = dict(options.hyperparams)
    model = LEARNERS[algorithm](buffer, seed, options.steps, settings)
    seconds = time.perf_counter() - start
    wrapper = [{"sb3_dtfm.envs.ReturnToGoWrapper": {"target_return": target}}]
    envs = make_seeded_envs(entry["task"], {"env_kwargs": entry.get("env_kwargs"), "env_wrapper": wrapper}, N_ENVS)
    episodes = evaluate(model, envs, range(FINAL_STATES, FINAL_STATES + options.episodes))
    envs.close()
    decided = {each.name: each.value for each in getattr(model, "decisions", [])}
    row = dict(data=name, algorithm=algorithm, seed=seed, target_return=target, decided=decided, settings=settings)
    row |= dict(recorded=float(buffer.episode_returns.mean()), steps=options.steps, seconds=round(seconds, 1))
    return row | dict(commit=provenance.commit(), hardware=provenance.hardware(th.device("cpu")), **episodes._asdict())


def main(argv: Sequence[str] | None = None) -> None:
    """See the top."""
    suite = yaml.safe_load(SUITE.read_text())
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", nargs="*", choices=[*suite, []], metavar="DATA", help="all by default")
    parser.add_argument("--algorithms", nargs="+", choices=LEARNERS)
    parser.add_argument("--seeds", nargs="+", type=int, default=[0])
    parser.add_argument("--steps", type=int, default=STEPS, help="gradient steps of dt and dtfm")
    parser.add_argument("--episodes", type=int, default=100)
    parser.add_argument("-params", "--hyperparams", nargs="+", type=key_value, default=[], metavar="KEY:VALUE")
    parser.add_argument("-o", "--output", type=Path, help="folder of rows")
    options = parser.parse_args(argv)
    register_gymnasium_robotics()
    th.set_num_threads(1)
    for seed in options.seeds:
        for name in options.data or suite:
            for algorithm in options.algorithms or suite[name].get("algorithms", LEARNERS):
                row = measure(name, suite[name], algorithm, seed, options)
                returns, successes = np.array(row["returns"]), row["successes"]
                solved = "" if successes is None else f", {np.mean(successes):.0%} solved"
                reached = f"{returns.mean():.5g} ± {returns.std():.3g}{solved}"
                print(f"{name} {algorithm} seed {seed}: {reached} (recorded {row['recorded']:.5g}, asked for "
                      f"{row['target_return']:g}, {row['seconds']:.0f} s) {row['settings'] or ''}", flush=True)  # fmt: skip
                if options.output is not None:
                    options.output.mkdir(parents=True, exist_ok=True)
                    with (options.output / f"{name}.jsonl").open("a") as file:
                        file.write(json.dumps(row) + "\n")


if __name__ == "__main__":
    main()
