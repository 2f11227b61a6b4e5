"""
One cell of the grid in a process of its own: `python -m sb3_dtfm.benchmark.cell spec.json`.

It does what `sb3-dtfm train` does, with another evaluation: RL-Zoo's own one does not fix its initial states.
"""

import json
import os
import sys
from pathlib import Path
from typing import Any

import rl_zoo3.train
import torch as th
from rl_zoo3.exp_manager import ExperimentManager
from stable_baselines3.common.vec_env import VecEnv

from sb3_dtfm.benchmark import provenance
from sb3_dtfm.benchmark.evaluation import EvaluationCallback, SeededEpisodes
from sb3_dtfm.benchmark.rows import write_row
from sb3_dtfm.cli import main as cli

ROWS, PROGRESS, OUTPUT, SPEC = "rows.jsonl", "progress.json", "output.log", "spec.json"


class AbandonedError(RuntimeError):
    """The grid that started this cell is gone, and would not take its rows."""


class BenchmarkManager(ExperimentManager):
    """RL-Zoo's way to a trained model, evaluated by :class:`EvaluationCallback`."""

    spec: dict[str, Any]
    folder: Path

    def create_callbacks(self) -> None:
        vec_env = self.create_evaluation_envs()
        n_final = self.spec["final_episodes"]
        self.callbacks.append(
            EvaluationCallback(
                vec_env, self.eval_freq, self.n_eval_episodes, n_final, self._write, report_progress=self._report_progress
            )
        )

    def create_evaluation_envs(self) -> VecEnv:
        """RL-Zoo's evaluation environments, whose episodes start from seeds that are set."""
        wrapper = self.env_wrapper
        self.env_wrapper = lambda env: SeededEpisodes(wrapper(env) if wrapper is not None else env)
        try:
            return self.create_envs(self.n_eval_envs, eval_env=True)
        finally:
            self.env_wrapper = wrapper

    def _write(self, evaluation: dict[str, Any]) -> None:
        write_row(
            self.folder / ROWS, {**self.spec["row"], **evaluation, "hardware": provenance.hardware(_device(self.device))}
        )

    def _report_progress(self, n_done: int, n_total: int, what: str) -> None:
        if os.getppid() != self.spec["parent"]:
            raise AbandonedError("The grid that started this cell is gone.")
        part = self.folder / f"{PROGRESS}.part"
        part.write_text(json.dumps([n_done, n_total, what]))
        part.replace(self.folder / PROGRESS)


def _device(name: th.device | str) -> th.device:
    if str(name) == "auto":
        return th.device("cuda" if th.cuda.is_available() else "cpu")
    return th.device(name)


def main(spec_file: str) -> None:
    """
    Train and evaluate one cell.

    :param spec_file: JSON with `train` (arguments of `sb3-dtfm train`), `row` (what all rows of the cell say),
        `final_episodes` and `parent` (the process that waits for it); rows and progress go beside this file
    """
    BenchmarkManager.folder = Path(spec_file).parent
    BenchmarkManager.spec = json.loads(Path(spec_file).read_text())
    row = BenchmarkManager.spec["row"]
    row.update(commit=provenance.commit(), versions=provenance.versions())
    rl_zoo3.train.ExperimentManager = BenchmarkManager  # type: ignore[misc]
    cli.train(BenchmarkManager.spec["train"])


if __name__ == "__main__":
    main(sys.argv[1])
