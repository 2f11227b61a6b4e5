"""Training on several processes, by PyTorch's own engine: each computes the loss of its share of every batch."""

import contextlib
import os
from collections.abc import Callable, Iterator
from datetime import timedelta
from typing import Any, TypeAlias

import torch as th
import torch.distributed as dist
from torch import nn
from torch.nn.parallel import DistributedDataParallel

from sb3_dtfm.windows import Windows

LossFunction: TypeAlias = Callable[..., tuple[th.Tensor, dict[str, th.Tensor]]]

# How long the others wait for what process 0 does alone between two gradient steps, evaluations above all.
PATIENCE = timedelta(days=1)


def n_processes() -> int:
    """Processes that train together; 1 where `torch.distributed` is not initialised."""
    return dist.get_world_size() if dist.is_initialized() else 1


def is_first_process() -> bool:
    """Return whether this process is the one that writes, evaluates and runs callbacks."""
    return not dist.is_initialized() or dist.get_rank() == 0


def check_batch_size(batch_size: int) -> None:
    """
    :param batch_size: windows in a gradient step, of all processes together
    :raises ValueError: it cannot be divided evenly
    """
    if batch_size % n_processes():
        raise ValueError(
            f"batch_size must be a multiple of the number of processes, which share each batch: got batch_size={batch_size} "
            f"and {n_processes()} processes."
        )


@contextlib.contextmanager
def local_rank_zero_first() -> Iterator[None]:
    """Let the first process of each machine download what the others then find on disk."""
    if n_processes() == 1:
        yield
        return
    # By gloo: a download may take longer than a barrier of the default group would wait.
    group = dist.new_group(backend="gloo", timeout=PATIENCE)
    first = os.environ.get("LOCAL_RANK", "0") == "0"
    if not first:
        dist.barrier(group)
    try:
        yield
    finally:  # whatever became of it, the others must not wait for it
        if first:
            dist.barrier(group)
    dist.destroy_process_group(group)


class _PolicyLoss(nn.Module):
    """A policy's loss as the forward pass of what it trains, which DistributedDataParallel can wrap."""

    def __init__(self, network: nn.Module, compute_loss: LossFunction) -> None:
        super().__init__()
        self.network = network
        self.compute_loss = compute_loss

    def forward(self, batch: Any, *noise: th.Tensor) -> tuple[th.Tensor, dict[str, th.Tensor]]:
        return self.compute_loss(batch, *noise)


class DataParallel:
    """
    One training run on all processes of `torch.distributed`, or on this one alone.

    All processes draw the same batch and the same noise, and each computes the loss of its own rows. A loss divides by the
    valid steps of the rows it sees, so that a share counts by its share of the valid steps: gradients and means are then
    those of the whole batch, and a run learns the same on any number of processes.

    Every process makes one at the same point. The policy becomes that of process 0.

    :param policy: a :class:`~sb3_dtfm.policies.SequencePolicy`
    :param compute_loss: the policy's loss, compiled and in the precision that training is to have
    :param batch_size: windows in a gradient step, of all processes together
    :raises ValueError: `batch_size` is no multiple of the number of processes
    """

    def __init__(self, policy: Any, compute_loss: LossFunction, batch_size: int) -> None:
        check_batch_size(batch_size)
        self.policy = policy
        self._compute_loss = compute_loss
        self.n_processes = n_processes()
        self.rank = 0
        if self.n_processes > 1:
            self.rank = dist.get_rank()
            share = batch_size // self.n_processes
            self._rows = slice(self.rank * share, (self.rank + 1) * share)
            for tensor in (*policy.parameters(), *policy.buffers()):
                dist.broadcast(tensor.data, src=0)
            self._policy_loss = DistributedDataParallel(_PolicyLoss(policy.network, compute_loss), init_sync=False)
            # Messages between the processes themselves: by gloo, since a message over NCCL would wait for the GPU's queue.
            self._messages = dist.new_group(backend="gloo", timeout=PATIENCE)

    def compute_loss(self, batch: Windows, *noise: th.Tensor) -> tuple[th.Tensor, dict[str, th.Tensor]]:
        """
        This process's part of the policy's loss: the mean over all processes is the loss of the whole batch.

        :param batch: the whole batch, (B, K, ...)
        :param noise: random numbers that the policy has drawn for the whole batch, each (B, ...)
        :return: the loss to minimise, whose gradient will be the whole batch's, and its parts by their logged names
        """
        if self.n_processes == 1:
            return self._compute_loss(batch, *noise)
        share = batch.map(lambda tensor: tensor[self._rows])
        loss, parts = self._policy_loss(share, *(tensor[self._rows] for tensor in noise))
        weight = self._weight(batch.mask)
        loss, weighted = weight * loss, {name: weight * part for name, part in parts.items()}
        for name, mask in self.policy.network.head.part_masks(batch.mask).items():
            weighted[name] = self._weight(mask) * parts[name]
            loss = loss + weighted[name] - weight * parts[name]
        return loss, weighted

    def _weight(self, mask: th.Tensor) -> th.Tensor:
        """Return the weight of this process's mean over valid steps, so that the processes' mean is that over all steps."""
        return self.n_processes * mask[self._rows].sum() / mask.sum()

    def mean(self, values: dict[str, th.Tensor]) -> dict[str, th.Tensor]:
        """
        Means over the processes; with GPUs, one more kernel in the queue that no host waits for.

        :param values: scalars by name, the same names on every process
        """
        if self.n_processes == 1:
            return values
        means = th.stack([value.detach().float() for value in values.values()]) / self.n_processes
        dist.all_reduce(means)
        return dict(zip(values, means, strict=True))

    def broadcast(self, number: int) -> int:
        """
        Process 0's number; the others wait for it.

        :param number: non-negative, below 2**64; read on process 0 only
        """
        if self.n_processes == 1:
            return number
        message = th.frombuffer(bytearray(int(number).to_bytes(8, "little")), dtype=th.uint8)
        dist.broadcast(message, src=0, group=self._messages)
        return int.from_bytes(message.numpy().tobytes(), "little")

    def close(self) -> None:
        """Give the connections back, at the same point on every process."""
        if self.n_processes > 1:
            dist.destroy_process_group(self._messages)
