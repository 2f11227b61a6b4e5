"""Decision Transformer with flow matching."""

from typing import Any, ClassVar

import torch as th
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, Schedule

from sb3_dtfm.algorithms.offline import Dataset, OfflineSequenceAlgorithm
from sb3_dtfm.policies import DTFMPolicy, SequencePolicy


class DTFM(OfflineSequenceAlgorithm):
    """
    Decision Transformer with flow matching: the trunk's hidden state conditions a vector field from noise to action.

    `policy_kwargs` also takes `flow_hidden_dim`, `flow_n_layers`, `flow_prediction`, `flow_tau_exponent`, `solver`,
    `n_solver_steps` and `one_step`.

    :param regression_coef: weight of an auxiliary action regression from the hidden state; 0 leaves it out

    The other parameters are those of :class:`OfflineSequenceAlgorithm`.
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {"MultiInputPolicy": DTFMPolicy}

    def __init__(
        self,
        policy: str | type[SequencePolicy],
        env: GymEnv | str | None = None,
        dataset: Dataset | None = None,
        learning_rate: float | Schedule = 1e-4,
        batch_size: int = 256,
        weight_decay: float = 1e-3,
        context_length: int = 20,
        dataset_fraction: float = 1.0,
        dataset_seed: int = 0,
        timestep_exponent: float = 1.0,
        dataset_kwargs: dict[str, Any] | None = None,
        max_grad_norm: float | None = None,
        warmup_steps: int = 0,
        learning_rate_schedule: str = "constant",
        ema_decay: float = 0.0,
        precision: str = "auto",
        compile: bool | None = None,
        regression_coef: float = 0.0,
        policy_kwargs: dict[str, Any] | None = None,
        stats_window_size: int = 100,
        tensorboard_log: str | None = None,
        verbose: int = 0,
        seed: int | None = None,
        device: th.device | str = "auto",
        _init_setup_model: bool = True,
    ) -> None:
        self.regression_coef = regression_coef
        super().__init__(
            policy=policy,
            env=env,
            dataset=dataset,
            learning_rate=learning_rate,
            batch_size=batch_size,
            weight_decay=weight_decay,
            context_length=context_length,
            dataset_fraction=dataset_fraction,
            dataset_seed=dataset_seed,
            timestep_exponent=timestep_exponent,
            dataset_kwargs=dataset_kwargs,
            max_grad_norm=max_grad_norm,
            warmup_steps=warmup_steps,
            learning_rate_schedule=learning_rate_schedule,
            ema_decay=ema_decay,
            precision=precision,
            compile=compile,
            policy_kwargs=policy_kwargs,
            stats_window_size=stats_window_size,
            tensorboard_log=tensorboard_log,
            verbose=verbose,
            seed=seed,
            device=device,
            _init_setup_model=_init_setup_model,
        )

    def _policy_arguments(self) -> dict[str, Any]:
        return {**super()._policy_arguments(), "regression_coef": self.regression_coef}
