"""Small models, and the loss of each of their gradient steps."""

from typing import Any

import numpy as np
from stable_baselines3.common.logger import KVWriter, Logger

from sb3_dtfm import DT, DTFM
from tests.conftest import PLAIN, TINY_FLOW_POLICY, TINY_POLICY

TINY = {DT: TINY_POLICY, DTFM: TINY_FLOW_POLICY}


def make_model(algorithm, buffer, **kwargs):
    """A tiny model; `policy_kwargs` are added to the tiny ones."""
    policy_kwargs = {**TINY[algorithm], **kwargs.pop("policy_kwargs", {})}
    arguments: dict[str, Any] = dict(
        PLAIN, batch_size=16, context_length=5, seed=0, device="cpu", policy_kwargs=policy_kwargs
    )
    return algorithm("MultiInputPolicy", dataset=buffer, **{**arguments, **kwargs})


class Curves(KVWriter):
    """Keeps all that is logged: (step, value) by name."""

    def __init__(self) -> None:
        self.points: dict[str, list[tuple[int, Any]]] = {}

    def write(self, key_values, key_excluded, step=0):
        for name, value in key_values.items():
            self.points.setdefault(name, []).append((step, value))


def record_curves(model) -> Curves:
    """Let the model log into a new one."""
    curves = Curves()
    model.set_logger(Logger(None, [curves]))
    return curves


def learn_losses(model, n_steps: int, **kwargs) -> np.ndarray:
    """The loss of each of `n_steps` gradient steps, (n_steps,)."""
    curves = record_curves(model)
    model.learn(n_steps, log_interval=1, **kwargs)
    return np.array([loss for _, loss in curves.points["train/loss"]])
