"""Options of training, which are arguments of the algorithm."""

from dataclasses import dataclass

from sb3_dtfm.arguments import (
    BOOLEAN,
    COUNT,
    NOT_NEGATIVE,
    PROBABILITY_BELOW_1,
    Choice,
    Number,
    Options,
    option,
)
from sb3_dtfm.optimization import LEARNING_RATE_SCHEDULES, PRECISIONS


@dataclass(frozen=True)
class TrainingOptions(Options):
    """
    Options of the windows that are drawn, and of the gradient steps that learn from them.

    :param batch_size: windows in a gradient step, of all processes together; 64 of less than 10,000 recorded steps, and
        256 of more
    :param context_length: K, steps the policy sees
    :param return_weighting: w: of mixed data, a step of the best episode is learned from 1 + w times as often as one of the
        worst, and others by their returns in between (Yue et al., 2022); 0 learns from all alike. 5 where returns tell how
        episodes act, and 0 elsewhere
    :param weight_decay: AdamW's, on weight matrices only
    :param learning_rate_schedule: factor on the learning rate: "constant", or "linear" or "cosine" down to zero
    :param warmup_steps: gradient steps over which the learning rate rises linearly from zero; 0 for none
    :param max_grad_norm: clip the gradient's norm to this; None and 0 do not clip
    :param ema_decay: decay of the exponential moving average of weights that acts; 0 acts with the trained weights
    :param precision: of matrix products: "float32", "bfloat16" (autocast), or "auto": bfloat16 where the hardware has
        instructions for it, on a CPU only if it is the faster one for this model, which is measured once
    :param compile: compile the loss with `torch.compile`; None does so on a GPU, where one process starts its kernels as a
        CUDA graph. It takes a minute, and a C++ compiler
    :raises ValueError: an option out of range, by name
    """

    batch_size: int | None = option(None, COUNT._replace(optional=True))
    context_length: int = option(1, Number(low=1, high=100_000, whole=True))
    return_weighting: float | None = option(None, NOT_NEGATIVE._replace(optional=True))
    weight_decay: float = option(1e-3, NOT_NEGATIVE)
    learning_rate_schedule: str = option("cosine", Choice(LEARNING_RATE_SCHEDULES))
    warmup_steps: int = option(100, Number(low=0, whole=True))
    max_grad_norm: float | None = option(None, NOT_NEGATIVE._replace(optional=True))
    ema_decay: float = option(0.999, PROBABILITY_BELOW_1)
    precision: str = option("float32", Choice(PRECISIONS))
    compile: bool | None = option(None, Choice((None, *BOOLEAN.values)))
