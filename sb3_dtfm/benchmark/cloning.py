"""
Behaviour cloning by a plain network: a baseline, as a run of the benchmark in a process of its own.

    python -m sb3_dtfm.benchmark.cloning settings.yml

`settings.yml` is what the grid writes for each of its runs, see :mod:`~sb3_dtfm.benchmark.runner`.
"""

import argparse
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import torch as th
import yaml
from gymnasium import spaces
from stable_baselines3.common.callbacks import BaseCallback
from torch import nn

from sb3_dtfm.actions import unscaled, vector_space
from sb3_dtfm.benchmark.evaluation import EvaluationCallback
from sb3_dtfm.benchmark.provenance import read_data
from sb3_dtfm.data import TrajectoryBuffer
from sb3_dtfm.zoo.arguments import import_packages


class Cloning:
    """
    An MLP from observations to actions, which a callback and `evaluate` treat as a model of Stable-Baselines3.

    It learns by the mean squared error of actions scaled to [-1, 1], or by the cross-entropy of Discrete ones, with Adam.

    :param buffer: recorded episodes to learn from
    :param hidden_sizes: width of each hidden layer
    :param learning_rate: Adam's learning rate
    :param seed: seed of weights and batches
    """

    device = th.device("cpu")

    def __init__(self, buffer: TrajectoryBuffer, hidden_sizes: Sequence[int], learning_rate: float, seed: int) -> None:
        th.manual_seed(seed)
        self.num_timesteps, self._total_timesteps = 0, 0
        self.buffer, self.action_space = buffer, buffer.action_space
        self._generator = th.Generator().manual_seed(seed)
        box = vector_space(self.action_space)
        self._low, self._high = th.as_tensor(box.low), th.as_tensor(box.high)
        self._statistics = buffer.statistics()
        sizes = [len(self._statistics.observation_mean), *hidden_sizes]
        hidden = [layer for n_in, n_out in pairwise(sizes) for layer in (nn.Linear(n_in, n_out), nn.ReLU())]
        self.policy = nn.Sequential(*hidden, nn.Linear(sizes[-1], len(self._low)))
        self._optimizer = th.optim.Adam(self.policy.parameters(), learning_rate, fused=True)

    def learn(self, n_steps: int, batch_size: int, callback: BaseCallback) -> None:
        """
        :param n_steps: number of gradient steps
        :param batch_size: number of recorded steps in each
        :param callback: callback that runs before the first gradient step and after each
        """
        self._total_timesteps = n_steps
        model: Any = self
        callback.init_callback(model)
        callback.on_training_start({}, {})
        while self.num_timesteps < n_steps:
            loss = self._loss(batch_size)
            self._optimizer.zero_grad(set_to_none=True)
            loss.backward()
            self._optimizer.step()
            self.num_timesteps += 1
            callback.on_step()
        callback.on_training_end()

    def _loss(self, batch_size: int) -> th.Tensor:
        batch = self.buffer.sample(batch_size, 1, self._generator)
        output, actions = self._output(batch.observations[:, 0]), batch.actions[:, 0]
        if isinstance(self.action_space, spaces.Discrete):
            return nn.functional.cross_entropy(output, actions)
        scaled = 2.0 * (actions - self._low) / (self._high - self._low) - 1.0
        return (output - scaled).square().mean()

    def _output(self, observations: th.Tensor) -> th.Tensor:
        return self.policy(self._statistics.normalize(observations))

    def predict(self, observation: dict[str, np.ndarray], *_: Any, **__: Any) -> tuple[np.ndarray, None]:
        """Actions as Stable-Baselines3's models give them."""
        with th.inference_mode():
            output = self._output(th.as_tensor(observation["observation"]))
        if isinstance(self.action_space, spaces.Discrete):
            return self.action_space.start + output.argmax(dim=1).numpy(), None
        actions = unscaled(output.clamp(-1.0, 1.0), self._low, self._high)
        return actions.numpy().astype(self.action_space.dtype), None


def main(argv: Sequence[str] | None = None) -> None:
    """
    Train and evaluate one run.

    :param argv: its arguments; those of the process by default
    """
    parser = argparse.ArgumentParser(
        prog="python -m sb3_dtfm.benchmark.cloning", description="Train and evaluate one run of `benchmark`."
    )
    parser.add_argument("settings", type=Path, help="YAML file of the run")
    parser.add_argument("--gym-packages", nargs="+", default=[], metavar="MODULE")
    options = parser.parse_args(argv)
    import_packages(options.gym_packages)
    ((env_id, settings),) = yaml.safe_load(options.settings.read_text()).items()
    (arguments,) = settings["callback"][-1].values()
    buffer = read_data(env_id, settings)
    best = buffer.best(best_share=settings["best_share"])
    model = Cloning(best, settings["hidden_sizes"], settings["learning_rate"], arguments["row"]["seed"])
    model.learn(settings["n_timesteps"], settings["batch_size"], EvaluationCallback(**arguments))


if __name__ == "__main__":
    main()
