"""Memory of a policy between calls of `predict` that pass no `state`."""

import warnings

import numpy as np

from sb3_dtfm.policies.context import Context

ADVICE = (
    "A context belongs to whoever passes `state`: pass the one that the last call for the same environment returned. "
    "Without `state`, predict() remembers one caller, until model.policy.reset()."
)


class RememberedContext:
    """The context of one caller, who steps one environment (or several in parallel) and passes nothing back."""

    def __init__(self) -> None:
        self._before: Context | None = None
        self._after: Context | None = None
        self._has_warned = False

    def forget(self) -> None:
        """Start anew with the next call."""
        self._before = self._after = None

    def recall(self, observation: np.ndarray, timestep: np.ndarray) -> Context | None:
        """
        Return what a new observation follows: the context after the last call, or before it where the same is asked again.

        :param observation: (B, O)
        :param timestep: (B,)
        :return: that context; None where nothing of B environments is remembered
        """
        before, after = self._before, self._after
        if before is None or after is None or len(after.mask) != len(observation):
            return None
        again = (timestep == after.timesteps[:, -1]) & (observation == after.observations[:, -1]).all(axis=1)
        if not again.any():
            return after
        return before if again.all() else _choose(again, before, after)

    def remember(self, before: Context, after: Context) -> Context:
        """
        :param before: context that :meth:`recall` returned, or an empty one
        :param after: context with the newest step and its action
        :return: `after` as read-only arrays for the caller, so that what is remembered stays
        """
        self._before, self._after = before, after
        shown = Context(*(array.view() for array in after))
        for array in shown:
            array.flags.writeable = False
        return shown

    def warn(self, what: str) -> None:
        """Tell once how contexts are kept apart."""
        if not self._has_warned:
            self._has_warned = True
            warnings.warn(f"{what} {ADVICE}", UserWarning, stacklevel=4)


def _choose(rows: np.ndarray, first: Context, second: Context) -> Context:
    """The rows of the first context where `rows` (B,) is True, of the second elsewhere."""
    chosen = {}
    for name, ours, theirs in zip(Context._fields, first, second, strict=True):
        if ours.shape != theirs.shape:  # one of them keeps nothing: both are computed from their windows
            ours = theirs = np.zeros((len(rows), 0), np.float32)
        chosen[name] = np.where(rows.reshape(-1, *[1] * (ours.ndim - 1)), ours, theirs)
    return Context(**chosen)
