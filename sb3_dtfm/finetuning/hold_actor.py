"""Critics first: a callback for Stable-Baselines3's off-policy algorithms."""

from typing import Any

from stable_baselines3.common.callbacks import BaseCallback
from torch import nn

from sb3_dtfm.arguments import COUNT, check_arguments


class HoldActor(BaseCallback):
    """
    Keep the actor as it is while the critics learn their first steps.

    Of critics that know nothing yet an actor learns nothing but to leave what the frozen policy does well: returns fall
    before they rise. For SAC, TQC, TD3 and others with an `actor` and a `critic`, in any environment.

    :param n_updates: gradient steps of the critics alone
    :raises ValueError: another algorithm
    """

    def __init__(self, n_updates: int) -> None:
        super().__init__()
        check_arguments({"n_updates": n_updates}, {"n_updates": COUNT})
        self.n_updates = n_updates

    def _init_callback(self) -> None:
        if not hasattr(self.model, "actor") or not hasattr(self.model, "critic"):
            raise ValueError(f"HoldActor: {type(self.model).__name__} has no actor beside its critics.")

    def _on_training_start(self) -> None:
        self._hold()

    def _on_step(self) -> bool:
        self._hold()
        return True

    def _on_training_end(self) -> None:
        self._actor.requires_grad_(True)

    @property
    def _actor(self) -> nn.Module:
        model: Any = self.model
        return model.actor

    def _hold(self) -> None:
        self._actor.requires_grad_(self.model._n_updates >= self.n_updates)
