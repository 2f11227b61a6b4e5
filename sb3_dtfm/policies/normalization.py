"""The units of a network: windows and actions between the environment's and its own."""

from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from torch import nn

from sb3_dtfm.actions import unscaled
from sb3_dtfm.transitions import Transitions
from sb3_dtfm.windows import Windows

# Observations are clipped at this many standard deviations, as SB3's VecNormalize does.
OBSERVATION_CLIP = 10.0
# Scaled returns-to-go are clipped here, far beyond those of the data, so that no number overflows.
RETURN_TO_GO_CLIP = 1e3
# Standard deviations of the returns-to-go at a time step that become 1, and at which they are clipped.
RETURN_UNIT, RETURN_CLIP = 4.0, 5.0
RETURN_SCALINGS = ("timestep", "max")
OBSERVATION_SCALINGS = ("std", "robust")
# A dimension whose standard deviation is smaller is a constant, and zero for the network whatever it is later.
SMALLEST_STD = 1e-5


class Normalization(nn.Module):
    """
    Statistics that normalise inputs, measured on the training data and saved with the weights; and the range of actions.

    :param observation_dim: O, or O + F with the features of images behind, which stay as they are
    :param action_space: bounded Box (A,)
    :param max_timestep: number T of steps of the longest episode; each time step has its own range of returns-to-go
    :param clip_return_to_go: whether the return-to-go stays within the range recorded at the same time step
    :param return_scaling: scaling of the return-to-go: "timestep" subtracts the mean of the data's returns-to-go at the same
        time step and divides by their standard deviation there, so that good and bad episodes are as far apart at the last
        step as at the first one; "max" divides by the largest return-to-go of the data, as Decision Transformer does; None
        makes it zero
    :param observation_scaling: scaling of observations: "std" divides by their standard deviation over all steps, "robust"
        by the lower quartile of the episodes' standard deviations
    """

    observation_mean: th.Tensor
    observation_std: th.Tensor
    observation_gain: th.Tensor
    return_scale: th.Tensor
    return_mean: th.Tensor | None
    return_std: th.Tensor | None
    return_to_go_range: th.Tensor | None
    action_low: th.Tensor
    action_high: th.Tensor

    def __init__(
        self,
        observation_dim: int,
        action_space: spaces.Box,
        max_timestep: int,
        clip_return_to_go: bool = True,
        return_scaling: str | None = "timestep",
        observation_scaling: str = "std",
    ) -> None:
        super().__init__()
        self.max_timestep = max_timestep
        self.observation_scaling = observation_scaling
        self.register_buffer("observation_mean", th.zeros(observation_dim))
        self.register_buffer("observation_std", th.ones(observation_dim))
        self.register_buffer("observation_gain", th.ones(observation_dim))
        self.register_buffer("return_scale", th.ones(()))
        self.return_scaling = return_scaling
        by_timestep = return_scaling == "timestep"
        self.register_buffer("return_mean", th.zeros(max_timestep) if by_timestep else None)
        self.register_buffer("return_std", th.ones(max_timestep) if by_timestep else None)
        unlimited = th.full((2, max_timestep), th.inf)
        unlimited[0] = -th.inf
        self.register_buffer("return_to_go_range", unlimited if clip_return_to_go else None)
        for name, bound in (("action_low", action_space.low), ("action_high", action_space.high)):
            self.register_buffer(name, th.as_tensor(bound, dtype=th.float32), persistent=False)

    def set_statistics(
        self,
        observation_mean: np.ndarray,
        observation_std: np.ndarray,
        observation_robust_std: np.ndarray,
        return_scale: float,
    ) -> None:
        """
        Take the input normalisation from training data.

        :param observation_mean: (O,)
        :param observation_std: (O,), which decides what is clipped, and becomes 1
        :param observation_robust_std: (O,), not larger; the divisor of "robust"
        :param return_scale: largest absolute return-to-go, environment reward units
        """
        vector, varies = slice(0, len(observation_mean)), observation_std > SMALLEST_STD  # features of images lie behind
        self.observation_mean[vector] = th.from_numpy(observation_mean)
        self.observation_std[vector] = th.from_numpy(np.where(varies, observation_std, 1.0))
        gain = np.zeros_like(observation_std)
        divisor = observation_robust_std if self.observation_scaling == "robust" else observation_std
        self.observation_gain[vector] = th.from_numpy(np.divide(observation_std, divisor, out=gain, where=varies))
        self.return_scale.fill_(return_scale if return_scale > 0 else 1.0)

    def set_return_to_go_moments(self, moments: th.Tensor) -> None:
        """
        :param moments: (2, max_timestep), mean and standard deviation of the return-to-go by time step, environment reward
            units; the latter positive
        """
        assert self.return_mean is not None
        assert self.return_std is not None
        self.return_mean.copy_(moments[0])
        self.return_std.copy_(moments[1])

    def set_return_to_go_range(self, limits: th.Tensor) -> None:
        """
        :param limits: (2, max_timestep), smallest and largest return-to-go by time step, environment reward units
        """
        assert self.return_to_go_range is not None
        self.return_to_go_range.copy_(limits)

    def forward(self, windows: Windows) -> Windows:
        """
        :param windows: windows of tensors; observations and returns-to-go as the environment gives them
        :return: observations normalised and clipped, returns-to-go scaled to about [-1, 1], the others as they are
        """
        return windows._replace(
            observations=self.scale_observation(windows.observations),
            returns_to_go=self._scale_return_to_go(windows.returns_to_go, windows.timesteps),
        )

    def scale_batch(self, batch: Windows) -> Windows:
        """Windows of a buffer as the network learns from them: normalised, actions in [-1, 1]."""
        return self(batch._replace(actions=self.scale_action(batch.actions)))

    def _scale_return_to_go(self, returns_to_go: th.Tensor, timesteps: th.Tensor) -> th.Tensor:
        """Scale environment reward units, (B, K), to about [-1, 1]."""
        if self.return_scaling is None:
            return th.zeros_like(returns_to_go)
        timesteps = timesteps.clamp(max=self.max_timestep - 1)
        if self.return_to_go_range is not None:
            low, high = self.return_to_go_range[:, timesteps]
            returns_to_go = returns_to_go.clamp(low, high)
        if self.return_mean is None or self.return_std is None:
            return (returns_to_go / self.return_scale).clamp(-RETURN_TO_GO_CLIP, RETURN_TO_GO_CLIP)
        deviations = (returns_to_go - self.return_mean[timesteps]) / self.return_std[timesteps]
        return deviations.clamp(-RETURN_CLIP, RETURN_CLIP) / RETURN_UNIT

    def scale_observation(self, observations: th.Tensor) -> th.Tensor:
        """Normalise and clip observations (..., O)."""
        scaled = (observations - self.observation_mean) / self.observation_std
        return scaled.clamp(-OBSERVATION_CLIP, OBSERVATION_CLIP) * self.observation_gain

    def scale_transitions(self, batch: Transitions) -> Transitions:
        """Scale a buffer's transitions as a critic takes them: observations normalised, actions in [-1, 1]."""
        actions = batch.actions.view(len(batch.actions), -1, len(self.action_low))
        return batch._replace(
            observations=self.scale_observation(batch.observations),
            next_observations=self.scale_observation(batch.next_observations),
            actions=self.scale_action(actions).flatten(1),
        )

    def scale_action(self, action: Any) -> Any:
        """Scale the environment's range to [-1, 1], (..., A)."""
        return 2.0 * (action - self.action_low) / (self.action_high - self.action_low) - 1.0

    def unscale_action(self, action: th.Tensor) -> th.Tensor:
        """Scale [-1, 1] to the environment's range and no further, (..., A)."""
        low, high = self.action_low, self.action_high
        clamped: th.Tensor = unscaled(action, low, high).clamp(low, high)
        return clamped
