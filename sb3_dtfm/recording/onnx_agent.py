"""An agent that is a function in an ONNX file."""

from pathlib import Path
from typing import Any

import numpy as np
from gymnasium import spaces


class OnnxAgent:
    """
    The policy of others: its file has one input, observations (N, O), and the first output is the actions (N, A).

    :param path: ONNX file
    :raises ImportError: names the extra that is missing
    :raises ValueError: no such file
    """

    def __init__(self, path: str | Path) -> None:
        try:
            import onnxruntime
        except ImportError as error:
            raise ImportError(f'{path}: to run ONNX files: pip install "sb3-dtfm[export]" ({error})') from error
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = 1
        try:
            self._session = onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
        except Exception as error:  # of ONNX Runtime's several kinds
            raise ValueError(f"{path} is no ONNX file that can be run: {error}") from error
        if "sb3_dtfm" in self._session.get_modelmeta().custom_metadata_map:
            raise ValueError(f"{path} was exported by sb3-dtfm: name the run of the model that was exported, --model RUN.")
        inputs, output = self._session.get_inputs(), self._session.get_outputs()[0]
        sizes = [each.shape[-1] for each in (*inputs, output)]
        if len(inputs) != 1 or any(len(each.shape) != 2 for each in (*inputs, output)) or not _are_numbers(sizes):
            shapes = ", ".join(f"{each.name} {each.shape}" for each in (*inputs, output))
            raise ValueError(f"{path} must have one input (N, O) and an output (N, A), got {shapes}.")
        self._input, self._takes_rows = inputs[0], not isinstance(inputs[0].shape[0], int)
        self.observation_space = spaces.Box(-np.inf, np.inf, (sizes[0],), np.float32)
        self.action_space = spaces.Box(-np.inf, np.inf, (sizes[1],), np.float32)

    def predict(
        self, observation: np.ndarray, state: Any = None, episode_start: Any = None, deterministic: bool = True
    ) -> tuple[np.ndarray, None]:
        """
        Predict as Stable-Baselines3's agents do.

        :param observation: (N, O)
        :param state: unused
        :param episode_start: unused
        :param deterministic: must be True
        :return: actions (N, A), and None
        :raises ValueError: `deterministic` is False; the file has no distribution to sample from
        """
        if not deterministic:
            raise ValueError("An ONNX file gives one action for an observation and cannot be sampled (--stochastic).")
        observation = np.asarray(observation, np.float32)
        batches = [observation] if self._takes_rows else np.split(observation, len(observation))
        return np.concatenate([self._session.run(None, {self._input.name: batch})[0] for batch in batches]), None


def _are_numbers(sizes: list[Any]) -> bool:
    return all(isinstance(size, int) for size in sizes)
