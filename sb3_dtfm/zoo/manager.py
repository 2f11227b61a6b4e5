"""RL-Zoo's experiment: its way from settings to a trained model."""

import contextlib
import os
import shutil
from typing import Any

from rl_zoo3.exp_manager import ExperimentManager
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import EvalCallback

from sb3_dtfm.algorithms import ALGORITHMS
from sb3_dtfm.callbacks import EvaluateAtStartAndEnd
from sb3_dtfm.distributed import is_first_process


class TrainingError(RuntimeError):
    """An error in the midst of training, and so no mistake in the settings; the cause has the traceback that counts."""


class OfflineExperimentManager(ExperimentManager):
    """
    RL-Zoo's own manager, for all of its algorithms, and what offline learning needs beside it.

    - A run that ends before it has a model leaves no folder, where `enjoy` would look for the latest run.
    - dt and dtfm are evaluated before the first gradient step and after the last one too.
    - Of the processes of one training, the first alone runs callbacks.
    """

    def setup_experiment(self) -> tuple[BaseAlgorithm, dict[str, Any]] | None:
        """RL-Zoo's, which makes the run's folder before its model."""
        try:
            return super().setup_experiment()
        except BaseException:
            with contextlib.suppress(OSError):  # not made yet, or no longer empty: then it is a run's
                os.rmdir(self.params_path)
                shutil.rmtree(self.save_path)
            raise

    def create_callbacks(self) -> None:
        """RL-Zoo's, and the evaluations that a count of full intervals leaves out."""
        if not is_first_process():
            self.callbacks = []
            return
        super().create_callbacks()
        evaluations = [callback for callback in self.callbacks if isinstance(callback, EvalCallback)]
        if evaluations and self.algo in ALGORITHMS:
            self.callbacks.append(EvaluateAtStartAndEnd(evaluations))

    def learn(self, model: BaseAlgorithm) -> None:
        """
        RL-Zoo's.

        :param model: to train
        :raises TrainingError: whatever went wrong
        """
        try:
            super().learn(model)
        except Exception as error:
            message = f"Training ended after {model.num_timesteps} timesteps: {type(error).__name__}: {error}"
            raise TrainingError(message) from error
