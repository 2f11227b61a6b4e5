"""d3rlpy's algorithms as baselines; runs in an environment of their own (`make baselines`)."""

import dataclasses
from collections.abc import Callable
from typing import Any

import d3rlpy
import numpy as np
import torch as th

from baselines.protocol import Dataset, serve

CONFIGS = {
    "bc": d3rlpy.algos.BCConfig,
    "dt": d3rlpy.algos.DecisionTransformerConfig,
    "iql": d3rlpy.algos.IQLConfig,
    "rebrac": d3rlpy.algos.ReBRACConfig,
    "td3-bc": d3rlpy.algos.TD3PlusBCConfig,
}
# Settings that are not fields of d3rlpy's configurations.
OWN = {"hidden", "critic_layer_norm", "dropout", "standardize", "reward", "cosine", "adamw"}


class D3rlpyLearner:
    """
    One of d3rlpy's algorithms.

    :param settings: `algorithm`, one of `CONFIGS`; `hidden` layers, `critic_layer_norm` (of Q and V), the actor's `dropout`;
        `standardize` observations, `reward` scaling; a `cosine` schedule of the actor's learning rate, `adamw` options; and
        fields of the algorithm's configuration
    :param dataset: to learn from
    :param n_steps: gradient steps that are planned, for schedules
    :param seed: of weights, batches and noise
    :raises ValueError: a setting that nobody knows
    """

    def __init__(self, settings: dict[str, Any], dataset: Dataset, n_steps: int, seed: int) -> None:
        th.set_num_threads(1)
        d3rlpy.seed(seed)
        settings = dict(settings)
        config = CONFIGS[settings.pop("algorithm")]
        fields = {field.name for field in dataclasses.fields(config)}
        if unknown := set(settings) - fields - OWN:
            raise ValueError(
                f"{', '.join(sorted(unknown))}: no setting of {config.__name__}; has {', '.join(sorted(fields))}"
            )
        values = {name: value for name, value in settings.items() if name in fields}
        values |= _encoders(settings, fields) | _optimizers(settings, fields, n_steps) | _scalers(settings, fields, dataset)
        if "max_timestep" in fields:
            values["max_timestep"] = max(1000, *(len(episode.actions) for episode in dataset.episodes))
        self.algorithm = config(**values).create(device="cpu")
        self._episodes = d3rlpy.dataset.create_infinite_replay_buffer(
            [
                d3rlpy.dataset.Episode(each.observations, each.actions, each.rewards[:, None], terminated=each.terminated)
                for each in dataset.episodes
            ]
        )

    def learn(self, n_steps: int, after_step: Callable[[], None]) -> None:
        """See :class:`~baselines.protocol.Learner`."""
        self.algorithm.fit(
            self._episodes,
            n_steps=n_steps,
            n_steps_per_epoch=n_steps,
            logger_adapter=d3rlpy.logging.NoopAdapterFactory(),
            show_progress=False,
            callback=lambda *_: after_step(),
        )

    def actor(self) -> Callable[[np.ndarray, float, bool], np.ndarray]:
        """See :class:`~baselines.protocol.Learner`."""
        if hasattr(self.algorithm, "as_stateful_wrapper"):
            return _ReturnConditioned(self.algorithm)
        return lambda observation, return_to_go, start: self.algorithm.predict(observation[None])[0]


class _ReturnConditioned:
    """
    Decision Transformer in one environment. It subtracts rewards itself; our environments tell the difference.

    :param algorithm: that has learned
    """

    def __init__(self, algorithm: Any) -> None:
        self._algorithm = algorithm

    def __call__(self, observation: np.ndarray, return_to_go: float, start: bool) -> np.ndarray:
        if start:
            self._wrapper = self._algorithm.as_stateful_wrapper(target_return=return_to_go)
            self._before = return_to_go
        reward, self._before = self._before - return_to_go, return_to_go
        return self._wrapper.predict(observation, reward)


def _encoders(settings: dict[str, Any], fields: set[str]) -> dict[str, Any]:
    """Networks of the given hidden layers."""

    def encoder(name: str) -> Any:
        return d3rlpy.models.VectorEncoderFactory(
            settings["hidden"],
            use_layer_norm=name.startswith(("critic", "value")) and settings.get("critic_layer_norm", False),
            dropout_rate=settings.get("dropout") if name.startswith("actor") else None,
            exclude_last_activation="context_size" in fields,  # it only embeds there
        )

    return {name: encoder(name) for name in fields if name.endswith("encoder_factory")}


def _optimizers(settings: dict[str, Any], fields: set[str], n_steps: int) -> dict[str, Any]:
    """Return the optimisers that differ from d3rlpy's, which is Adam at a constant learning rate."""
    if settings.get("cosine"):
        schedule = d3rlpy.optimizers.CosineAnnealingLRFactory(T_max=n_steps)
        return {"actor_optim_factory": d3rlpy.optimizers.AdamFactory(lr_scheduler_factory=schedule)}
    if "adamw" in settings:
        options = dict(settings["adamw"])
        warmup = d3rlpy.optimizers.WarmupSchedulerFactory(max(1, round(options.pop("warmup_share") * n_steps)))
        return {"optim_factory": d3rlpy.optimizers.AdamWFactory(lr_scheduler_factory=warmup, **options)}
    return {}


def _scalers(settings: dict[str, Any], fields: set[str], dataset: Dataset) -> dict[str, Any]:
    """Measured here: d3rlpy would look at each step by itself, which takes longer and comes to the same."""
    scalers: dict[str, Any] = {}
    if settings.get("standardize"):
        steps = np.concatenate([episode.observations for episode in dataset.episodes]).astype(np.float64)
        scalers["observation_scaler"] = d3rlpy.preprocessing.StandardObservationScaler(steps.mean(axis=0), steps.std(axis=0))
    for way, number in (settings.get("reward") or {}).items():
        scalers["reward_scaler"] = _reward_scaler(way, number, dataset)
    return scalers


def _reward_scaler(way: str, number: float, dataset: Dataset) -> Any:
    """
    :param way: "multiply" by the number, "shift" by it, or "returns": multiply, and divide by the range of returns
    :raises ValueError: another way, or returns without a range
    """
    if way == "multiply":
        return d3rlpy.preprocessing.MultiplyRewardScaler(number)
    if way == "shift":
        return d3rlpy.preprocessing.ConstantShiftRewardScaler(number)
    if way != "returns":
        raise ValueError(f"reward is {way}; accepted are multiply, shift and returns.")
    returns = [float(episode.rewards.sum()) for episode in dataset.episodes]
    if max(returns) == min(returns):
        raise ValueError(f"reward is returns, and all episodes return {returns[0]:g}: there is no range to divide by.")
    return d3rlpy.preprocessing.ReturnBasedRewardScaler(max(returns), min(returns), number)


if __name__ == "__main__":
    serve(D3rlpyLearner, ("d3rlpy", "torch", "numpy"))
