"""`torchrun -m sb3_dtfm train`: process 0 does what RL-Zoo does; the others train along, and what they write is not kept."""

import argparse
import contextlib
import os
import signal
import tempfile
from collections.abc import Iterator, Sequence
from typing import Any, NoReturn

import torch as th
import torch.distributed as dist

from sb3_dtfm.algorithms import ALGORITHMS
from sb3_dtfm.distributed import is_first_process
from sb3_dtfm.zoo.arguments import UsageError


@contextlib.contextmanager
def joined_processes(arguments: Sequence[str]) -> Iterator[list[str]]:
    """
    Join the processes that torchrun started, for one training; where there is one process, nothing happens.

    A process that fails leaves without a word to the others: torchrun ends them.

    :param arguments: arguments for RL-Zoo's `train`
    :return: arguments for `train` on this process
    :raises UsageError: several processes cannot do this together
    """
    if "RANK" not in os.environ or int(os.environ.get("WORLD_SIZE", 1)) == 1:
        yield list(arguments)
        return
    options = _options(arguments)
    _check(options)
    if options.device != "cpu" and th.cuda.is_available():
        _take_own_gpu()
    dist.init_process_group()  # gloo for the CPU, NCCL for GPUs
    if is_first_process():
        signal.signal(signal.SIGINT, _interrupt_once)
        yield list(arguments)
    else:
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # or process 0 would wait for this one, and could not save
        with _nothing_to_keep() as folder:  # the last one that is given counts
            yield [*(argument for argument in arguments if argument != "--track"), "--log-folder", folder]
    dist.destroy_process_group()


def _options(arguments: Sequence[str]) -> argparse.Namespace:
    """Parse those of RL-Zoo's options that matter here."""
    parser = argparse.ArgumentParser(add_help=False)
    parser.add_argument("--algo")
    parser.add_argument("--device", default="auto")
    parser.add_argument("-optimize", "--optimize-hyperparameters", action="store_true")
    return parser.parse_known_args(arguments)[0]


def _check(options: argparse.Namespace) -> None:
    if options.algo not in ALGORITHMS:
        raise UsageError(f"torchrun trains {' and '.join(ALGORITHMS)} on several processes, not {options.algo}.")
    if options.optimize_hyperparameters:
        raise UsageError(
            "-optimize: processes of a search share a --storage and a --study-name; start each by itself, not with torchrun."
        )


def _take_own_gpu() -> None:
    """Make "cuda" the GPU of this process from here on."""
    rank, n_gpus = int(os.environ["LOCAL_RANK"]), th.cuda.device_count()
    if rank >= n_gpus:
        raise UsageError(
            f"torchrun --nproc-per-node: this machine has {n_gpus} GPUs, one for each process (or --device cpu)."
        )
    th.cuda.set_device(rank)


def _interrupt_once(*_: Any) -> NoReturn:
    """
    Ctrl-C reaches a process twice, from the terminal and from torchrun.

    :raises KeyboardInterrupt: always; RL-Zoo then saves the model, which the second one must not interrupt
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    raise KeyboardInterrupt


@contextlib.contextmanager
def _nothing_to_keep() -> Iterator[str]:
    """A folder for files, gone at the end, while prints go nowhere."""
    with tempfile.TemporaryDirectory() as folder, open(os.devnull, "w") as nowhere, contextlib.redirect_stdout(nowhere):
        yield folder
