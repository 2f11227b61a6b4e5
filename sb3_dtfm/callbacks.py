"""Callbacks that `learn` adds to Stable-Baselines3's own."""

import time
import warnings
from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

import torch as th
from stable_baselines3.common import logger
from stable_baselines3.common.callbacks import (
    BaseCallback,
    CallbackList,
    ConvertCallback,
    EvalCallback,
    EventCallback,
    ProgressBarCallback,
)
from stable_baselines3.common.type_aliases import MaybeCallback

from sb3_dtfm.data.trajectories import ScoreReference
from sb3_dtfm.files import printable

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# Paths in a picture of the flow, and how far it reaches: showing the little noise beyond would only make the rest small.
N_PATHS, REACH = 300, 2.2
# Fewest gradient steps and seconds that are timed at first, to predict the time of the others.
N_TIMED, SECONDS_TIMED = 3, 5.0
# Seconds to train from which on silence would be a surprise.
LONG = 1800.0


def find_eval_callbacks(callback: BaseCallback | None) -> list[EvalCallback]:
    """All evaluation callbacks in a tree of callback lists and events."""
    if isinstance(callback, EvalCallback):
        return [callback]
    if isinstance(callback, CallbackList):
        return [found for child in callback.callbacks for found in find_eval_callbacks(child)]
    if isinstance(callback, EventCallback):
        return find_eval_callbacks(callback.callback)
    return []


def combine_callbacks(
    callback: MaybeCallback, score_reference: ScoreReference | None, own: Iterable[BaseCallback]
) -> tuple[CallbackList, list[EvalCallback]]:
    """
    A user's callbacks with those of the learn loop.

    :param callback: the user's callback or callbacks, as SB3's `learn` takes them
    :param score_reference: scale of the normalised score, which is logged where there is one
    :param own: callbacks of the learn loop, which come behind the user's
    :return: all of them, and those that evaluate
    """
    if isinstance(callback, list):
        callback = CallbackList(callback)
    evaluations = find_eval_callbacks(callback) if isinstance(callback, BaseCallback) else []
    children = [callback if isinstance(callback, BaseCallback) else ConvertCallback(callback)]
    if score_reference is not None:
        children.append(NormalizedScoreCallback(score_reference, evaluations))
    return CallbackList([*children, *own]), evaluations


class GradientStepProgressBar(ProgressBarCallback):
    """SB3's progress bar, one unit per gradient step whatever the number of environments."""

    def _on_step(self) -> bool:
        self.pbar.update(1)
        return True


class TimeLeft(BaseCallback):
    """
    Say once, after the first gradient steps, how long the others take; more than half an hour is a warning, whatever
    `verbose` is. The very first step is not timed, since it may compile. Put it behind the callbacks that evaluate.
    """

    def __init__(self) -> None:
        super().__init__()
        self._start: tuple[int, float] | None = None  # gradient steps and time, after the first one
        self._has_spoken = False

    def _on_step(self) -> bool:
        if self._has_spoken:
            return True
        now = time.perf_counter()
        self._start = self._start or (self.num_timesteps, now)
        n_steps, seconds = self.num_timesteps - self._start[0], now - self._start[1]
        if n_steps >= N_TIMED and seconds >= SECONDS_TIMED:
            self._has_spoken = True
            self._speak(n_steps / seconds)
        return True

    def _speak(self, rate: float) -> None:
        """:param rate: gradient steps a second"""
        seconds = (self.model._total_timesteps - self.num_timesteps) / rate
        device = "CPU" if self.model.device.type == "cpu" else "GPU"
        left = f"About {_duration(seconds)} left on this {device} ({_two_digits(rate)} gradient steps a second)."
        if seconds > LONG:
            remedy = "To shorten it, lower total_timesteps, batch_size, context_length, embed_dim or n_layers."
            warnings.warn(f"{left} {remedy}", UserWarning, stacklevel=7)  # the line that calls `learn`
        elif self.model.verbose >= 1:
            print(left, flush=True)


def _duration(seconds: float) -> str:
    unit, size = ("h", 3600) if seconds >= 5400 else ("min", 60) if seconds >= 90 else ("s", 1)
    return f"{_two_digits(seconds / size)} {unit}"


def _two_digits(number: float) -> str:
    return f"{float(f'{number:.2g}'):,g}"


class SeedEvaluations(BaseCallback):
    """
    Start each evaluation's environments from a seed of its own, whatever was evaluated before: a run that is resumed then
    evaluates as it would have. Put it before the callbacks that evaluate.

    :param eval_callbacks: the evaluations
    :param seed: seed of the run
    """

    def __init__(self, eval_callbacks: list[EvalCallback], seed: int) -> None:
        super().__init__()
        self.eval_callbacks = [evaluation for evaluation in eval_callbacks if evaluation.eval_freq > 0]
        self.seed = seed

    def _on_training_start(self) -> None:
        self._seed(self.eval_callbacks)

    def _on_step(self) -> bool:
        self._seed([each for each in self.eval_callbacks if (each.n_calls + 1) % each.eval_freq == 0])
        return True

    def _on_training_end(self) -> None:
        self._seed(self.eval_callbacks)

    def _seed(self, eval_callbacks: list[EvalCallback]) -> None:
        for evaluation in eval_callbacks:
            evaluation.eval_env.seed((self.seed + self.num_timesteps) % 2**31)  # counts as of the next reset


class EvaluateAtStartAndEnd(BaseCallback):
    """
    Evaluate before the first gradient step and after the last one too, where `EvalCallback` counts full intervals only.

    The curve of an evaluation then shows where training started, be it from random weights or from a trained model, and
    where it ended; no step is evaluated twice. Put it behind the callbacks that evaluate.

    :param eval_callbacks: the evaluations to complete
    """

    def __init__(self, eval_callbacks: list[EvalCallback]) -> None:
        super().__init__()
        self.eval_callbacks = [evaluation for evaluation in eval_callbacks if evaluation.eval_freq > 0]
        self._evaluated_at: int | None = None
        self._n_updates = 0  # at the newest evaluation of a full interval

    def go_on(self, num_timesteps: int) -> None:
        """
        Do not evaluate before the next gradient step: the run is resumed in its midst.

        :param num_timesteps: gradient steps so far
        """
        self._evaluated_at = num_timesteps

    def _on_training_start(self) -> None:
        if self._evaluated_at != self.num_timesteps:
            self._evaluate(self.eval_callbacks)
        else:  # and at the end, even if no step of an environment is left
            self._evaluated_at = None

    def _on_step(self) -> bool:
        if any(evaluation.n_calls % evaluation.eval_freq == 0 for evaluation in self.eval_callbacks):
            self._n_updates = self._updates()
        return True

    def _updates(self) -> int:
        """The model's gradient steps: one that acts and learns in rounds learns on after its last step."""
        return getattr(self.model, "_n_updates", 0)

    def _on_training_end(self) -> None:
        if self._evaluated_at != self.num_timesteps:
            self._evaluate([evaluation for evaluation in self.eval_callbacks if not self._just_evaluated(evaluation)])

    def _just_evaluated(self, evaluation: EvalCallback) -> bool:
        just_now = evaluation.num_timesteps == self.num_timesteps and evaluation.n_calls % evaluation.eval_freq == 0
        return just_now and self._n_updates == self._updates()

    def _evaluate(self, eval_callbacks: list[EvalCallback]) -> None:
        for evaluation in eval_callbacks:
            n_calls, evaluation.n_calls = evaluation.n_calls, -1  # the next call is number 0, on which every interval ends
            evaluation.on_step()
            evaluation.n_calls = n_calls
        self._evaluated_at = self.num_timesteps


class NormalizedScoreCallback(BaseCallback):
    """
    Log `eval/normalized_score` after each evaluation, whatever started it. Put it behind the callbacks that evaluate.

    :param score_reference: the returns that count as 0 and 1
    :param eval_callbacks: the evaluations to follow
    """

    def __init__(self, score_reference: ScoreReference, eval_callbacks: list[EvalCallback]) -> None:
        super().__init__()
        self.score_reference = score_reference
        self.eval_callbacks = eval_callbacks

    def _init_callback(self) -> None:
        # `EvalCallback` starts each evaluation with a new list of successes, and tells of it in no other way: what it calls
        # after an evaluation is left out where the new best model ends the training.
        self._seen = [evaluation._is_success_buffer for evaluation in self.eval_callbacks]

    def _on_training_start(self) -> None:
        if self.eval_callbacks and self.model.verbose >= 1:
            reference = self.score_reference
            print(
                f"eval/normalized_score: 0 is a return of {reference.minimum:.1f}, 1 is {reference.maximum:.1f} "
                f"({printable(reference.scale)})"
            )
        self._log_new_evaluations()

    def _on_step(self) -> bool:
        self._log_new_evaluations()
        return True

    def _on_training_end(self) -> None:
        self._log_new_evaluations()

    def _log_new_evaluations(self) -> None:
        for i, evaluation in enumerate(self.eval_callbacks):
            if evaluation._is_success_buffer is not self._seen[i]:
                self._seen[i] = evaluation._is_success_buffer
                self.logger.record("eval/normalized_score", self.score_reference.normalize(evaluation.last_mean_reward))
                self.logger.dump(self.num_timesteps)


class FlowFigure(BaseCallback):
    """
    Log a picture of the flow, `eval/flow`, of actions of two numbers: `EvalCallback(..., callback_after_eval=FlowFigure())`.

    Each picture shows the same recorded window, so that they tell how the flow changes while it is learned.

    :param seed: seed of the window and of the noise
    """

    def __init__(self, seed: int = 0) -> None:
        super().__init__()
        self.seed = seed

    def _on_step(self) -> bool:
        model: Any = self.model
        window = model.buffer.sample(1, model.context_length, th.Generator(model.device).manual_seed(self.seed))
        picture = logger.Figure(draw_flow(model.policy, window, self.seed), close=True)
        self.logger.record("eval/flow", picture, exclude=("stdout", "log", "json", "csv"))
        self.logger.dump(self.num_timesteps)  # the evaluation's own numbers have been
        return True


def draw_flow(policy: Any, window: Any, seed: int = 0) -> "Figure":
    """
    Draw where a flow takes noise, for the newest step of a window.

    :param policy: DTFM's policy for actions of two numbers, one action at a time
    :param window: window of a buffer, (1, K, ...)
    :param seed: seed of the noise
    :raises ValueError: other actions, or no flow
    """
    from matplotlib.figure import Figure

    head = policy.acting_network.head
    if not hasattr(head, "solve") or head.noise_dim != 2:
        found = f"the head is a {type(head).__name__} that starts from {head.noise_dim} numbers of noise"
        raise ValueError(f"Only a flow of two numbers can be drawn; {found}.")
    with th.no_grad():
        hidden = policy.newest_hidden(window)
        noise = th.randn(N_PATHS, 2, generator=th.Generator().manual_seed(seed)).to(hidden.device)
        paths = flow_paths(head, hidden.expand(N_PATHS, -1), noise).cpu()
    figure = Figure(figsize=(4.4, 4.4), layout="constrained")
    axis = figure.subplots()
    axis.plot(*paths.permute(2, 0, 1), color="0.8", linewidth=0.6)
    axis.scatter(paths[0, :, 0], paths[0, :, 1], s=5, color="#999999", label="noise, tau = 0", zorder=2)
    axis.scatter(paths[-1, :, 0], paths[-1, :, 1], s=6, color="#0072B2", label="actions, tau = 1", zorder=3)
    axis.set(xlabel="first number of the action", ylabel="second number", aspect="equal")
    axis.set(xlim=(-REACH, REACH), ylim=(-REACH, REACH))
    axis.legend(frameon=False, fontsize="small", loc="upper right")
    axis.spines[["top", "right"]].set_visible(False)
    return figure


def flow_paths(head: Any, hidden: th.Tensor, noise: th.Tensor, n_points: int = 50) -> th.Tensor:
    """
    Return the flow's paths from noise to actions.

    :param head: head of a flow
    :param hidden: (..., D)
    :param noise: (..., A), standard normal
    :param n_points: N, number of Euler steps, equally long in time
    :return: (N + 1, ..., A), the noise first, the actions last
    """
    points: list[th.Tensor] = []
    with head.vector_field.register_forward_pre_hook(lambda _, inputs: points.append(inputs[0])):
        end = head.solve(hidden, noise, "euler", n_points)
    return th.stack([*points, end])
