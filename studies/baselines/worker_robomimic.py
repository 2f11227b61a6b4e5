"""robomimic's BC-RNN-GMM as a baseline; runs in an environment of its own (`make baselines`)."""

import copy
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import torch as th

from baselines.protocol import Dataset, serve

# robomimic imports torchvision, for images, which ours has none of. PyPI's is built for GPUs: beside a PyTorch for CPUs it
# misses its own operators, and that they are known by name is enough for its import.
# A PyTorch for GPUs must not have them twice.
if th.version.cuda is None:
    _OPERATORS = th.library.Library("torchvision", "FRAGMENT")
    for _name in ("nms", "qnms"):
        _OPERATORS.define(f"{_name}(Tensor dets, Tensor scores, float iou_threshold) -> Tensor")

from robomimic.algo import algo_factory
from robomimic.config import config_factory
from robomimic.utils import obs_utils
from robomimic.utils.dataset import SequenceDataset

OBSERVATION = "observation"
STEPS_PER_EPOCH = 100


class RobomimicLearner:
    """
    BC-RNN-GMM (Mandlekar et al., 2021).

    :param settings: `batch_size`, `learning_rate`, `hidden_dim` of the LSTM, `horizon` steps that it sees, `n_modes` of the
        mixture
    :param dataset: to learn from
    :param n_steps: gradient steps that are planned; it has no schedule
    :param seed: of weights, batches and noise
    """

    def __init__(self, settings: dict[str, Any], dataset: Dataset, n_steps: int, seed: int) -> None:
        th.set_num_threads(1)
        th.manual_seed(seed)
        np.random.seed(seed)  # noqa: NPY002 - what robomimic draws from
        config = _config(**settings)
        obs_utils.initialize_obs_utils_with_config(config)
        first = dataset.episodes[0]
        shapes = {OBSERVATION: [first.observations.shape[1]]}
        self.algorithm = algo_factory("bc", config, shapes, first.actions.shape[1], th.device("cpu"))
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "episodes.hdf5"
            _write(path, dataset)
            steps = SequenceDataset(
                str(path),
                obs_keys=(OBSERVATION,),
                dataset_keys=("actions",),
                seq_length=settings["horizon"],
                hdf5_cache_mode="all",
                load_next_obs=False,
            )
            steps.close_and_delete_hdf5_handle()
        self._batches = th.utils.data.DataLoader(steps, batch_size=settings["batch_size"], shuffle=True)

    def learn(self, n_steps: int, after_step: Callable[[], None]) -> None:
        """See :class:`~baselines.protocol.Learner`."""
        done = 0
        while done < n_steps:
            for batch in self._batches:
                self.algorithm.set_train()
                batch = self.algorithm.process_batch_for_training(batch)
                batch = self.algorithm.postprocess_batch_for_training(batch, obs_normalization_stats=None)
                self.algorithm.train_on_batch(batch, epoch=1 + done // STEPS_PER_EPOCH)
                done += 1
                after_step()
                if done == n_steps:
                    return

    def actor(self) -> Callable[[np.ndarray, float, bool], np.ndarray]:
        """See :class:`~baselines.protocol.Learner`; each has a hidden state of its own beside the same networks."""
        algorithm = copy.copy(self.algorithm)

        def act(observation: np.ndarray, return_to_go: float, start: bool) -> np.ndarray:
            if start:
                algorithm.set_eval()
                algorithm.reset()
            with th.no_grad():
                return algorithm.get_action({OBSERVATION: th.from_numpy(observation[None])})[0].numpy()

        return act


def _config(batch_size: int, learning_rate: float, hidden_dim: int, horizon: int, n_modes: int) -> Any:
    """robomimic's defaults for BC, as a recurrent network with a mixture of Gaussians for a head."""
    config = config_factory("bc")
    with config.values_unlocked():
        config.observation.modalities.obs.low_dim = [OBSERVATION]
        config.train.batch_size, config.train.seq_length = batch_size, horizon
        config.algo.optim_params.policy.learning_rate.initial = learning_rate
        config.algo.actor_layer_dims = ()
        config.algo.gmm.enabled, config.algo.gmm.num_modes = True, n_modes
        config.algo.rnn.enabled, config.algo.rnn.horizon, config.algo.rnn.hidden_dim = True, horizon, hidden_dim
    return config


def _write(path: Path, dataset: Dataset) -> None:
    """The episodes as a robomimic file: observations as one vector, actions in [-1, 1] as robomimic has them."""
    with h5py.File(path, "w") as file:
        for number, episode in enumerate(dataset.episodes):
            demo = file.create_group(f"data/demo_{number}")
            demo.attrs["num_samples"] = len(episode.actions)
            demo[f"obs/{OBSERVATION}"], demo["actions"] = episode.observations, episode.actions


if __name__ == "__main__":
    serve(RobomimicLearner, ("robomimic", "torch", "numpy"))
