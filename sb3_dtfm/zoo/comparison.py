"""Compare a model's returns with its target return and the recorded returns: printed at the end of `train` and `enjoy`."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from huggingface_sb3 import EnvironmentName
from stable_baselines3.common.callbacks import BaseCallback, EvalCallback
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper

from sb3_dtfm.data import ReturnReference
from sb3_dtfm.envs.cameras import images_on_demand
from sb3_dtfm.envs.success import reported_success
from sb3_dtfm.files import printable, read_run

# Below this share of the goal, suggestions are printed.
ENOUGH = 0.9
N_RANDOM_EPISODES = 5


class RandomActions:
    """
    Model that acts at random, for SB3's `evaluate_policy`.

    :param env: environments whose actions are drawn
    :param seed: seed of the draws
    """

    def __init__(self, env: VecEnv, seed: int) -> None:
        self.n_envs, self.space = env.num_envs, env.action_space
        self.space.seed(seed)

    def predict(self, *args: Any, **kwargs: Any) -> tuple[np.ndarray, None]:
        """An action for each environment, whatever is observed."""
        return np.stack([self.space.sample() for _ in range(self.n_envs)]), None


class MeasureRandomActions(BaseCallback):
    """
    Measure in the environment of the evaluations what random actions return, for the model's `return_reference`.

    It is measured before training, so that every saved model knows it. Put it before the callbacks that evaluate and their
    :class:`~sb3_dtfm.callbacks.SeedEvaluations`.

    :param eval_callbacks: the evaluations, of which the first counts
    :param seed: seed of the actions
    :param after_step: function called after each step
    """

    def __init__(self, eval_callbacks: list[EvalCallback], seed: int, after_step: Callable[..., None] | None = None) -> None:
        super().__init__()
        self.eval_callbacks = eval_callbacks
        self.seed = seed
        self.after_step = after_step

    def _on_training_start(self) -> None:
        model: Any = self.model
        for evaluation in self.eval_callbacks[:1]:
            random: Any = RandomActions(evaluation.eval_env, self.seed)
            with images_on_demand(evaluation.eval_env) as draw:
                draw(np.zeros(random.n_envs, bool))
                mean: Any = evaluate_policy(random, evaluation.eval_env, N_RANDOM_EPISODES, callback=self.after_step)[0]
            model.return_reference = model.return_reference._replace(random=float(mean))

    def _on_step(self) -> bool:
        return True


class EpisodesOf(VecEnvWrapper):
    """
    Wrapper that keeps the returns and successes of an environment's episodes.

    :ivar returns: returns of the episodes that have ended, environment reward units
    :ivar successes: whether each of them succeeded; empty where the task does not tell
    """

    def __init__(self, venv: VecEnv) -> None:
        super().__init__(venv)
        self.returns: list[float] = []
        self.successes: list[bool] = []

    def reset(self) -> Any:
        return self.venv.reset()

    def step_wait(self) -> Any:
        observations, rewards, dones, infos = self.venv.step_wait()
        for info in (infos[i] for i in np.flatnonzero(dones)):
            self.returns.append(info["episode"]["r"])  # the monitor's, of which no wrapper has changed the rewards
            if (success := reported_success(info)) is not None:
                self.successes.append(success)
        return observations, rewards, dones, infos


def compare(
    attributes: Mapping[str, Any], returns: Sequence[float], successes: Sequence[bool], run: Path, env_name: EnvironmentName
) -> list[str]:
    """
    Compare a model's episodes with its target return and the recorded episodes, see :meth:`ReturnReference.goal`.

    If they reach less than nine tenths of the goal, suggestions follow: longer training, and a sweep where the model
    looks at a target return.

    :param attributes: attributes of the model, or of its file; `target_return` is that of these episodes
    :param returns: returns of its episodes, environment reward units
    :param successes: whether each of them succeeded; empty where the task does not tell
    :param run: folder of its run
    :param env_name: name of its environment
    :return: sentences; none where there are no episodes, or where the model does not know what was recorded
    """
    if attributes.get("return_reference") is None or not len(returns):
        return []
    reference = ReturnReference(*attributes["return_reference"])
    policy_kwargs = attributes.get("policy_kwargs") or {}
    target = attributes.get("target_return") if policy_kwargs.get("return_conditioning", True) else None
    reached = float(np.mean(returns))
    goal, name = reference.goal(target)
    share = reference.share(reached, goal)
    recorded = f"Recorded {four_digits(reference.recorded)} (best tenth {four_digits(reference.best_tenth)})"
    others = {"random": reference.random, "target return": target, "reached": reached}
    numbers = ", ".join([recorded, *(f"{key} {four_digits(value)}" for key, value in others.items() if value is not None)])
    sentences = [f"{numbers}." if share is None else f"{numbers}: {_percent(share)} of {name}."]
    if reference.success_rate and len(successes):
        rate = float(np.mean(successes))
        sentences.append(
            f"{_percent(reference.success_rate)} of the recorded episodes succeeded, {_percent(rate)} of these."
        )
    if share is not None and share < ENOUGH:
        n_steps = attributes["_total_timesteps"]
        sentences.append(f"Longer training may help: -n {2 * n_steps} instead of {n_steps}.")
        if target is not None:
            dataset = read_run(run / env_name).get("dataset")
            arguments = f"--env {env_name.gym_id} --dataset {dataset if isinstance(dataset, str) else 'DATASET'}"
            sentences.append(f"A sweep shows the best target return: sb3-dtfm sweep {run} {arguments}")
    return list(map(printable, sentences))


def four_digits(number: float) -> str:
    """A number as a table shows it: 3,727 or 0.1235."""
    return f"{float(f'{number:.4g}'):,.12g}"


def _percent(share: float) -> str:
    return f"{100 * share:.0f} %"
