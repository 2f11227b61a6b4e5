"""What the learn loop adds to Stable-Baselines3's own callbacks."""

from stable_baselines3.common.callbacks import BaseCallback, CallbackList, EvalCallback, EventCallback, ProgressBarCallback

from sb3_dtfm.data.trajectories import ScoreReference


def find_eval_callbacks(callback: BaseCallback | None) -> list[EvalCallback]:
    """All evaluation callbacks in a tree of callback lists and events."""
    if isinstance(callback, EvalCallback):
        return [callback]
    if isinstance(callback, CallbackList):
        return [found for child in callback.callbacks for found in find_eval_callbacks(child)]
    if isinstance(callback, EventCallback):
        return find_eval_callbacks(callback.callback)
    return []


class GradientStepProgressBar(ProgressBarCallback):
    """SB3's progress bar, one unit per gradient step whatever the number of environments."""

    def _on_step(self) -> bool:
        self.pbar.update(1)
        return True


class NormalizedScoreCallback(BaseCallback):
    """
    Log `eval/normalized_score` after each evaluation. Put it behind the callbacks that evaluate.

    :param score_reference: the returns that count as 0 and 1
    :param eval_callbacks: the evaluations to follow
    """

    def __init__(self, score_reference: ScoreReference, eval_callbacks: list[EvalCallback]) -> None:
        super().__init__()
        self.score_reference = score_reference
        self.eval_callbacks = eval_callbacks

    def _on_training_start(self) -> None:
        if self.eval_callbacks and self.model.verbose >= 1:
            reference = self.score_reference
            print(
                f"eval/normalized_score: 0 is a return of {reference.minimum:.1f}, 1 is {reference.maximum:.1f} "
                f"({reference.scale})"
            )

    def _on_step(self) -> bool:
        for evaluation in self.eval_callbacks:
            if evaluation.eval_freq > 0 and evaluation.n_calls % evaluation.eval_freq == 0:
                score = self.score_reference.normalize(float(evaluation.last_mean_reward))
                self.logger.record("eval/normalized_score", score)
                self.logger.dump(self.num_timesteps)
        return True
